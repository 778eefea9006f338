"""Success against bytes: every method in one picture."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

from comvla_sim.experiments.methods import order
from comvla_sim.paper.cells import Cell
from comvla_sim.paper.results import Json, Results
from comvla_sim.report.plots import STYLE

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_LOOKS = {
    "hard_voting": ("#0072B2", "o", "-"),
    "soft_voting": ("#56B4E9", "s", "-"),
    "random": ("#999999", "D", "-"),
    "jpeg": ("#D55E00", "^", "--"),
    "webp": ("#E69F00", "v", "--"),
    "avif": ("#8C6D31", "<", "--"),
    "h264": ("#CC79A7", ">", "--"),
    "deepjscc": ("#7F3C8D", "P", ""),
    "witt": ("#B07AA1", "X", ""),
    "full": ("#222222", "*", ""),
    "lightvla": ("#009E73", "h", ""),
    "vla_adp": ("#44AA99", "H", ""),
    "fastv": ("#117733", "8", ""),
    "multi_voting": ("#332288", "p", ":"),
    "diverse_voting": ("#6699CC", "d", ":"),
    "view_quotas": ("#AA4499", "*", ":"),
    "token_norm": ("#DDCC77", "x", ""),
}
"""Colour, marker and line of every method; a number behind a picture coding makes no difference."""

_OTHER = ("#555555", ".", ":")


def success_against_bytes(results: Results) -> bytes:
    """An SVG: percent of success over KiB on the wire per query, a line for each method, with intervals."""
    import matplotlib
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter

    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9.6, 5.2), layout="constrained")
        axes = figure.subplots()
        families: dict[str, list[Json]] = {}
        for cell in sorted(results.cells, key=lambda c: order(c.method)):
            found = results.find(cell)
            if found is not None and cell.quantization == "int8":
                families.setdefault(cell.method.partition("-")[0], []).append(found)
        for name, found_ in families.items():
            _line(axes, name, sorted(found_, key=lambda c: float(c["wire_bytes"])))
        axes.set_xscale("log", base=2)
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.set_xlabel("KiB on the wire per query")
        axes.set_ylabel("success, %")
        axes.set_ylim(-2, 103)
        axes.grid(alpha=0.25)
        axes.legend(frameon=False, fontsize=8.5, loc="center left", bbox_to_anchor=(1.01, 0.5))
        buffer = io.BytesIO()
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


def _line(axes: Axes, name: str, cells: list[Json]) -> None:
    colour, marker, style = _LOOKS.get(name, _OTHER)
    rates = [100 * c["successes"] / c["episodes"] for c in cells]
    below = [max(0.0, rate - 100 * c["low"]) for rate, c in zip(rates, cells, strict=True)]
    above = [max(0.0, 100 * c["high"] - rate) for rate, c in zip(rates, cells, strict=True)]
    numbers = [Cell(c["method"], c["k"]) for c in cells]
    axes.errorbar(
        [c["wire_bytes"] / 1024 for c in cells],
        rates,
        yerr=(below, above),
        label=name if len(numbers) > 1 else numbers[0].name,
        color=colour,
        marker=marker,
        markersize=6.5,
        linestyle=style or "none",
        linewidth=1.4,
        elinewidth=0.8,
        capsize=2,
        alpha=0.9,
    )
