"""Intervals and paired tests agree with published values and with plain enumeration."""

from __future__ import annotations

import itertools
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from comvla_sim.experiments.statistics import mcnemar, p_text, sign_flip, wilson_interval


# Newcombe (1998), Statistics in Medicine 17, table I: Wilson's score method without correction.
@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ],
)
def test_wilson_intervals_are_newcombes(
    successes: int, trials: int, low: float, high: float
) -> None:
    assert wilson_interval(successes, trials) == pytest.approx((low, high), abs=5e-5)


@given(trials=st.integers(1, 400), share=st.floats(0, 1))
def test_wilson_bounds_are_where_the_score_test_turns(trials: int, share: float) -> None:
    successes = round(share * trials)
    low, high = wilson_interval(successes, trials)
    p = successes / trials
    assert 0 <= low <= p <= high <= 1
    for bound in (low, high):
        if 0 < bound < 1:
            deviation = abs(p - bound) / math.sqrt(bound * (1 - bound) / trials)
            assert deviation == pytest.approx(1.959964, rel=1e-5)


def test_nothing_is_known_without_trials() -> None:
    assert wilson_interval(0, 0) == (0.0, 1.0)


@pytest.mark.parametrize(("successes", "trials"), [(3, 2), (-1, 4)])
def test_impossible_counts_are_refused(successes: int, trials: int) -> None:
    with pytest.raises(ValueError, match="successes"):
        wilson_interval(successes, trials)


@given(st.lists(st.tuples(st.booleans(), st.booleans()), max_size=12))
def test_mcnemar_is_the_share_of_sign_patterns_at_least_as_uneven(
    pairs: list[tuple[bool, bool]],
) -> None:
    result = mcnemar([a for a, _ in pairs], [b for _, b in pairs])
    unlike = [a for a, b in pairs if a != b]
    observed = abs(2 * sum(unlike) - len(unlike))
    patterns = list(itertools.product((0, 1), repeat=len(unlike)))
    as_uneven = sum(abs(2 * sum(pattern) - len(unlike)) >= observed for pattern in patterns)
    assert result.p_value == pytest.approx(as_uneven / len(patterns))
    assert result.only_first + result.only_second == len(unlike)
    assert result.pairs == len(pairs)


def test_mcnemar_of_many_pairs_does_not_overflow() -> None:
    p_value = mcnemar([True] * 3000, [False] * 3000).p_value
    assert p_value == 0.0
    assert p_text(p_value) == "< 1e-300"
    assert p_text(0.04321, 1) == "0.04"
    half = [True, False] * 2000
    assert mcnemar(half, half[::-1]).p_value == 1.0


def test_mcnemar_needs_pairs() -> None:
    with pytest.raises(ValueError, match="pairs"):
        mcnemar([True], [])


@given(differences=st.lists(st.integers(-5, 5), max_size=8))
def test_sign_flips_are_counted_as_if_written_out(differences: list[int]) -> None:
    sums = [
        sum(sign * d for sign, d in zip(signs, differences, strict=True))
        for signs in itertools.product((-1, 1), repeat=len(differences))
    ]
    extreme = sum(abs(value) >= abs(sum(differences)) for value in sums)
    assert sign_flip(differences) == pytest.approx(extreme / len(sums))


def test_a_group_counts_once_however_many_episodes_it_has() -> None:
    assert sign_flip([40] * 5) == sign_flip([1] * 5) == 2 / 2**5
