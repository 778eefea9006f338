"""One episode over a link, period by period: SNR, capacity, tokens, bytes, and fallbacks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from comvla_client import StepReport
from comvla_sim.experiments import runner
from comvla_sim.experiments.errors import EvaluationError
from comvla_sim.experiments.link_case import LEAD_IN, LinkCase
from comvla_sim.experiments.results import Row
from comvla_sim.figures.drawing import new_figure, save
from comvla_sim.figures.measuring import Study
from comvla_sim.figures.series import Series
from comvla_sim.link import LinkRecord

_REPORTED, _OFFERED, _DELIVERED = "#D55E00", "#56B4E9", "#0072B2"


@dataclass(frozen=True)
class Asked:
    """One query of the episode.

    Attributes:
        period: control period in which it was made.
        report: the client's account.
        record: the link's; None where nothing was sent.
    """

    period: int
    report: StepReport
    record: LinkRecord | None

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values; −inf as a string."""
        report, record = self.report, self.record
        return {
            "period": self.period,
            "source": report.source,
            "fallback_reason": report.fallback_reason,
            "reported_snr_db": _plain(report.snr_db),
            "paper_budget": report.paper_budget,
            "framed_budget": report.framed_budget,
            "tokens_sent": report.tokens,
            "tokens_used": report.tokens_used,
            "link": None if record is None else record.to_dict(),
        }


@dataclass(frozen=True)
class Story:
    """One episode.

    Attributes:
        row: as ``comvla-sim eval`` would write it.
        link: that it ran over.
        asked: its queries.
        snr_db: true SNR of each control period, dB.
    """

    row: Row
    link: LinkCase
    asked: Sequence[Asked]
    snr_db: Sequence[float]


def run_one(study: Study, series: Series, link: LinkCase, task: str, episode: int) -> Story:
    """Runs one episode of a line over a link.

    Raises:
        EvaluationError: a line without a link.
    """
    spec = series.spec(link, task, episode, study.subject.num_tokens)
    if spec.link is None:
        raise EvaluationError(
            f"--series: {series.label!r} has no link to show; choose another line"
        )
    asked: list[Asked] = []
    worker = runner.Worker(study.settings)
    try:
        _, row = worker.run(spec, lambda *query: asked.append(Asked(*query)))
    finally:
        worker.close()
    channel = spec.link.make_channel(row["channel_seed"])
    snr_db = channel.snr_db(LEAD_IN + row["steps"])[LEAD_IN:].tolist()
    return Story({**spec.to_row(), **row}, spec.link, asked, snr_db)


def draw_episode(story: Story, study: Study, name: str, out: Path) -> list[Path]:
    """Three panels over the control periods of one episode."""
    figure, (top, middle, bottom) = new_figure(9.0, 7.4, nrows=3, sharex=True)
    periods = np.arange(len(story.snr_db))
    profile = story.link.profile()
    capacity = [profile.capacity_bits(value) / 8 for value in story.snr_db]
    sent = [asked for asked in story.asked if asked.record is not None]
    at = [asked.period for asked in sent]

    top.step(periods, _finite(story.snr_db), where="post", color="0.35", label="true SNR")
    top.plot(
        [asked.period for asked in story.asked],
        _finite([asked.report.snr_db for asked in story.asked]),
        "o",
        color=_REPORTED,
        markersize=4,
        label=f"reported, of {story.link.csi_delay} periods ago",
    )
    top.set_ylabel("SNR, dB")

    middle.step(periods, capacity, where="post", color="0.35", label="capacity of the period")
    offered = [asked.record.offered_bytes for asked in sent if asked.record]
    delivered = [asked.record.delivered_bytes for asked in sent if asked.record]
    middle.bar(np.array(at) + 0.5, offered, color=_OFFERED, alpha=0.5, label="offered")
    middle.bar(np.array(at) + 0.5, delivered, color=_DELIVERED, label="delivered in time")
    middle.set_ylabel("bytes on the wire")

    bottom.plot(
        [asked.period + 0.5 for asked in story.asked],
        [asked.report.framed_budget or 0 for asked in story.asked],
        "_",
        markersize=9,
        color=_REPORTED,
        label="K* at the reported SNR, all bytes counted",
    )
    used = [asked.report.tokens_used for asked in story.asked]
    bottom.bar(
        np.array([asked.period for asked in story.asked]) + 0.5,
        used,
        color=_DELIVERED,
        label="tokens that the cloud used",
    )
    bottom.set_ylabel("tokens")
    bottom.set_xlabel("control period")
    for axes in (top, middle, bottom):
        for number, asked in enumerate(a for a in story.asked if a.report.source != "cloud"):
            label = "no answer" if number == 0 and axes is bottom else None
            axes.axvspan(asked.period, asked.period + 1, color="0.5", alpha=0.25, lw=0, label=label)
        axes.grid(alpha=0.25)
        axes.margins(x=0.01)
        axes.legend(
            frameon=False, fontsize=8, ncols=3, loc="lower left", bbox_to_anchor=(0.0, 0.98)
        )
    return save(figure, out, name, episode_caption(story, study))


def episode_caption(story: Story, study: Study) -> str:
    """What has to be said with the figure."""
    row, link = story.row, story.link
    outcome = "success" if row["success"] else "failure"
    return (
        f"“{row['instruction']}”, table {row['layout_seed']}, channel seed {row['channel_seed']}: "
        f"{outcome} after {row['steps']} periods. {study.subject.settings['model']}, "
        f"{row['method']}, {link.label}.\n"
        f"Link of {link.bandwidth_hz / 1e6:g} MHz, T = {1000 * link.period_s:g} ms, "
        f"η = {link.efficiency:g}, f_d = {link.doppler_hz:g} Hz, κ = {link.rician_k:g} (Rician)."
    )


def story_dict(story: Story) -> dict[str, Any]:
    """Everything about the episode as plain JSON values."""
    profile = story.link.profile()
    return {
        "row": story.row,
        "periods": [
            {"snr_db": _plain(value), "capacity_bits": round(profile.capacity_bits(value), 1)}
            for value in story.snr_db
        ],
        "queries": [asked.to_dict() for asked in story.asked],
    }


def _plain(value: float | None) -> float | str | None:
    return "-inf" if value == -math.inf else value


def _finite(values: Sequence[float | None]) -> list[float]:
    """For plotting: what is no number leaves a gap."""
    return [v if v is not None and math.isfinite(v) else math.nan for v in values]
