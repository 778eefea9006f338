"""The points of a figure as tables: lines down, what was varied across."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from comvla_sim.experiments.statistics import p_text
from comvla_sim.figures.points import Point
from comvla_sim.figures.series import SERIES
from comvla_sim.figures.sweeps import overruns, sized_by_report
from comvla_sim.report.tables import Table
from comvla_sim.report.terminal import percent

Cell = Callable[[Point], str | None]

_DASH = "–"


def tables(figure: str, points: Sequence[Point]) -> list[Table]:
    """All tables of a figure, a set for each channel (and mean SNR, where the age is varied).

    Args:
        figure: ``"fading"`` or ``"csi-delay"``.
        points: of that figure.
    """
    across = "mean_snr_db" if figure == "fading" else "csi_delay"
    fixed = ("channel", "csi_delay") if figure == "fading" else ("channel", "mean_snr_db")
    found = []
    for place in dict.fromkeys(tuple(point.axes[key] for key in fixed) for point in points):
        own = [point for point in points if tuple(point.axes[key] for key in fixed) == place]
        where = _where(dict(zip(fixed, place, strict=True)))
        found += [
            _pivot(f"{what}, {where}", note, own, across, cell) for what, note, cell in _CELLS
        ]
    return [table for table in found if table.rows]


def comparison_table(tests: Sequence[Mapping[str, Any]]) -> Table:
    """Paired tests of lines over all links of a figure together."""
    return Table(
        "Paired tests",
        "All links together, on the same layouts, instructions and fading. A layout's episodes depend on each other, "
        "so p is of an exact sign-flip test over layouts; two-sided, not corrected for the number of tests.",
        ("first", "second", "pairs", "layouts", "only first", "only second", "p"),
        tuple(
            (
                SERIES[test["first"]].label,
                SERIES[test["second"]].label,
                str(test["pairs"]),
                str(test["layouts"]),
                str(test["only_first"]),
                str(test["only_second"]),
                p_text(test["p_value"]),
            )
            for test in tests
            if test["link"] is None
        ),
    )


def _where(fixed: Mapping[str, Any]) -> str:
    if "mean_snr_db" in fixed:
        return f"{fixed['channel']}, mean {fixed['mean_snr_db']:g} dB"
    delay = fixed["csi_delay"]
    return f"{fixed['channel']}, reports {delay} {'period' if delay == 1 else 'periods'} old"


def _head(across: str, value: Any) -> str:
    return f"{value:g} dB" if across == "mean_snr_db" else f"d = {value}"


def _pivot(title: str, note: str, points: Sequence[Point], across: str, cell: Cell) -> Table:
    columns = sorted({point.axes[across] for point in points})
    cells = {(point.series, point.axes[across]): cell(point) for point in points}
    names = dict.fromkeys(point.series for point in points)
    shown = [name for name in names if any(cells.get((name, c)) is not None for c in columns)]
    return Table(
        title,
        note,
        ("line", *(_head(across, value) for value in columns)),
        tuple(
            (SERIES[name].label, *(cells.get((name, c)) or _DASH for c in columns))
            for name in shown
        ),
    )


def _success(point: Point) -> str:
    return f"{percent(point.rate)} ({percent(point.low)}–{percent(point.high)})"


def _periods(point: Point) -> str | None:
    return None if point.periods is None else f"{point.periods:.0f}"


def _answered(point: Point) -> str | None:
    use = point.link_use
    return None if use is None else percent(use["answered_share"])


def _violations(point: Point) -> str | None:
    found = overruns(point) if sized_by_report(point) else None
    if found is None or found["share"] is None:
        return None
    return f"{percent(found['share'])}, ×{found['p90']:.1f}"


_CELLS: tuple[tuple[str, str, Cell], ...] = (
    ("Success", "Percent of episodes, with Wilson's 95 % intervals.", _success),
    (
        "Requests above the capacity of their period",
        "Percent of requests, and the 90th percentile of their size over the capacity; counted by "
        "all bytes on the wire, where nothing is enforced by K·D·B as in the paper. Lines that send "
        "progressively offer more than fits on purpose and are left out.",
        _violations,
    ),
    ("Queries that were answered", "Percent of queries.", _answered),
    ("Time", "Mean control periods of successful episodes (at most 160).", _periods),
)
