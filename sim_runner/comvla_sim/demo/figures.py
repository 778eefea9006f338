"""The demo in numbers: over the fading link, and against full transmission."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import mean, median
from typing import Any

from comvla_sim.demo.episode import Episode, Query


@dataclass(frozen=True)
class Figures:
    """Sums and medians over episodes of one way of sending.

    Attributes:
        episodes: how many.
        successes: how many of them.
        queries: requests that the cloud answered.
        holds: steps without an answer.
        tokens: mean per request; tokens_min and tokens_max its range.
        payload_bytes: mean per request as the paper counts (K·D·B/8).
        wire_bytes: mean per request of everything on the wire.
        episode_bytes: mean per episode of everything on the wire.
        air_s: median time that a request was on the air, seconds; None where nobody knows.
        compute_s: median time from observation to actions without the air, seconds.
        edge_flops: mean per request on the robot.
        cloud_flops: mean per request in the cloud.
    """

    episodes: int
    successes: int
    queries: int
    holds: int
    tokens: float
    tokens_min: int
    tokens_max: int
    payload_bytes: float
    wire_bytes: float
    episode_bytes: float
    air_s: float | None
    compute_s: float
    edge_flops: float
    cloud_flops: float


def figures_of(episodes: Sequence[Episode], air_s: Iterable[float] = ()) -> Figures:
    """Figures of episodes; zeros where nothing was answered.

    Args:
        episodes: at least one.
        air_s: time on the air of requests, where it is not in the link's records.
    """
    queries = [query for episode in episodes for query in episode.queries]
    answered = [query.report for query in queries if query.report.source == "cloud"]
    measured_air_s = [q.record.airtime_s for q in queries if q.record] or list(air_s)
    total_bytes = sum(query.report.framed_bytes for query in queries)
    tokens = [report.tokens for report in answered] or [0]
    return Figures(
        episodes=len(episodes),
        successes=sum(episode.success for episode in episodes),
        queries=len(answered),
        holds=len(queries) - len(answered),
        tokens=mean(tokens),
        tokens_min=min(tokens),
        tokens_max=max(tokens),
        payload_bytes=_mean(report.payload_bytes for report in answered),
        wire_bytes=_mean(report.framed_bytes for report in answered),
        episode_bytes=total_bytes / len(episodes),
        air_s=median(measured_air_s) if measured_air_s else None,
        compute_s=median([report.timings_s["total"] for report in answered] or [0.0]),
        edge_flops=_mean(report.edge_flops for report in answered),
        cloud_flops=_mean(report.cloud_flops for report in answered),
    )


def _mean(values: Iterable[float]) -> float:
    known = list(values)
    return float(mean(known)) if known else 0.0


@dataclass(frozen=True)
class LinkUse:
    """Whether the link's limit was kept.

    Attributes:
        requests: that were put on the air.
        above_capacity: requests larger than what their period carried.
        largest_share: of a period's capacity that a request took, 0 to 1.
    """

    requests: int
    above_capacity: int
    largest_share: float


def link_use(episodes: Sequence[Episode]) -> LinkUse:
    """What the link's own records say, over all episodes."""
    records = [q.record for episode in episodes for q in episode.queries if q.record is not None]
    return LinkUse(
        requests=len(records),
        above_capacity=sum(8 * r.offered_bytes > r.available_bits for r in records),
        largest_share=max((8 * r.offered_bytes / r.capacity_bits for r in records), default=0.0),
    )


def air_time_s(bits: float, capacity_bits: Iterable[float], period_s: float) -> float:
    """How long ``bits`` take when they may use one control period after another.

    Args:
        bits: to send.
        capacity_bits: of the periods from the first on.
        period_s: T, seconds.

    Returns:
        Seconds; infinite where the periods end before.
    """
    for number, capacity in enumerate(capacity_bits):
        if bits <= capacity:
            return (number + bits / capacity) * period_s if bits else number * period_s
        bits -= capacity
    return math.inf


def query_line(query: Query) -> dict[str, Any]:
    """What the page shows of a request, as JSON values with short names."""
    report, record = query.report, query.record
    return {
        "t": query.period,
        "source": report.source,
        "reason": report.fallback_reason,
        "budget": report.token_budget,
        "tokens": report.tokens,
        "positions": report.positions.tolist(),
        "bytes": report.framed_bytes if record is None else record.offered_bytes,
        "capacity": None if record is None else round(record.capacity_bits / 8),
        "ms": round(1000 * report.timings_s["total"], 1),
    }
