"""When a number of ours agrees with the paper's, and when it differs."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from comvla_sim.experiments.statistics import wilson_interval
from comvla_sim.paper.verdicts import (
    AGREES,
    DIFFERS,
    UNTESTED,
    Rate,
    Verdict,
    compare_changes,
    compare_number,
    compare_rates,
    contrast,
)


@st.composite
def rates(draw: st.DrawFn) -> Rate:
    episodes = draw(st.integers(1, 2000))
    return Rate(draw(st.integers(0, episodes)), episodes)


@given(rates())
def test_one_rate_alone_has_wilsons_interval(rate: Rate) -> None:
    value, low, high = contrast([(1, rate)])
    assert value == pytest.approx(rate.value)
    assert (low, high) == pytest.approx(wilson_interval(int(rate.successes), rate.episodes))


@given(rates(), rates())
def test_a_difference_turned_around_is_the_same_with_the_other_sign(a: Rate, b: Rate) -> None:
    value, low, high = contrast([(1, a), (-1, b)])
    turned = contrast([(-1, a), (1, b)])
    assert low <= value <= high
    assert turned == pytest.approx((-value, -high, -low))


def test_the_interval_of_a_difference_is_newcombes() -> None:
    """Newcombe (1998), method 10: 56/70 against 48/80 gives .0524 to .3339."""
    value, low, high = contrast([(1, Rate(56, 70)), (-1, Rate(48, 80))])
    assert value == pytest.approx(0.2)
    assert (low, high) == pytest.approx((0.0524, 0.3339), abs=5e-5)


def test_rates_agree_within_chance_and_differ_beyond_it() -> None:
    paper = Rate.of_percent(95.4, 2000)
    assert compare_rates(paper, Rate(152, 160)).kind == AGREES
    far = compare_rates(paper, Rate(80, 160))
    assert far.kind == DIFFERS
    assert far.detail.startswith("by -45.4 points")


def test_changes_are_compared_whatever_the_levels_are() -> None:
    paper = Rate.of_percent(80.0, 2000), Rate.of_percent(90.0, 2000)
    assert compare_changes(paper, (Rate(80, 160), Rate(96, 160))).kind == AGREES
    assert compare_changes(paper, (Rate(16, 160), Rate(96, 160))).kind == DIFFERS


@pytest.mark.parametrize(
    ("paper", "low", "high", "kind"),
    [
        (2.3, 2.26, 2.50, AGREES),
        (2.9, 2.86, 2.87, AGREES),  # 2.86 is printed as 2.9
        (2.9, 3.52, 3.76, DIFFERS),
        (1088.0, 1088.0, 1088.0, AGREES),
    ],
)
def test_calculated_numbers_agree_to_the_digit_that_is_printed(
    paper: float, low: float, high: float, kind: str
) -> None:
    verdict = compare_number(paper, low, high, step=0.1, unit="TFLOPs")
    assert verdict.kind == kind
    assert (kind == DIFFERS) == ("by +0.62 TFLOPs" in verdict.text)


def test_what_cannot_be_tested_says_why() -> None:
    assert Verdict(UNTESTED, "no weights").text == "cannot be tested here: no weights"
