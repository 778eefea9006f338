"""Links that come and go, and reports that are late."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from comvla.errors import LinkError
from comvla_client import LinkProfile
from comvla_sim.channel import (
    ConstantChannel,
    GilbertElliottChannel,
    RayleighChannel,
    RicianChannel,
    WifiChannel,
    delayed,
)
from comvla_sim.channel.outages import WIFI_BITS_PER_S_PER_HZ

PERIOD_S = 0.05
LONG = 200_000


def dwell_times(state: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Lengths of all complete visits to the good and to the bad state, in periods."""
    changes = np.flatnonzero(np.diff(state)) + 1
    lengths = np.diff(changes)
    good = state[changes[:-1]]
    return lengths[good], lengths[~good]


def gilbert_elliott(**changes: object) -> GilbertElliottChannel:
    arguments: dict[str, object] = {
        "good_snr_db": 12.0,
        "bad_snr_db": -math.inf,
        "good_s": 1.0,
        "bad_s": 0.2,
        "period_s": PERIOD_S,
        "seed": 4,
    }
    return GilbertElliottChannel(**{**arguments, **changes})  # type: ignore[arg-type]


def test_dwell_times_of_two_states_are_geometric_with_their_means() -> None:
    good, bad = dwell_times(gilbert_elliott().good(LONG))
    for visits, mean in ((good, 20.0), (bad, 4.0)):
        assert len(visits) > 5000
        # A geometric law of mean m has the variance m (m - 1).
        assert visits.mean() == pytest.approx(mean, abs=4 * mean / math.sqrt(len(visits)))
        assert visits.var() == pytest.approx(mean * (mean - 1), rel=0.1)
        assert visits.min() == 1
    # Memoryless: a visit that lasted is as likely to go on as one that began.
    assert np.mean(good[good > 10] > 20) == pytest.approx(np.mean(good > 10), abs=0.03)


def test_the_first_state_follows_the_shares_of_time() -> None:
    first = [gilbert_elliott(seed=seed).good(1)[0] for seed in range(2000)]
    assert np.mean(first) == pytest.approx(1.0 / 1.2, abs=4 * 0.37 / math.sqrt(2000))
    assert gilbert_elliott().good(LONG).mean() == pytest.approx(1.0 / 1.2, abs=0.01)


def test_two_states_have_their_snr_and_a_seed_is_a_channel() -> None:
    channel = gilbert_elliott(bad_snr_db=-3.0)
    values = channel.snr_db(500)
    assert set(values) == {12.0, -3.0}
    assert list(itertools.islice(channel, 500)) == values.tolist()
    assert np.array_equal(gilbert_elliott(bad_snr_db=-3.0).snr_db(500), values)
    assert not np.array_equal(gilbert_elliott(seed=5).good(500), channel.good(500))
    assert channel.good(0).shape == (0,)


def test_a_dwell_time_of_one_period_always_leaves() -> None:
    state = gilbert_elliott(good_s=PERIOD_S, bad_s=PERIOD_S).good(50)
    assert (state[1:] != state[:-1]).all()


@pytest.mark.parametrize(
    ("argument", "value"),
    [
        ("good_snr_db", math.nan),
        ("bad_snr_db", math.inf),
        ("good_s", 0.01),
        ("bad_s", -1.0),
        ("bad_s", math.inf),
        ("period_s", 0.0),
        ("seed", -1),
    ],
)
def test_two_states_that_cannot_be_are_refused_by_name(argument: str, value: object) -> None:
    with pytest.raises(LinkError, match=argument):
        gilbert_elliott(**{argument: value})


def test_wifi_steps_carry_the_rates_of_the_standard() -> None:
    """Capacity with efficiency 1 in 20 MHz: 6.5 to 78 Mbit/s, or nothing."""
    means = (8.0, 15.0, 22.0, 29.0)
    values = np.concatenate([WifiChannel(mean, PERIOD_S, 6).snr_db(2000) for mean in means])
    link = LinkProfile(efficiency=1.0)
    rates = {round(link.capacity_bits(v) / link.period_s / 1e6, 6) for v in np.unique(values)}
    standard = {0.0, 6.5, 13.0, 19.5, 26.0, 39.0, 52.0, 58.5, 65.0, 78.0}
    assert {round(20 * r, 6) for r in WIFI_BITS_PER_S_PER_HZ} | {0.0} == standard
    assert rates == standard


