"""Results of the benches of a server's life for a person to read."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

HEADS = {
    "kills": "kills",
    "episodes": "episodes",
    "success": "success",
    "success_low": "95 % from",
    "success_high": "to",
    "success_in_plain_limit": "in plain limit",
    "fallbacks": "unanswered",
    "held_periods": "held periods",
    "exceptions": "exceptions",
    "failed": "failed",
    "killed": "killed",
}


def conclusions(result: Mapping[str, Any]) -> list[str]:
    """What the figures say, in sentences; none for other benches."""
    words = _WORDS.get(result["bench"])
    return [] if words is None else ["", *words(result)]


def _kills(result: Mapping[str, Any]) -> list[str]:
    lines = [
        f"success lost by kills: {result['points_lost']:.1f} points (only undisturbed "
        f"{result['only_undisturbed']}, only with kills {result['only_with_kills']}, "
        f"p = {result['p_value']:.2f})"
    ]
    if result["recovery_periods_worst"] is not None:
        lines.append(
            f"recovery after the server was back: median {result['recovery_periods_median']:.2f}, worst "
            f"{result['recovery_periods_worst']:.2f} control periods of {result['period_s']:g} s; within 2 "
            f"in {result['recovered_within_2_periods']} of {len(result['outages'])}"
        )
        lines.append(
            f"the server was down for {result['down_s_median']:.2f} s (median); {result['kills_in_motion']} of "
            f"{len(result['outages'])} kills fell while the task was under way"
        )
    return lines + [f"exception: {text}" for text in result["exceptions"]]


def _swap(result: Mapping[str, Any]) -> list[str]:
    swaps, memory = result["swaps"], result["resident_bytes"]
    lines = [
        f"{result['failed']} of {result['calls']} calls failed in {len(swaps)} swaps; "
        f"{result['distinct_answers']} models answered; the old one was freed {result['freed']} times",
        f"needed {swaps[0]['needed_bytes'] / 1e6:.1f} MB; loaded in "
        f"{max(s['load_s'] for s in swaps):.2f} s, warm after {max(s['warm_up_s'] for s in swaps):.2f} s, "
        f"old one done after {max(s['drain_s'] for s in swaps):.3f} s (worst of all)",
    ]
    if None not in memory:
        lines.append("resident MB: " + ", ".join(f"{m / 1e6:.0f}" for m in memory))
    return lines + [f"failure: {text}" for text in result["failures"]]


def _replicas(result: Mapping[str, Any]) -> list[str]:
    lines = []
    for kind, words in (("plain", "plain servers, robots take turns"), ("ray", "Ray's replicas")):
        figures = result.get(kind)
        if figures is None:
            continue
        lines.append(
            f"{words}: two give {figures['throughput_ratio']:.2f} x the throughput of one; with one of "
            f"two killed under load {figures['lost_steps']} steps were lost"
        )
    if "ray_added_s" in result:
        lines.append(f"Ray's proxy adds {1e3 * result['ray_added_s']:.2f} ms to a call (median)")
    return lines + [f"left out: {text}" for text in result["left_out"]]


_WORDS: dict[str, Callable[[Mapping[str, Any]], list[str]]] = {
    "kills": _kills,
    "swap": _swap,
    "replicas": _replicas,
}
