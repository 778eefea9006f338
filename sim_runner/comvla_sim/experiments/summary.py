"""From rows of episodes to counts, intervals and paired tests."""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import asdict, astuple
from typing import Any

from comvla_sim.experiments.link_case import LinkCase
from comvla_sim.experiments.methods import order
from comvla_sim.experiments.plan import CONDITIONS, FULL
from comvla_sim.experiments.results import Row, spec_of
from comvla_sim.experiments.statistics import mcnemar, wilson_interval

_USES = ("csi_delay", "enforce", "sending", "budget", "useful_tokens")

Entry = tuple[str, str, "int | None", "LinkCase | None"]
"""Condition, method, K, link."""


def summarise(rows: Iterable[Row]) -> dict[str, Any]:
    """All figures of one evaluation, as plain JSON values.

    Args:
        rows: episodes measured under equal settings.

    Returns:
        ``rows``: per condition, method, K, link and instruction: episodes, successes and their
        Wilson interval. ``aggregate``: the same over all instructions, with bytes, FLOPs, what the
        link did, and selection statistics. ``comparisons``: exact McNemar tests on equal episodes.
    """
    groups: dict[Entry, list[Row]] = defaultdict(list)
    for row in rows:
        spec = spec_of(row)
        groups[spec.condition, spec.method, spec.k, spec.link].append(row)
    entries = sorted(groups, key=_order)
    return {
        "rows": [line for entry in entries for line in _by_instruction(entry, groups[entry])],
        "aggregate": [_aggregate(entry, groups[entry]) for entry in entries],
        "comparisons": [
            _compare(a, b, groups[a], groups[b])
            for a, b in itertools.combinations(entries, 2)
            if _comparable(a, b)
        ],
    }


def _order(entry: Entry) -> tuple[Any, ...]:
    condition, method, k, link = entry
    case = () if link is None else (1, *astuple(link))
    return CONDITIONS.index(condition), case, order(method), -(k or 0)


def _comparable(first: Entry, second: Entry) -> bool:
    """What differs in one thing: method, K against full transmission, condition, use of the link."""
    if first[3] != second[3]:
        return first[:3] == second[:3] and _one_use_differs(first[3], second[3])
    if first[0] == second[0]:
        return first[2] == second[2] or FULL in (first[1], second[1])
    return "normal" in (first[0], second[0]) and first[1:] == second[1:]


def _one_use_differs(first: LinkCase | None, second: LinkCase | None) -> bool:
    """Two ways of using one link, not two links."""
    if first is None or second is None:
        return False
    a, b = first.to_dict(), second.to_dict()
    different = [key for key in a if a[key] != b[key]]
    return len(different) == 1 and different[0] in _USES


def _counts(rows: Sequence[Row], key: str = "success") -> dict[str, Any]:
    successes = sum(bool(row[key]) for row in rows)
    low, high = wilson_interval(successes, len(rows))
    return {
        "episodes": len(rows),
        "successes": successes,
        "low": round(low, 6),
        "high": round(high, 6),
    }


def _other_counts(rows: Sequence[Row]) -> dict[str, Any] | None:
    """How often the other, wrongly named task succeeded; None unless it was named."""
    if not rows or rows[0]["condition"] != "wrong_instruction":
        return None
    return _counts(rows, "other_success")


def _named(entry: Entry) -> dict[str, Any]:
    condition, method, k, link = entry
    case = None if link is None else link.to_dict()
    return {"condition": condition, "method": method, "k": k, "link": case}


def _by_instruction(entry: Entry, rows: Sequence[Row]) -> list[dict[str, Any]]:
    tasks: dict[tuple[str, str], list[Row]] = defaultdict(list)
    for row in rows:
        tasks[row["task"], row["instruction"]].append(row)
    return [
        {
            **_named(entry),
            "task": task,
            "instruction": instruction,
            **_counts(group),
            "other": _other_counts(group),
        }
        for (task, instruction), group in sorted(tasks.items())
    ]


