"""Intervals and tests for counts of successes."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

Z_95 = 1.959963984540054
"""Two-sided 95 % quantile of the standard normal distribution."""


def wilson_interval(successes: int, trials: int, z: float = Z_95) -> tuple[float, float]:
    """Wilson's score interval of a proportion.

    Args:
        successes: 0 to ``trials``.
        trials: how many; none at all give (0, 1).
        z: quantile of the normal distribution; 95 % by default.

    Returns:
        (low, high) within [0, 1].

    Raises:
        ValueError: more successes than trials, or negative numbers.
    """
    if not 0 <= successes <= trials:
        raise ValueError(f"expected 0 <= successes <= trials, got {successes} of {trials}")
    if trials == 0:
        return 0.0, 1.0
    p = successes / trials
    scale = 1 + z * z / trials
    centre = (p + z * z / (2 * trials)) / scale
    half = z * math.sqrt(p * (1 - p) / trials + z * z / (4 * trials * trials)) / scale
    # At the ends the formula gives exactly 0 and 1, but for rounding.
    low = 0.0 if successes == 0 else max(0.0, centre - half)
    high = 1.0 if successes == trials else min(1.0, centre + half)
    return low, high


@dataclass(frozen=True)
class McNemar:
    """Exact McNemar test of paired outcomes.

    Attributes:
        pairs: how many.
        only_first: pairs in which only the first succeeded.
        only_second: pairs in which only the second did.
        p_value: two-sided: probability, were both equally good, of a split at least so uneven.
    """

    pairs: int
    only_first: int
    only_second: int
    p_value: float


def mcnemar(first: Sequence[bool], second: Sequence[bool]) -> McNemar:
    """The exact binomial form of McNemar's test.

    Args:
        first: outcomes of one method.
        second: outcomes of another on the same episodes, in the same order.

    Raises:
        ValueError: different lengths.
    """
    if len(first) != len(second):
        raise ValueError(f"expected pairs, got {len(first)} and {len(second)} outcomes")
    only_first = sum(a and not b for a, b in zip(first, second, strict=True))
    only_second = sum(b and not a for a, b in zip(first, second, strict=True))
    discordant = only_first + only_second
    tail = sum(math.comb(discordant, i) for i in range(min(only_first, only_second) + 1))
    # Integers until the division: 2 ** discordant overflows a float from 1024 pairs on.
    p_value = min(1.0, 2 * tail / 2**discordant)
    return McNemar(len(first), only_first, only_second, p_value)


def sign_flip(differences: Sequence[int]) -> float:
    """Two-sided p of no difference, where outcomes within a group depend on each other.

    Under the null hypothesis a group's difference is as likely as its opposite. All patterns of signs are counted, by
    their sums.

    Args:
        differences: of each group: successes of one method less those of another.
    """
    sums = {0: 1}
    for difference in differences:
        counts: dict[int, int] = defaultdict(int)
        for value, count in sums.items():
            counts[value + difference] += count
            counts[value - difference] += count
        sums = counts
    observed = abs(sum(differences))
    extreme = sum(count for value, count in sums.items() if abs(value) >= observed)
    return float(extreme / (1 << len(differences)))


def p_text(p_value: float, digits: int = 2) -> str:
    """A p-value for a table; one that a float cannot hold is said to be small, not zero."""
    return f"{p_value:.{digits}g}" if p_value >= 1e-300 else "< 1e-300"
