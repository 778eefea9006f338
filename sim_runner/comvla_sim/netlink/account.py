"""What a run amounts to: the robot's records and the capture's calls laid side by side."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import islice
from typing import Any

import numpy as np

from comvla import codec
from comvla_client.budget import LinkProfile
from comvla_sim.experiments.statistics import wilson_interval
from comvla_sim.netlink.capture import Captured
from comvla_sim.netlink.http2 import Call

USEFUL_TOKENS = 20
"""About where the success of published policies has its knee."""


def join(
    records: Sequence[dict[str, Any]],
    calls: Iterable[Call],
    period_s: float,
    stolen_periods: Iterable[int] = (),
) -> list[dict[str, Any]]:
    """Adds to each query when its payload had passed the wire, and whether all was in time.

    A query made twice (over a second connection) counts by the first one that was complete.

    Args:
        records: the robot's, in order.
        calls: the capture's.
        period_s: T.
        stolen_periods: in which the host took time from this machine; a query of such a period, or
            of the one after, is marked.
    """
    stolen = set(stolen_periods)
    seen: dict[tuple[str, int], Call] = {}
    for call in calls:
        if call.step is None:
            continue
        known = seen.get((call.session, call.step))
        if known is None or (known.complete_s is None and call.complete_s is not None):
            seen[call.session, call.step] = call
    joined = []
    for record in records:
        call_seen = seen.get((record["session"], record["step"])) if record["tokens"] else None
        complete_s = call_seen.complete_s if call_seen is not None else None
        after_s = None if complete_s is None else complete_s - record["boundary"]
        answered_s = record["answered_after_s"]
        joined.append(
            {
                **record,
                "sent": bool(record["tokens"]),
                "stolen": bool(stolen & {record["period"], record["period"] - 1}),
                "passed_bytes": 0 if call_seen is None else call_seen.data_bytes,
                "complete_after_s": after_s,
                "payload_in_time": after_s is not None and after_s <= period_s,
                "answer_in_time": answered_s is not None and answered_s <= period_s,
            }
        )
    return joined


def summarise(
    queries: Sequence[dict[str, Any]],
    captured: Captured,
    profile: LinkProfile,
    channel: Iterable[float],
    mtu_bytes: int,
) -> dict[str, Any]:
    """Shares with their Wilson intervals, percentiles, bytes, K, lateness, and how honest the link was.

    Args:
        queries: from :func:`join`.
        captured: by the capture.
        profile: the radio as it was enforced.
        channel: SNR of each period.
        mtu_bytes: largest IP packet.
    """
    sent = [query for query in queries if query["sent"]]
    undisturbed = [query for query in sent if not query["stolen"]]
    tokens = np.array([query["tokens"] for query in queries])
    used = np.array([query["tokens_used"] for query in queries])
    periods = max((query["period"] for query in queries), default=0) + 1
    capacity = np.array([profile.capacity_bits(v) / 8 for v in islice(channel, periods)])
    offered = np.array([_ip_bytes(query["framed_bytes"], mtu_bytes) for query in queries])
    own = capacity[[query["period"] for query in queries]]
    return {
        "queries": len(queries),
        "sent": share(len(sent), len(queries)),
        "payload_in_time": share(sum(q["payload_in_time"] for q in queries), len(queries)),
        "payload_in_time_of_sent": share(sum(q["payload_in_time"] for q in sent), len(sent)),
        "answer_in_time": share(sum(q["answer_in_time"] for q in queries), len(queries)),
        "answer_in_time_of_sent": share(sum(q["answer_in_time"] for q in sent), len(sent)),
        "answer_in_time_undisturbed": share(
            sum(q["answer_in_time"] for q in undisturbed), len(undisturbed)
        ),
        "useful_answer_in_time": share(
            sum(q["answer_in_time"] and q["tokens_used"] >= USEFUL_TOKENS for q in queries),
            len(queries),
        ),
        "larger_than_capacity": share(int((offered > own).sum()), len(queries)),
        "payload_complete_after_s": percentiles([q["complete_after_s"] for q in sent]),
        "answered_after_s": percentiles([q["answered_after_s"] for q in sent]),
        "started_late_s": percentiles([q["late_s"] for q in queries]),
        "tokens": percentiles(tokens) | {"mean": float(tokens.mean())},
        "tokens_used": percentiles(used) | {"mean": float(used.mean())},
        "fewer_than_useful": share(int((tokens < USEFUL_TOKENS).sum()), len(queries)),
        "reasons": _counts(query["reason"] for query in queries),
        "bytes": {
            "payload": sum(query["payload_bytes"] for query in queries),
            "framed": sum(query["framed_bytes"] for query in queries),
            "ip_up": captured.up.bytes,
            "ip_up_sent_again": captured.up.repeated_bytes,
            "ip_down": captured.down.bytes,
            "capacity": float(capacity.sum()),
        },
        "backlog": _backlog(queries, profile.period_s),
        "link": link_honesty(captured.period_bytes, capacity, mtu_bytes),
        "packets_missed_by_capture": captured.lost,
    }


def share(count: int, total: int) -> dict[str, Any]:
    """A count, its share, and Wilson's 95 % interval of that."""
    low, high = wilson_interval(count, total)
    return {
        "count": count,
        "of": total,
        "share": count / total if total else None,
        "low": low,
        "high": high,
    }