def test_wifi_never_promises_more_than_its_fading_carries_and_rises_at_updates_only() -> None:
    channel = WifiChannel(15.0, PERIOD_S, 1, update_s=0.2)
    values, fading = channel.snr_db(4000), channel.fading.snr_db(4000)
    assert (values <= fading).all()  # every step needs more than Shannon would for its rate
    connected = np.isfinite(values[:-1])
    rises = np.flatnonzero(connected & (values[1:] > values[:-1])) + 1
    assert len(rises) > 100
    assert (rises % 4 == 0).all()


def test_wifi_outages_have_their_durations_and_rate() -> None:
    # So strong a signal that nothing but outages interrupts it.
    channel = WifiChannel(60.0, PERIOD_S, 2, up_s=2.0, outage_s=(0.1, 3.0), rician_k=100.0)
    up, down = dwell_times(np.isfinite(channel.snr_db(LONG)))
    assert down.min() == 2
    assert down.max() <= 60
    assert np.median(down) == pytest.approx(math.sqrt(2 * 60), abs=2)  # log-uniform
    assert up.mean() == pytest.approx(40, rel=0.1)


@pytest.mark.parametrize(
    ("changes", "argument"),
    [
        ({"up_s": 0.0}, "up_s"),
        ({"outage_s": (0.01, 3.0)}, "outage_s"),
        ({"outage_s": (1.0, 0.5)}, "outage_s"),
        ({"outage_s": (1.0, math.nan)}, "outage_s"),
        ({"update_s": 0.0}, "update_s"),
        ({"doppler_hz": -1.0}, "doppler_hz"),
    ],
)
def test_a_wifi_that_cannot_be_is_refused_by_name(
    changes: dict[str, object], argument: str
) -> None:
    with pytest.raises(LinkError, match=argument):
        WifiChannel(15.0, PERIOD_S, 0, **changes)  # type: ignore[arg-type]


@given(delay=st.integers(0, 12), periods=st.integers(1, 40))
def test_reports_are_the_truth_of_d_periods_ago(delay: int, periods: int) -> None:
    channel = RayleighChannel(5.0, 10.0, PERIOD_S, seed=9)
    truth = channel.snr_db(periods)
    late = delayed(channel, delay)
    expected = [truth[max(0, t - delay)] for t in range(periods)]
    assert late.snr_db(periods).tolist() == expected
    pairs = list(itertools.islice(late.pairs(), periods))
    assert pairs == list(zip(expected, truth.tolist(), strict=True))


def test_any_sequence_can_be_reported_late() -> None:
    late = delayed([1.0, 2.0, 3.0], 2)
    assert list(late) == [1.0, 1.0, 1.0, 2.0, 3.0]
    assert list(late.pairs()) == [(1.0, 1.0), (1.0, 2.0), (1.0, 3.0)]
    assert list(delayed([], 1)) == []
    assert next(iter(delayed(ConstantChannel(-math.inf), 3))) == -math.inf


@pytest.mark.parametrize("delay", [-1, 0.5, True, "2"])
def test_a_delay_that_is_none_is_refused(delay: object) -> None:
    with pytest.raises(LinkError, match="periods from 0"):
        delayed(ConstantChannel(0.0), delay)  # type: ignore[arg-type]


def test_stale_reports_do_not_change_the_law_of_the_budget_but_its_fit() -> None:
    """Why a simulation that only delays reports cannot show harm, and an enforced link does."""
    channel = RicianChannel(5.0, 10.0, PERIOD_S, seed=3, rician_k=3.0)
    pairs = np.array(list(itertools.islice(delayed(channel, 1).pairs(), 20_000)))
    reported, true = pairs[1:, 0], pairs[1:, 1]
    assert np.quantile(reported, [0.1, 0.5, 0.9]) == pytest.approx(
        np.quantile(true, [0.1, 0.5, 0.9]), abs=0.01
    )
    assert np.mean(reported > true) == pytest.approx(0.5, abs=0.02)
