"""A benchmark's result for a person to read."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from comvla_sim.bench import lifecycle_report
from comvla_sim.bench.table import milliseconds, percent, render

_TIMES: dict[str, Callable[[Any], str]] = {
    "median_s": milliseconds,
    "p99_s": milliseconds,
    "products_s": milliseconds,
    "layer_s": milliseconds,
    "hf_layer_s": milliseconds,
    "p90_s": milliseconds,
    "worst_s": milliseconds,
    "bytes_per_query": lambda value: f"{value:.0f}",
    "p50_s": milliseconds,
    "in_time_share": percent,
    "served_share": percent,
    "shed_share": percent,
    "superseded_share": percent,
    "late_share": percent,
    "paused_share": percent,
    "server_cpu": percent,
    "generator_cpu": percent,
    "mean_tokens": lambda value: f"{value:.0f}",
    "offered_per_s": lambda value: f"{value:.0f}",
    "resident_mib": lambda value: f"{value:.1f}",
    "descriptors": lambda value: f"{value:.0f}",
}
_HEADS = {
    "name": "",
    "median_s": "median ms",
    "p99_s": "p99 ms",
    "sequence": "rows",
    "products_s": "products ms",
    "ratio_to_products": "x products",
    "tflops_per_s": "TFLOP/s",
    "layer_s": "layer ms",
    "hf_layer_s": "transformers ms",
    "layer_over_hf": "x transformers",
    "ratio_to_tcp": "x raw TCP",
    "p99_ratio_to_tcp": "p99 x raw TCP",
    "ratio_to_websocket": "x websocket",
    "ratio_to_vote_limit": "x vote limit",
    "requests_per_s": "requests/s",
    "mean_batch": "mean batch",
    "answered": "answered",
    "p90_s": "p90 ms",
    "worst_s": "worst ms",
    "round_trips": "round trips",
    "bytes_per_query": "bytes a query",
    "needs_root": "needs root",
    "queries": "queries",
    "requests": "requests",
    "ended": "how they ended",
    "under": "under",
    "least_over_percent": "least over %",
    "most_over_percent": "most over %",
    "accounted_bytes": "accounted bytes",
    "captured_bytes": "captured bytes",
    "repeated_bytes": "sent again",
    "repetitions": "calls",
    "load": "load",
    "offered_per_s": "asked/s",
    "goodput_ratio": "goodput x capacity",
    "in_time_share": "admitted in time %",
    "jain": "Jain",
    "served_share": "served in period %",
    "shed_share": "shed %",
    "superseded_share": "superseded %",
    "late_share": "late %",
    "paused_share": "backed off %",
    "mean_tokens": "mean K",
    "p50_s": "median ms",
    "memory_growth_mib": "memory MiB",
    "server_cpu": "server CPU %",
    "generator_cpu": "generator CPU %",
    "resident_mib": "resident MiB",
    "descriptors": "descriptors",
    **lifecycle_report.HEADS,
}


def describe(result: Mapping[str, Any]) -> str:
    """The rows as a table, with where and how often they were measured."""
    if not result["rows"]:  # its time was over before anything began
        return "\n".join([_heading(result), *_conclusions(result)])
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
    if result["bench"] == "model":
        return _model_conclusions(result)
    if result["bench"] == "idle":
        return _idle_conclusions(result)
    if result["bench"] == "overload":
        return _overload_conclusions(result)
    if result["bench"] == "soak":
        return _soak_conclusions(result)
    if result["bench"] == "fuzz":
        return _fuzz_conclusions(result)
    return lifecycle_report.conclusions(result)


def _idle_conclusions(result: Mapping[str, Any]) -> list[str]:
    trip, wire = milliseconds(result["round_trip_s"]), milliseconds(result["serialisation_s"])
    return [
        "",
        f"round trip {trip} ms, bytes of a query on this link {wire} ms; allowed: "
        f"{milliseconds(result['allowed_s'])} ms (1.15 round trips and the bytes)",
    ]


def _overload_conclusions(result: Mapping[str, Any]) -> list[str]:
    first, chosen = result["rows"][0], result["parameters"]
    stub = " (a stub: a pass takes a fixed time and no processor)"
    return [
        "",
        f"model {chosen['model']}{stub if chosen['model'] == 'stub' else ''}, {chosen['robots']} robots that "
        f"would send {chosen['token_budget']} tokens, deadline {milliseconds(first['deadline_s'])} ms; capacity "
        f"{first['capacity_per_s']:.1f} answers/s, measured anew for each server",
        "goals with admission: "
        + ", ".join(f"{_HEADS[name]} {_cell(name, goal)}" for name, goal in result["goals"].items())
        + f": {'met' if result['met'] else 'NOT met'}",
    ]


def _soak_conclusions(result: Mapping[str, Any]) -> list[str]:
    chosen = result["parameters"]
    return [
        "",
        f"model {chosen['model']}, {chosen['robots']} robots at {chosen['load']:g} of {result['capacity_per_s']:.1f} "
        f"answers/s for {chosen['minutes']:g} minutes: {result['answered']} answered, "
        f"{percent(result['answered_share'])} % of what was asked, p99 {milliseconds(result['p99_s'])} ms",
        f"resident memory after the first sixth: {100 * result['growth']:+.2f} %, descriptors: "
        f"{result['descriptors_growth']:+.0f}: {'passed' if result['passed'] else 'FAILED'}",
    ]


def _fuzz_conclusions(result: Mapping[str, Any]) -> list[str]:
    seed = result["parameters"]["seed"]
    lines = ["", f"{result['requests']} requests of seed {seed} in {result['wall_s']:.0f} s"]
    for process in result["memory"]:
        if process["measured"]:
            warm, end = process["warm_bytes"] / 2**20, process["end_bytes"] / 2**20
            files = f"{process['warm_descriptors']} to {process['end_descriptors']} descriptors"
            lines.append(
                f"{process['name']}: {warm:.1f} MiB when warm, {end:.1f} at the end; {files}"
            )
        else:
            lines.append(f"{process['name']}: memory not measured, it did not run for long enough")
    if result["known_ends"]:
        lines.append(
            f"{result['known_ends']} connections ended gRPC's loop (grpcio {result['grpcio']}) by a path "
            "that is no UTF-8: known, see SECURITY.md; not counted as failures. Use grpcio below 1.84"
        )
    for failure in result["failures"]:
        lines.append(f"case {failure['case']} ({failure['kind']}): {failure['what']}")
    if result["failed"]:
        lines.append(f"{result['failed']} cases failed; repeat one: --seed {seed} --only CASE")
    if result["parameters"]["only"] is not None and result["words"]:
        lines.append(f"it was told: {result['words']}")
    lines.append("passed" if result["passed"] else "NOT passed")
    return lines


def _model_conclusions(result: Mapping[str, Any]) -> list[str]:
    weights, peak = result["weight_bytes"] / 1e9, result["peak_bytes"] / 1e9
    lines = [
        "",
        *(["seconds of processor time"] if result["parameters"]["cpu_time"] else []),
        f"weights {weights:.3f} GB, peak memory {peak:.3f} GB: {result['peak_ratio']:.2f} x",
    ]
    if "vision_flops" in result:
        counted, own = result["vision_flops_counted"] / 1e12, result["vision_flops"] / 1e12
        paper = result["paper_vision_tflops"]
        lines.append(
            f"vision TFLOPs: {counted:.4f} by torch's counter, {own:.4f} by formula"
            + (f", {paper} in the paper" if paper else "")
        )
    if "time_512_over_32" in result:
        lines.append(
            f"K = 512 over K = 32: {result['time_512_over_32']:.2f} in time, "
            f"{result['flops_512_over_32']:.2f} in operations of the backbone, Eq. (5)"
        )
    if "transformers" in result:
        lines.append(f"Hugging Face transformers: {result['transformers']}")
    return lines