def percentiles(values: Iterable[float | None] | np.ndarray[Any, Any]) -> dict[str, float | None]:
    """1st, 10th, 50th, 90th and 99th percentile and the largest; None where there is nothing."""
    known = [float(value) for value in values if value is not None]
    if not known:
        return dict.fromkeys(("p1", "p10", "p50", "p90", "p99", "max"))
    points = np.percentile(known, [1, 10, 50, 90, 99, 100])
    return dict(zip(("p1", "p10", "p50", "p90", "p99", "max"), points.tolist(), strict=True))


def link_honesty(
    period_bytes: Sequence[int], capacity: np.ndarray[Any, Any], mtu_bytes: int
) -> dict[str, Any]:
    """Whether the emulated link kept to its capacity, in bytes of IP packets per period.

    A packet belongs to the period in which it left, and one that began before may leave after: one
    packet more than the capacity is the resolution of the thing.
    """
    passed = np.zeros_like(capacity)
    count = min(len(period_bytes), len(capacity))
    passed[:count] = period_bytes[:count]
    excess = passed - capacity
    return {
        "periods": len(capacity),
        "over_capacity": share(int((excess > mtu_bytes).sum()), len(capacity)),
        "largest_excess_bytes": float(excess.max()) if len(excess) else None,
        "passed_share_of_capacity": float(passed.sum() / capacity.sum()) if len(capacity) else None,
    }


def _backlog(queries: Sequence[dict[str, Any]], period_s: float) -> dict[str, Any]:
    """Payloads that were not through when their period ended."""
    sent = [query for query in queries if query["sent"]]
    late = [query for query in sent if not query["payload_in_time"]]
    lateness = [
        query["complete_after_s"] - period_s
        for query in late
        if query["complete_after_s"] is not None
    ]
    return {
        "late_payloads": share(len(late), len(sent)),
        "never_complete": sum(query["complete_after_s"] is None for query in late),
        "late_by_s": percentiles(lateness),
    }


def _ip_bytes(framed_bytes: int, mtu_bytes: int) -> int:
    """A request with its call's headers and acknowledgement, in IP packets."""
    if not framed_bytes:
        return 0
    room = mtu_bytes - 52
    stream = framed_bytes + codec.CALL_HEADERS_BYTES
    return stream + 52 * (-(-stream // room) + 1)


def _counts(reasons: Iterable[str | None]) -> dict[str, int]:
    counts: dict[str, int] = {}
    for reason in reasons:
        counts[reason or "answered"] = counts.get(reason or "answered", 0) + 1
    return counts