def _aggregate(entry: Entry, rows: Sequence[Row]) -> dict[str, Any]:
    counts = _counts(rows)
    per_task = _by_instruction(entry, rows)
    worst = min(per_task, key=lambda line: line["successes"] / line["episodes"])
    queries = int(sum(row["queries"] for row in rows))
    solved = [row["steps"] for row in rows if row["success"]]

    def per_query(key: str) -> float:
        return round(math.fsum(row[key] for row in rows) / queries, 1)

    return {
        **_named(entry),
        **counts,
        "success_rate": round(counts["successes"] / counts["episodes"], 4),
        "worst_task": worst["task"],
        "worst_task_rate": round(worst["successes"] / worst["episodes"], 4),
        "other": _other_counts(rows),
        "mean_steps_of_successes": round(sum(solved) / len(solved), 1) if solved else None,
        "queries": queries,
        "payload_bytes_per_query": per_query("payload_bytes"),
        "framed_bytes_per_query": per_query("framed_bytes"),
        "edge_flops_per_query": per_query("edge_flops"),
        "cloud_flops_per_query": per_query("cloud_flops"),
        "link_use": link_use([row["link_use"] for row in rows if row["link_use"]]),
        "wall_s": round(sum(row["wall_s"] for row in rows), 1),
        "selection": _selection([row["selection"] for row in rows]),
    }


def link_use(episodes: Sequence[dict[str, Any]]) -> dict[str, Any] | None:
    """Sums over episodes, shares of queries, and percentiles of the overruns; None without any.

    Args:
        episodes: ``link_use`` of rows.
    """
    if not episodes:
        return None
    lists = ("overruns", "payload_overruns")
    total = {key: sum(e[key] for e in episodes) for key in episodes[0] if key not in lists}
    queries = total["sent"] + total["no_link"]
    use: dict[str, Any] = {**total, "answered_share": _share(total["answered"], queries)}
    for key in lists:
        ratios = sorted(ratio for e in episodes for ratio in e[key])
        above = sum(ratio > 1 for ratio in ratios)
        low, high = wilson_interval(above, len(ratios))
        use[key] = {
            "requests": len(ratios),
            "above_capacity": above,
            "share": _share(above, len(ratios)),
            "low": round(low, 6),
            "high": round(high, 6),
            **{f"p{p}": _percentile(ratios, p) for p in (50, 90, 99)},
        }
    return use


def _share(part: int, whole: int) -> float | None:
    return round(part / whole, 4) if whole else None


def _percentile(ordered: Sequence[float], percent: int) -> float | None:
    """The smallest value that at least so many percent do not exceed."""
    if not ordered:
        return None
    return ordered[max(0, math.ceil(len(ordered) * percent / 100) - 1)]


def _selection(episodes: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Means over frames. Frames of one episode are alike, so they get no interval."""

    def mean(key: str, over: str) -> float | None:
        known = [e for e in episodes if e[key] is not None and e[over]]
        frames = sum(e[over] for e in known)
        return round(sum(e[key] for e in known) / frames, 4) if frames else None

    frames_by_view = _sum_by_view([e["object_frames_by_view"] for e in episodes])
    hits_by_view = _sum_by_view([e["object_hits_by_view"] for e in episodes])
    return {
        "frames": sum(e["frames"] for e in episodes),
        "distinct_votes": mean("distinct_votes", "frames"),
        "overlap_with_other_instruction": mean("overlap", "frames"),
        "object_hit_rate": mean("object_hits", "object_frames"),
        "object_hit_rate_by_view": [
            round(hits / frames, 4) if frames else None
            for hits, frames in zip(hits_by_view, frames_by_view, strict=True)
        ],
    }


def _sum_by_view(counts: Sequence[Sequence[int]]) -> list[int]:
    return [sum(view) for view in zip(*counts, strict=True)]


def _compare(
    first: Entry, second: Entry, first_rows: Sequence[Row], second_rows: Sequence[Row]
) -> dict[str, Any]:
    outcomes = {_episode(row): bool(row["success"]) for row in second_rows}
    pairs = [
        (bool(row["success"]), outcomes[_episode(row)])
        for row in first_rows
        if _episode(row) in outcomes
    ]
    test = mcnemar([a for a, _ in pairs], [b for _, b in pairs])
    return {"first": _named(first), "second": _named(second), **asdict(test)}


def _episode(row: Row) -> tuple[int, str]:
    """What makes two episodes a pair: the layout, which holds seed and number, and the task."""
    return row["layout_seed"], row["task"]
