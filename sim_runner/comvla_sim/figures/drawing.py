"""Points with intervals on axes, in the style of the reports, as PNG and SVG."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from comvla_sim.experiments.errors import EvaluationError
from comvla_sim.figures.points import Point
from comvla_sim.figures.series import SERIES
from comvla_sim.report.plots import MARKERS, STYLE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PNG_DPI = 110


def new_figure(width: float, height: float, **grid: Any) -> tuple[Figure, Any]:
    """A figure and its axes; ``grid`` is what ``Figure.subplots`` takes."""
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(width, height), layout="constrained")
        return figure, figure.subplots(**grid)


def save(figure: Figure, out: Path, name: str, caption: str) -> list[Path]:
    """Writes ``name.svg`` and ``name.png`` with a caption under the axes.

    Raises:
        EvaluationError: the folder cannot be written.
    """
    import matplotlib

    figure.supxlabel(caption, fontsize=7.5, ha="left", x=0.01, wrap=True)
    paths = []
    for suffix, options in (
        ("svg", {"metadata": {"Date": None}}),
        ("png", {"dpi": PNG_DPI, "metadata": {"Software": None}}),
    ):
        buffer = io.BytesIO()
        with matplotlib.rc_context(STYLE):
            figure.savefig(buffer, format=suffix, **options)
        path = out / f"{name}.{suffix}"
        try:
            out.mkdir(parents=True, exist_ok=True)
            path.write_bytes(buffer.getvalue())
        except OSError as error:
            raise EvaluationError(f"cannot write {path}: {error.strerror}") from error
        paths.append(path)
    return paths


def draw_success(axes: Axes, points: Sequence[Point], x_of: Callable[[Point], float]) -> None:
    """Success in percent with Wilson's 95 % intervals, one line for each series."""
    drawn = list(dict.fromkeys(point.series for point in points))
    for number, series in enumerate(drawn):
        own = sorted((p for p in points if p.series == series), key=x_of)
        rates = [100 * point.rate for point in own]
        # Rounded bounds may pass the rate itself by a hair, and bars have no negative length.
        below = [max(0.0, rate - 100 * p.low) for rate, p in zip(rates, own, strict=True)]
        above = [max(0.0, 100 * p.high - rate) for rate, p in zip(rates, own, strict=True)]
        # Lines side by side, so that intervals do not hide one another.
        shift = 0.012 * (number - (len(drawn) - 1) / 2) * _span(points, x_of)
        axes.errorbar(
            [x_of(point) + shift for point in own],
            rates,
            yerr=(below, above),
            label=SERIES[series].label,
            capsize=2,
            **_look(series),
        )
    axes.set_ylim(-2, 102)
    axes.set_ylabel("success, %")
    axes.grid(alpha=0.25)


def draw_values(
    axes: Axes,
    points: Sequence[Point],
    x_of: Callable[[Point], float],
    y_of: Callable[[Point], float | None],
) -> None:
    """Some other value of each point that has one, one line for each series."""
    for series in dict.fromkeys(point.series for point in points):
        own = sorted((p for p in points if p.series == series), key=x_of)
        known = [(x_of(p), y) for p in own if (y := y_of(p)) is not None]
        if known:
            xs, ys = zip(*known, strict=True)
            axes.plot(xs, ys, label=SERIES[series].label, **_look(series))
    axes.grid(alpha=0.25)


def _look(series: str) -> dict[str, Any]:
    index = list(SERIES).index(series)
    enforced = SERIES[series].enforce != "none" and not SERIES[series].ideal
    return {
        "color": SERIES[series].colour,
        "marker": MARKERS[index % len(MARKERS)],
        "markersize": 4.5,
        "linewidth": 1.4,
        "linestyle": "-" if enforced else "--",
    }


def _span(points: Sequence[Point], x_of: Callable[[Point], float]) -> float:
    values = [x_of(point) for point in points]
    return max(values) - min(values) or 1.0
