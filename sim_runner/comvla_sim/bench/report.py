"""A benchmark's result for a person to read."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from comvla_sim.bench.table import milliseconds, render

_TIMES: dict[str, Callable[[Any], str]] = {
    "median_s": milliseconds,
    "p99_s": milliseconds,
}
_HEADS = {
    "name": "",
    "median_s": "median ms",
    "p99_s": "p99 ms",
    "ratio_to_tcp": "x raw TCP",
    "p99_ratio_to_tcp": "p99 x raw TCP",
    "ratio_to_websocket": "x websocket",
    "ratio_to_vote_limit": "x vote limit",
    "requests_per_s": "requests/s",
    "mean_batch": "mean batch",
    "answered": "answered",
    "repetitions": "calls",
}


def describe(result: Mapping[str, Any]) -> str:
    """The rows as a table, with where and how often they were measured."""
    columns = [name for name in _HEADS if name in result["rows"][0]]
    table = render(
        [_HEADS[name] for name in columns],
        [[_cell(name, row[name]) for name in columns] for row in result["rows"]],
    )
    return "\n".join([_heading(result), "", table, *_conclusions(result)])


def _cell(name: str, value: Any) -> str:
    if name in _TIMES:
        return _TIMES[name](value)
    return f"{value:.2f}" if isinstance(value, float) else str(value)


def _heading(result: Mapping[str, Any]) -> str:
    where = result["environment"]
    load = where["load_average"]
    busy = "" if load is None else f", load {load:.1f}"
    return f"{result['bench']} on {where['cpu']}, {where['cores']} cores{busy}"


def _conclusions(result: Mapping[str, Any]) -> list[str]:
    if "throughput_ratio" in result:
        return ["", f"throughput with batching: {result['throughput_ratio']:.2f} x batches of one"]
    if "vote_limit_s" in result:
        rate = result["matrix_rate_flops_per_s"] / 1e9
        limit = milliseconds(result["vote_limit_s"])
        return [
            "",
            f"vote limit: {limit} ms, its three products at the {rate:.0f} GFLOP/s measured",
        ]
    return []
