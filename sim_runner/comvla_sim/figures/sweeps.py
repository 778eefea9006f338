"""The two figures that sweep a property of the link: its mean SNR, and the age of its reports."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from comvla_sim.experiments.link_case import LinkCase
from comvla_sim.figures.drawing import draw_success, draw_values, new_figure, save
from comvla_sim.figures.measuring import Study
from comvla_sim.figures.points import Point
from comvla_sim.figures.series import SERIES, USEFUL_TOKENS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

RANDOM_CAVEAT = (
    "The policy never saw random tokens in training, so its random lines are no fair comparison "
    "(see its model card)."
)


@dataclass(frozen=True)
class Sweep:
    """What a figure varies by default.

    Attributes:
        series: names of lines.
        channels: kinds of fading.
        mean_snr_db: mean SNRs, dB.
        csi_delay: ages of reports in control periods.
    """

    series: tuple[str, ...]
    channels: tuple[str, ...]
    mean_snr_db: tuple[float, ...]
    csi_delay: tuple[int, ...]


SWEEPS: Mapping[str, Sweep] = {
    "fading": Sweep(
        ("full", "unenforced", "random", "drop", "progressive+floor"),
        ("rayleigh", "rician"),
        (0.0, 5.0, 10.0, 15.0, 20.0),
        (1,),
    ),
    "csi-delay": Sweep(
        ("unenforced", "drop", "prefix", "margin", "progressive+floor"),
        ("rayleigh",),
        (10.0,),
        (0, 1, 2, 3, 4),
    ),
}

EPISODE = Sweep(("drop", "progressive+floor"), ("rayleigh",), (10.0,), (1,))
"""What the figure of one episode shows by default."""


def draw_fading(points: Sequence[Point], study: Study, link: LinkCase, out: Path) -> list[Path]:
    """Success against mean SNR, a panel for each channel (the paper's Fig. 4)."""
    channels = list(dict.fromkeys(point.axes["channel"] for point in points))
    figure, grid = new_figure(5.0 * len(channels), 4.6, ncols=len(channels), squeeze=False)
    for axes, channel in zip(grid[0], channels, strict=True):
        own = [point for point in points if point.axes["channel"] == channel]
        draw_success(axes, own, lambda point: float(point.axes["mean_snr_db"]))
        axes.set_title(channel)
        axes.set_xlabel("mean SNR, dB")
    _legend(figure, grid[0][0])
    return save(figure, out, "fading", caption(points, study, link))


def draw_csi_delay(points: Sequence[Point], study: Study, link: LinkCase, out: Path) -> list[Path]:
    """Success, violations of the capacity, and time to success against the age of reports."""
    places = list(dict.fromkeys((p.axes["channel"], p.axes["mean_snr_db"]) for p in points))
    figure, grid = new_figure(12.5, 4.2 * len(places), nrows=len(places), ncols=3, squeeze=False)
    for row, (channel, mean_snr_db) in zip(grid, places, strict=True):
        own = [
            p
            for p in points
            if (p.axes["channel"], p.axes["mean_snr_db"]) == (channel, mean_snr_db)
        ]
        draw_success(row[0], own, _delay)
        row[0].set_title(f"{channel}, mean {mean_snr_db:g} dB")
        draw_values(row[1], [p for p in own if sized_by_report(p)], _delay, _violations)
        row[1].set_ylabel("requests above the period's capacity, %")
        row[1].set_ylim(-2, 102)
        draw_values(row[2], own, _delay, lambda point: point.periods)
        row[2].set_ylabel("control periods of successful episodes")
        row[2].set_ylim(bottom=0)
        for axes in row:
            axes.set_xlabel("age of the reported SNR, control periods")
            axes.xaxis.get_major_locator().set_params(integer=True)
    _legend(figure, grid[0][0])
    return save(figure, out, "csi-delay", caption(points, study, link))


def _legend(figure: Figure, axes: Axes) -> None:
    lines, labels = axes.get_legend_handles_labels()
    figure.legend(lines, labels, frameon=False, fontsize=8, ncols=3, loc="outside upper center")


def _delay(point: Point) -> float:
    return float(point.axes["csi_delay"])


def sized_by_report(point: Point) -> bool:
    """Whether a payload is meant to fit; a progressive one offers more on purpose."""
    return point.link is not None and not point.link.sending.startswith("progressive")


def overruns(point: Point) -> dict[str, Any] | None:
    """Requests against the capacity of their period, counted as the line's budget counts."""
    if point.link_use is None or point.link is None:
        return None
    key = "payload_overruns" if point.link.budget == "paper" else "overruns"
    found: dict[str, Any] = point.link_use[key]
    return found


def _violations(point: Point) -> float | None:
    found = overruns(point)
    return None if found is None or found["share"] is None else 100 * found["share"]


def caption(points: Sequence[Point], study: Study, link: LinkCase) -> str:
    """What has to be said with the figure."""
    counts = sorted({point.episodes for point in points})
    names = {point.series for point in points}
    delays = sorted({point.axes["csi_delay"] for point in points})
    parts = [
        f"{study.subject.settings['model']} in {study.settings.world}, "
        f"{' to '.join(map(str, dict.fromkeys((counts[0], counts[-1]))))} "
        f"episodes per point ({study.episodes} layouts for each of {len(study.tasks)} instructions), "
        f"evaluation seed {study.settings.seed}; Wilson's 95 % intervals.",
        f"Link of {link.bandwidth_hz / 1e6:g} MHz, T = {1000 * link.period_s:g} ms, "
        f"η = {link.efficiency:g}, f_d = {link.doppler_hz:g} Hz, κ = {link.rician_k:g} (Rician); "
        "every byte on the wire counts where the link is enforced.",
    ]
    if len(delays) == 1:
        parts.append(
            f"The reported SNR is {delays[0]} {'period' if delays[0] == 1 else 'periods'} old."
        )
    if "progressive+floor" in names or "floor" in names:
        parts.append(f"Floor: {USEFUL_TOKENS} tokens.")
    if any(SERIES[name].method == "random" for name in names):
        parts.append(RANDOM_CAVEAT)
    lines = (" ".join(parts[:1]), " ".join(parts[1:2]), " ".join(parts[2:]))
    return "\n".join(line for line in lines if line)
