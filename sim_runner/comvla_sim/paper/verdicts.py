"""Whether a number of ours agrees with the paper's: the rule, written down once."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

from comvla_sim.experiments.statistics import wilson_interval

AGREES: Final = "agrees"
DIFFERS: Final = "differs"
UNTESTED: Final = "cannot be tested here"
OURS: Final = "not in the paper"

Kind = Literal["agrees", "differs", "cannot be tested here", "not in the paper"]


@dataclass(frozen=True)
class Verdict:
    """What became of one cell of the paper.

    Attributes:
        kind: one of the four.
        detail: by how much, or why not.
    """

    kind: Kind
    detail: str = ""

    @property
    def text(self) -> str:
        """For a table."""
        separator = ": " if self.kind == UNTESTED else " "
        return f"{self.kind}{separator}{self.detail}" if self.detail else self.kind


@dataclass(frozen=True)
class Rate:
    """A success rate.

    Attributes:
        successes: how many; not whole where a percentage was rounded.
        episodes: of how many.
    """

    successes: float
    episodes: int

    @classmethod
    def of_percent(cls, percent: float, episodes: int) -> Rate:
        """A rate that the paper prints."""
        return cls(percent / 100 * episodes, episodes)

    @property
    def value(self) -> float:
        """Share, 0 to 1."""
        return self.successes / self.episodes

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's, 95 %."""
        return wilson_interval(round(self.successes), self.episodes)


def contrast(terms: Sequence[tuple[int, Rate]]) -> tuple[float, float, float]:
    """A sum and difference of rates with its 95 % interval (MOVER, from Wilson's intervals; Zou and Donner, 2008).

    Args:
        terms: signs, +1 or −1, and independent rates. Rates of one world on the same layouts are
            positively correlated; taking them as independent makes the interval wider, not narrower.

    Returns:
        (value, low, high) as shares.
    """
    value = math.fsum(sign * rate.value for sign, rate in terms)
    below = above = 0.0
    for sign, rate in terms:
        low, high = rate.interval
        down, up = rate.value - low, high - rate.value
        below += (down if sign > 0 else up) ** 2
        above += (up if sign > 0 else down) ** 2
    return value, value - math.sqrt(below), value + math.sqrt(above)


def compare_rates(paper: Rate, ours: Rate) -> Verdict:
    """Two success rates of the same benchmark: they agree unless their difference is beyond chance."""
    return _beyond_chance(contrast([(1, ours), (-1, paper)]))


def compare_changes(paper: tuple[Rate, Rate], ours: tuple[Rate, Rate]) -> Verdict:
    """Two changes of success, each of a rate against its reference, in worlds whose levels differ.

    Args:
        paper: the paper's rate, and the rate that it is compared with.
        ours: the same here.
    """
    return _beyond_chance(contrast([(1, ours[0]), (-1, ours[1]), (-1, paper[0]), (1, paper[1])]))


def _beyond_chance(found: tuple[float, float, float]) -> Verdict:
    value, low, high = (100 * part for part in found)
    if low <= 0 <= high:
        return Verdict(AGREES, f"(difference {low:+.1f} to {high:+.1f} points)")
    return Verdict(DIFFERS, f"by {value:+.1f} points ({low:+.1f} to {high:+.1f})")


def compare_number(paper: float, low: float, high: float, *, step: float, unit: str) -> Verdict:
    """A calculated number against a printed one.

    Args:
        paper: as printed.
        low: of the range that the calculation gives.
        high: its other end.
        step: of the paper's last digit: half of it either way is rounding.
        unit: for the message.
    """
    if low - step / 2 <= paper + 1e-9 and paper - 1e-9 <= high + step / 2:
        return Verdict(AGREES)
    near = low if paper < low else high
    return Verdict(DIFFERS, f"by {near - paper:+.2g} {unit}")
