"""From rows of episodes to the points of a figure."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from comvla_sim.experiments.link_case import LinkCase
from comvla_sim.experiments.plan import EpisodeSpec
from comvla_sim.experiments.results import Row
from comvla_sim.experiments.statistics import mcnemar, sign_flip, wilson_interval
from comvla_sim.experiments.summary import link_use
from comvla_sim.figures.series import Series


@dataclass(frozen=True)
class Point:
    """One line over one link.

    Attributes:
        series: name of the line.
        link: the link, used as the line uses it; None over an ideal one.
        axes: what the point is plotted by: channel, mean_snr_db and csi_delay.
        episodes: how many.
        successes: how many of them.
        low: lower end of Wilson's 95 % interval of the success rate.
        high: upper end.
        periods: mean control periods of the successful episodes; None without any.
        bytes_per_query: everything offered to the link, over all queries.
        link_use: sums and shares (:func:`comvla_sim.experiments.summary.link_use`).
    """

    series: str
    link: LinkCase | None
    axes: dict[str, Any]
    episodes: int
    successes: int
    low: float
    high: float
    periods: float | None
    bytes_per_query: float
    link_use: dict[str, Any] | None

    @property
    def rate(self) -> float:
        """Share of the episodes that succeeded."""
        return self.successes / self.episodes

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values."""
        return {
            **vars(self),
            "link": None if self.link is None else self.link.to_dict(),
            "success_rate": round(self.rate, 4),
        }


def points(
    rows: Mapping[EpisodeSpec, Row], series: Mapping[str, Series], links: Sequence[LinkCase]
) -> list[Point]:
    """A point for each line and link, in that order.

    Args:
        rows: of every episode.
        series: lines by name.
        links: as they were before the lines used them their way.
    """
    groups: dict[tuple[str, LinkCase | None], list[Row]] = defaultdict(list)
    for spec, row in rows.items():
        groups[spec.method, spec.link].append(row)
    return [
        _point(name, line, link, groups[line.method, line.link(link)])
        for name, line in series.items()
        for link in links
    ]


def _point(name: str, line: Series, link: LinkCase, rows: Sequence[Row]) -> Point:
    successes = sum(row["success"] for row in rows)
    low, high = wilson_interval(successes, len(rows))
    solved = [row["steps"] for row in rows if row["success"]]
    queries = sum(row["queries"] for row in rows)
    uses = [row["link_use"] for row in rows if row["link_use"]]
    return Point(
        series=name,
        link=line.link(link),
        axes={key: getattr(link, key) for key in ("channel", "mean_snr_db", "csi_delay")},
        episodes=len(rows),
        successes=successes,
        low=round(low, 6),
        high=round(high, 6),
        periods=round(sum(solved) / len(solved), 1) if solved else None,
        bytes_per_query=round(sum(row["framed_bytes"] for row in rows) / max(1, queries), 1),
        link_use=link_use(uses),
    )


def pairs(
    rows: Mapping[EpisodeSpec, Row],
    first: Series,
    second: Series,
    links: Sequence[LinkCase],
) -> dict[str, Any]:
    """Two lines compared on the same layouts, instructions and fading.

    Over one link by McNemar's exact test. Over several, a layout's episodes are repetitions of each other, so each
    layout counts once (:func:`comvla_sim.experiments.statistics.sign_flip`).

    Args:
        rows: of every episode.
        first: a line.
        second: another.
        links: over which both are compared, put together.
    """
    outcomes: list[tuple[bool, bool]] = []
    layouts: dict[int, int] = defaultdict(int)
    for link in links:
        theirs = {
            (spec.task, spec.episode): bool(row["success"])
            for spec, row in rows.items()
            if (spec.method, spec.link) == (second.method, second.link(link))
        }
        for spec, row in rows.items():
            other = theirs.get((spec.task, spec.episode))
            if (spec.method, spec.link) != (first.method, first.link(link)) or other is None:
                continue
            outcomes.append((bool(row["success"]), other))
            layouts[spec.episode] += bool(row["success"]) - other
    test = vars(mcnemar([a for a, _ in outcomes], [b for _, b in outcomes]))
    if len(links) > 1:
        test["p_value"] = sign_flip(list(layouts.values()))
    return {**test, "layouts": len(layouts)}
