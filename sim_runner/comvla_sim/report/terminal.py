"""A summary as tables on the terminal."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.table import Table

_MAX_COMPARISONS = 12


def percent(value: float | None) -> str:
    """A share as a percentage with one decimal; a dash for None."""
    return "–" if value is None else f"{100 * value:.1f}"


def entry_name(entry: dict[str, Any]) -> str:
    """Condition, method and K in a few words; the normal condition goes without saying."""
    method = "full" if entry["method"] == "full" else f"{entry['method']} {entry['k']}"
    return method if entry["condition"] == "normal" else f"{entry['condition']}: {method}"


def print_summary(summary: dict[str, Any], console: Console | None = None) -> None:
    """Prints aggregate, successes by instruction, and the paired tests.

    Args:
        summary: of :func:`comvla_sim.experiments.summary.summarise`.
        console: standard output by default.
    """
    console = console or Console()
    console.print(_aggregate(summary["aggregate"]))
    console.print(_by_task(summary["rows"]))
    if summary["comparisons"]:
        console.print(_comparisons(summary["comparisons"]))
        hidden = len(summary["comparisons"]) - _MAX_COMPARISONS
        if hidden > 0:
            console.print(f"and {hidden} more pairs: --json, or comvla-sim report, shows all")


def _table(title: str, *names: str) -> Table:
    table = Table(title=title, title_justify="left")
    for name in names:
        table.add_column(name)
    return table


def _aggregate(lines: list[dict[str, Any]]) -> Table:
    table = _table("Success over all instructions (95 % Wilson intervals)", "method, K")
    for name in ("success", "%", "interval", "other %", "bytes/query", "votes", "hit %"):
        table.add_column(name, justify="right", no_wrap=True)
    for line in lines:
        other, selection = line["other"], line["selection"]
        votes = selection["distinct_votes"]
        table.add_row(
            entry_name(line),
            f"{line['successes']}/{line['episodes']}",
            percent(line["success_rate"]),
            f"{percent(line['low'])}–{percent(line['high'])}",
            percent(other["successes"] / other["episodes"]) if other else "–",
            f"{line['framed_bytes_per_query']:.0f}",
            "–" if votes is None else f"{votes:.1f}",
            percent(selection["object_hit_rate"]),
        )
    return table


def _by_task(lines: list[dict[str, Any]]) -> Table:
    entries = list(dict.fromkeys(entry_name(line) for line in lines))
    tasks = list(dict.fromkeys(line["task"] for line in lines))
    cells = {
        (entry_name(line), line["task"]): f"{line['successes']}/{line['episodes']}"
        for line in lines
    }
    table = _table("Successes by task", "method, K")
    for task in tasks:
        table.add_column(task, justify="right")
    for entry in entries:
        table.add_row(entry, *(cells.get((entry, task), "–") for task in tasks))
    return table


def _comparisons(lines: list[dict[str, Any]]) -> Table:
    table = _table("Paired episodes, exact McNemar test", "first", "second")
    for name in ("pairs", "only first", "only second", "p"):
        table.add_column(name, justify="right", no_wrap=True)
    for line in sorted(lines, key=lambda line: float(line["p_value"]))[:_MAX_COMPARISONS]:
        names = (entry_name(line["first"]), entry_name(line["second"]))
        counts = (str(line[key]) for key in ("pairs", "only_first", "only_second"))
        table.add_row(*names, *counts, f"{line['p_value']:.2g}")
    return table
