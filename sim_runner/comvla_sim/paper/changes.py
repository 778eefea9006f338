"""Changes of success between two ways of sending: on episodes that both have, by one rule for tables and claims."""

from __future__ import annotations

from comvla_sim.paper.cells import Cell
from comvla_sim.paper.published import EPISODES_PER_SUITE, SUITES
from comvla_sim.paper.results import Results
from comvla_sim.paper.verdicts import (
    AGREES,
    DIFFERS,
    UNTESTED,
    Rate,
    Verdict,
    compare_changes,
    contrast,
)

STAND_IN = Verdict(UNTESTED, "drawn with stand-in assets")
SOME_SUITES = Verdict(
    UNTESTED, "the paper's average is over four suites, and not all of them were run"
)
NOTHING_SHARED = Verdict(UNTESTED, "no table was run with both yet")

ALL_EPISODES = EPISODES_PER_SUITE * len(SUITES)
"""Episodes behind an average of the paper."""


def change(results: Results, first: Cell, second: Cell, suite: str | None = None) -> float | None:
    """Points by which the first is ahead of the second; None without an episode that both have."""
    if first == second:
        return 0.0
    ours = results.shared(first, second, suite)
    return None if ours is None else 100 * (ours[0].value - ours[1].value)


def change_text(value: float) -> str:
    """Points with their sign; none for no change."""
    return f"{value:+.1f}" if abs(value) >= 0.05 else "0.0"


def gap_text(ours: tuple[Rate, Rate], unit: str = "") -> str:
    """Points by which the first rate is ahead, with the interval of the difference."""
    value, low, high = (100 * x for x in contrast([(1, ours[0]), (-1, ours[1])]))
    return f"{change_text(value)}{unit} ({low:+.1f} to {high:+.1f})"


def change_verdict(
    results: Results,
    cells: tuple[Cell, Cell],
    printed: tuple[float, float],
    suite: str | None = None,
) -> Verdict:
    """Our change between two cells against the paper's between two percentages.

    Args:
        results: what was measured.
        cells: the first is compared with the second.
        printed: what the paper prints for them, percent.
        suite: of LIBERO; None for all.
    """
    ours = results.shared(*cells, suite)
    if ours is None:
        return NOTHING_SHARED
    if results.stand_in:
        return STAND_IN
    if suite is None and results.some_suites:
        return SOME_SUITES
    episodes = EPISODES_PER_SUITE if suite in SUITES else ALL_EPISODES
    first, second = (Rate.of_percent(percent, episodes) for percent in printed)
    return compare_changes((first, second), ours)


def lead_verdict(
    results: Results, cells: tuple[Cell, Cell], printed: tuple[float, float]
) -> Verdict:
    """As :func:`change_verdict`, for a claim that the first is ahead: no lead found is no agreement.

    Args:
        results: what was measured.
        cells: the first is said to be ahead of the second.
        printed: what the paper prints for them, percent.
    """
    verdict, ours = change_verdict(results, cells, printed), results.shared(*cells)
    if ours is None or verdict.kind != AGREES:
        return verdict
    _, low, high = contrast([(1, ours[0]), (-1, ours[1])])
    if low > 0:
        return verdict
    if high < 0:
        return Verdict(DIFFERS, "in that the other is ahead")
    return Verdict(
        UNTESTED, f"{ours[0].episodes} episodes show neither that lead nor that there is none"
    )
