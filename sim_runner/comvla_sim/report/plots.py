"""Success against tokens and against bytes, with intervals."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from comvla_sim.experiments.plan import FULL
from comvla_sim.report.terminal import method_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Okabe and Ito: told apart with every kind of colour vision, in print too.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
MARKERS = "osD^vP"

STYLE: Any = {"svg.fonttype": "none", "svg.hashsalt": "comvla", "font.size": 10}
"""Text stays text, and equal results give equal files."""


def success_against_tokens(lines: Sequence[dict[str, Any]], *, title: str = "") -> bytes:
    """An SVG of success over K, one line for each method; full transmission is a level.

    Args:
        lines: ``aggregate`` of :func:`comvla_sim.experiments.summary.summarise`.
        title: above the plot.
    """
    chosen = [line for line in lines if line["k"] is not None]
    return _plot(chosen, lambda line: float(line["k"]), "tokens sent, K", title)


def success_against_bytes(lines: Sequence[dict[str, Any]], *, title: str = "") -> bytes:
    """An SVG of success over KiB on the wire per query."""
    return _plot(
        lines,
        lambda line: float(line["framed_bytes_per_query"]) / 1024,
        "KiB on the wire per query",
        title,
    )


def _plot(
    lines: Sequence[dict[str, Any]],
    x_of: Callable[[dict[str, Any]], float],
    x_label: str,
    title: str,
) -> bytes:
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(6.4, 4.0), layout="constrained")
        axes = figure.subplots()
        _draw(axes, lines, x_of)
        axes.set_xlabel(x_label)
        axes.set_ylabel("success, %")
        axes.set_ylim(-2, 102)
        axes.grid(alpha=0.25)
        axes.set_title(title)
        axes.legend(frameon=False)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


def _draw(
    axes: Axes, lines: Sequence[dict[str, Any]], x_of: Callable[[dict[str, Any]], float]
) -> None:
    from matplotlib.ticker import FuncFormatter

    drawn = [line for line in lines if line["condition"] in ("normal", "wrong_selection")]
    series = dict.fromkeys((x["condition"], x["method"], method_name(x)) for x in drawn)
    axes.set_xscale("log", base=2)
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    for number, (condition, method, name) in enumerate(series):
        points = [x for x in drawn if (x["condition"], method_name(x)) == (condition, name)]
        points.sort(key=x_of)
        rates = [100 * point["success_rate"] for point in points]
        below = [rate - 100 * point["low"] for rate, point in zip(rates, points, strict=True)]
        above = [100 * point["high"] - rate for rate, point in zip(rates, points, strict=True)]
        colour = COLOURS[number % len(COLOURS)]
        axes.errorbar(
            [x_of(point) for point in points],
            rates,
            # Rounded bounds may pass the rate itself by a hair, and bars have no negative length.
            yerr=([max(0.0, b) for b in below], [max(0.0, a) for a in above]),
            label=name if condition == "normal" else f"{condition}: {name}",
            color=colour,
            marker=MARKERS[number % len(MARKERS)],
            linestyle="-" if condition == "normal" else "--",
            capsize=3,
        )
        if method == FULL and condition == "normal":
            axes.axhline(rates[0], color=colour, linewidth=0.8, alpha=0.5)
