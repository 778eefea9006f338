"""A summary as tables on the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from comvla_sim.experiments.link_case import LinkCase
from comvla_sim.experiments.methods import shown_k
from comvla_sim.experiments.statistics import p_text

_MAX_COMPARISONS = 12

Line = dict[str, Any]


def percent(value: float | None) -> str:
    """A share as a percentage with one decimal; a dash for None."""
    return "–" if value is None else f"{100 * value:.1f}"


def entry_name(entry: Line) -> str:
    """Condition, method and K in a few words; the normal condition goes without saying."""
    k = "" if entry["method"] == "full" else shown_k(entry["method"], entry["k"])
    method = f"{entry['method']} {k}" if k.isdigit() else entry["method"]
    if entry.get("link"):
        method = f"{method} over {LinkCase.from_dict(entry['link']).label}"
    return method if entry["condition"] == "normal" else f"{entry['condition']}: {method}"


def method_name(line: Line) -> str:
    """Method and link in a few words."""
    link = line.get("link")
    return line["method"] if not link else f"{line['method']} over {LinkCase.from_dict(link).label}"


def print_summary(summary: dict[str, Any], console: Console | None = None) -> None:
    """Prints successes over all tasks and by task for each condition, and the paired tests.

    Args:
        summary: of :func:`comvla_sim.experiments.summary.summarise`.
        console: standard output by default.
    """
    console = console or Console()
    for condition in dict.fromkeys(line["condition"] for line in summary["aggregate"]):
        lines = [line for line in summary["aggregate"] if line["condition"] == condition]
        console.print(f"{condition}: success over all instructions", style="bold")
        console.print(_over_all_tasks(lines))
        lines = [line for line in summary["rows"] if line["condition"] == condition]
        _print_by_task(condition, lines, console)
    console.print(
        "bytes: on the wire per query; votes: distinct tokens that got one; hit: the named object's "
        "token was sent.",
        style="dim",
    )
    _print_comparisons(summary["comparisons"], console)


def _table(texts: Sequence[str], numbers: Sequence[str]) -> Table:
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 0, 0, 1))
    for name in texts:
        table.add_column(name, overflow="fold", min_width=11)
    for name in numbers:
        table.add_column(name, justify="right")
    return table


def _over_all_tasks(lines: Sequence[Line]) -> Table:
    names = ["K", "success", "%", "95 % interval", "bytes", "votes", "hit %"]
    misled = any(line["other"] for line in lines)
    if misled:
        names.append("other %")
    table = _table(["method"], names)
    for line in lines:
        other, selection = line["other"], line["selection"]
        votes = selection["distinct_votes"]
        cells = [
            method_name(line),
            shown_k(line["method"], line["k"]),
            f"{line['successes']}/{line['episodes']}",
            percent(line["success_rate"]),
            f"{percent(line['low'])}–{percent(line['high'])}",
            f"{line['framed_bytes_per_query']:.0f}",
            "–" if votes is None else f"{votes:.1f}",
            percent(selection["object_hit_rate"]),
        ]
        if misled:
            cells.append(percent(other["successes"] / other["episodes"]) if other else "–")
        table.add_row(*cells)
    return table


def _print_by_task(condition: str, lines: Sequence[Line], console: Console) -> None:
    tasks = list(dict.fromkeys(line["task"] for line in lines))
    counts = {line["episodes"] for line in lines}
    equal = len(counts) == 1
    title = f"{condition}: successes by task" + (f", of {min(counts)}" if equal else "")
    cells = {
        (method_name(line), line["k"], line["task"]): str(line["successes"])
        if equal
        else f"{line['successes']}/{line['episodes']}"
        for line in lines
    }
    # Names such as drawer-open over two lines: eight of them fit on a terminal.
    heads = ["K", *(task.replace("-", "\n") for task in tasks)]
    table = _table(["method"], heads)
    for name, k, method in dict.fromkeys((method_name(x), x["k"], x["method"]) for x in lines):
        row = (cells.get((name, k, task), "–") for task in tasks)
        table.add_row(name, shown_k(method, k), *row)
    console.print(title, style="bold")
    console.print(table)


def _print_comparisons(lines: Sequence[Line], console: Console) -> None:
    """Methods against methods; what conditions do needs no test and is in the JSON."""
    between = [line for line in lines if line["first"]["condition"] == line["second"]["condition"]]
    between = [line for line in between if line["first"]["condition"] == "normal"]
    if not between:
        return
    table = _table(["first", "second"], ["pairs", "only first", "only second", "p"])
    for line in sorted(between, key=lambda line: float(line["p_value"]))[:_MAX_COMPARISONS]:
        names = (entry_name(line["first"]), entry_name(line["second"]))
        counts = (str(line[key]) for key in ("pairs", "only_first", "only_second"))
        table.add_row(*names, *counts, p_text(line["p_value"]))
    console.print("Paired episodes, exact McNemar test", style="bold")
    console.print(table)
    hidden = len(lines) - min(len(between), _MAX_COMPARISONS)
    if hidden > 0:
        console.print(f"and {hidden} more pairs: --json, or comvla-sim report, shows all")
