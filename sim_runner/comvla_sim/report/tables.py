"""Results as tables: built once, written as Markdown or HTML."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

from comvla_sim.experiments.methods import shown_k
from comvla_sim.experiments.statistics import p_text
from comvla_sim.report.terminal import entry_name, method_name, percent

_OWN = "its own size"
_LINK = "K = link"


@dataclass(frozen=True)
class Table:
    """A table of text.

    Attributes:
        title: heading.
        note: what the figures mean, in a sentence or two.
        header: names of the columns; the first names the rows.
        rows: cells.
    """

    title: str
    note: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def markdown(self) -> str:
        """GitHub-flavoured Markdown, numbers to the right."""
        lines = [self.header, ("---", *["---:"] * (len(self.header) - 1)), *self.rows]
        body = "\n".join(
            "| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines
        )
        return f"### {self.title}\n\n{self.note}\n\n{body}\n"

    def html(self) -> str:
        """A section with a table that scrolls by itself where the page is narrow."""
        head = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in self.header)
        body = "".join(
            f'<tr><th scope="row">{escape(row[0])}</th>'
            + "".join(f"<td>{escape(cell)}</td>" for cell in row[1:])
            + "</tr>"
            for row in self.rows
        )
        return (
            f"<section><h3>{escape(self.title)}</h3><p>{escape(self.note)}</p>"
            f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody>'
            "</table></div></section>"
        )


def rate_with_interval(counts: dict[str, Any]) -> str:
    """A success rate in percent with its interval, e.g. ``95.0 (89.1–97.8)``."""
    rate = counts["successes"] / counts["episodes"]
    return f"{percent(rate)} ({percent(counts['low'])}–{percent(counts['high'])})"


def all_tables(summary: dict[str, Any]) -> list[Table]:
    """Every table of one evaluation, in reading order.

    Args:
        summary: of :func:`comvla_sim.experiments.summary.summarise`.
    """
    tables = [
        _success_by_k(summary["aggregate"]),
        _by_task(summary["rows"]),
        _wrong_instruction(summary["aggregate"]),
        _selection(summary["aggregate"]),
        _costs(summary["aggregate"]),
        _comparisons(summary["comparisons"]),
    ]
    return [table for table in tables if table.rows]


def _success_by_k(lines: Sequence[dict[str, Any]]) -> Table:
    found = {_head(line): line["k"] for line in lines}
    ks = sorted((k for head, k in found.items() if head not in (_LINK, _OWN)), reverse=True)
    heads = [*(f"K = {k}" for k in ks), *(head for head in (_LINK, _OWN) if head in found)]
    cells = {(_series(line), _head(line)): rate_with_interval(line) for line in lines}
    names = dict.fromkeys(_series(line) for line in lines)
    counts = sorted({line["episodes"] for line in lines})
    episodes = " to ".join(str(n) for n in dict.fromkeys((counts[0], counts[-1])))
    return Table(
        "Success by number of tokens",
        f"Percent of episodes over all instructions with 95 % Wilson intervals; {episodes} episodes "
        "per cell, the same layouts everywhere.",
        ("method", *heads),
        tuple((name, *(cells.get((name, head), "–") for head in heads)) for name in names),
    )


def _head(line: dict[str, Any]) -> str:
    k = shown_k(line["method"], line["k"])
    return f"K = {k}" if k.isdigit() or line["k"] is None else _OWN


def _series(line: dict[str, Any]) -> str:
    method = method_name(line)
    return method if line["condition"] == "normal" else f"{line['condition']}: {method}"


def _by_task(lines: Sequence[dict[str, Any]]) -> Table:
    entries = dict.fromkeys(entry_name(line) for line in lines)
    tasks = dict.fromkeys((line["task"], line["instruction"]) for line in lines)
    cells = {
        (entry_name(line), line["task"]): f"{line['successes']}/{line['episodes']}"
        for line in lines
    }
    return Table(
        "Successes by instruction",
        "Instructions: " + "; ".join(f"{name}: “{text}”" for name, text in tasks) + ".",
        ("method, K", *(name for name, _ in tasks)),
        tuple((entry, *(cells.get((entry, name), "–") for name, _ in tasks)) for entry in entries),
    )


def _wrong_instruction(lines: Sequence[dict[str, Any]]) -> Table:
    return Table(
        "Wrong instruction",
        "The robot is given the instruction of another fixture on the same table. The true task "
        "should stay undone, the named one be done.",
        ("method, K", "true task", "named task"),
        tuple(
            (entry_name(line), rate_with_interval(line), rate_with_interval(line["other"]))
            for line in lines
            if line["other"]
        ),
    )


def _selection(lines: Sequence[dict[str, Any]]) -> Table:
    def row(line: dict[str, Any]) -> tuple[str, ...]:
        selection = line["selection"]
        votes, overlap = selection["distinct_votes"], selection["overlap_with_other_instruction"]
        return (
            entry_name(line),
            str(selection["frames"]),
            "–" if votes is None else f"{votes:.1f}",
            "–" if overlap is None else f"{overlap:.2f}",
            percent(selection["object_hit_rate"]),
            " / ".join(percent(rate) for rate in selection["object_hit_rate_by_view"]),
        )

    return Table(
        "What was selected",
        "Means over frames. Distinct votes: tokens that got at least one vote. Overlap: share of the "
        "kept tokens that another fixture's instruction would also keep in the same picture. Object "
        "kept: how often the token that shows the named object was sent, in any view and by view.",
        ("method, K", "frames", "distinct votes", "overlap", "object kept %", "by view %"),
        tuple(row(line) for line in lines),
    )


def _costs(lines: Sequence[dict[str, Any]]) -> Table:
    def row(line: dict[str, Any]) -> tuple[str, ...]:
        steps = line["mean_steps_of_successes"]
        return (
            entry_name(line),
            f"{line['payload_bytes_per_query'] / 1024:.2f}",
            f"{line['framed_bytes_per_query'] / 1024:.2f}",
            f"{line['edge_flops_per_query'] / 1e6:.1f}",
            f"{line['cloud_flops_per_query'] / 1e6:.1f}",
            "–" if steps is None else f"{steps:.0f}",
        )

    return Table(
        "What a query costs",
        "Payload as the paper counts it (K·D·B/8) and all bytes on the wire, KiB; millions of "
        "floating-point operations; control steps of successful episodes.",
        ("method, K", "payload KiB", "wire KiB", "edge MFLOP", "cloud MFLOP", "steps"),
        tuple(row(line) for line in lines),
    )


def _comparisons(lines: Sequence[dict[str, Any]]) -> Table:
    return Table(
        "Paired tests",
        "Exact McNemar tests on the same layouts and instructions; p is two-sided and not corrected "
        "for the number of tests.",
        ("first", "second", "pairs", "only first", "only second", "p"),
        tuple(
            (
                entry_name(line["first"]),
                entry_name(line["second"]),
                str(line["pairs"]),
                str(line["only_first"]),
                str(line["only_second"]),
                p_text(line["p_value"]),
            )
            for line in lines
        ),
    )
