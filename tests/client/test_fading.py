"""What an old report says about the SNR now, against the channels that are simulated."""

from __future__ import annotations

import math

import numpy as np
import pytest

from comvla.errors import LinkError
from comvla_client import SnrReading
from comvla_client.fading import (
    Fading,
    FadingEstimator,
    bessel_j0,
    predictive_gains,
    snr_quantiles_db,
)
from comvla_sim import channel
from comvla_sim.channel import RayleighChannel, RicianChannel

PERIOD_S = 0.01
MEAN_DB = 8.0
KINDS = {"rayleigh": (0.0, 0.0), "rician": (3.0, 0.0), "moving sight": (3.0, 6.0)}


def realisations(kappa: float, los_hz: float, doppler_hz: float, lag: int) -> np.ndarray:
    """(n, 2) SNR in dB of many links, now and ``lag`` periods earlier."""
    # Pairs far enough apart in one long channel are as good as channels of their own.
    pairs = []
    for seed in range(24):
        one = RicianChannel(MEAN_DB, doppler_hz, PERIOD_S, seed, kappa, los_hz).snr_db(20_000)
        starts = np.arange(0, 20_000 - lag, 7)
        pairs.append(np.stack([one[starts], one[starts + lag]], axis=1))
    return np.concatenate(pairs)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("lag", [1, 2, 5])
def test_the_quantile_is_undercut_as_often_as_it_says(kind: str, lag: int) -> None:
    kappa, los_hz = KINDS[kind]
    doppler_hz = 10.0
    pairs = realisations(kappa, los_hz, doppler_hz, lag)
    fading = Fading(MEAN_DB, kappa, doppler_hz, los_hz)
    reported = np.quantile(pairs[:, 0], [0.05, 0.3, 0.6, 0.95])
    for old_db in reported:
        near = np.abs(pairs[:, 0] - old_db) < 0.15
        now_db = pairs[near, 1]
        assert near.sum() > 200
        reading = SnrReading(float(old_db), age_s=lag * PERIOD_S)
        for probability in (0.05, 0.5, 0.95):
            [limit_db] = snr_quantiles_db(reading, fading, probability)
            undercut = float((now_db < limit_db).mean())
            # Four deviations of the share, and what ±0.15 dB of the report blur.
            tolerance = 4 * math.sqrt(probability * (1 - probability) / near.sum()) + 0.03
            assert abs(undercut - probability) < tolerance, (old_db, probability)


@pytest.mark.parametrize("kappa", [0.0, 3.0])
def test_over_all_reports_the_outage_is_the_one_that_was_asked_for(kappa: float) -> None:
    lag, asked = 2, 0.1
    pairs = realisations(kappa, 0.0, 10.0, lag)[:: 40 if kappa else 37]
    fading = Fading(MEAN_DB, kappa, 10.0)
    limits = [
        snr_quantiles_db(SnrReading(old, lag * PERIOD_S), fading, asked)[0]
        for old in pairs[:, 0].tolist()
    ]
    outage = float((pairs[:, 1] < limits).mean())
    assert abs(outage - asked) < 4 * math.sqrt(asked * (1 - asked) / len(pairs))


def test_a_report_of_now_is_taken_at_its_word() -> None:
    fading = Fading(MEAN_DB, 3.0, 10.0)
    assert snr_quantiles_db(SnrReading(2.5), fading, 0.05, 0.95) == [2.5, 2.5]
    assert snr_quantiles_db(SnrReading(-math.inf, 1.0), fading, 0.5) == [-math.inf]
    assert snr_quantiles_db(SnrReading(2.5, 1.0), Fading(), 0.05) == [2.5]


def test_a_hardly_older_report_says_hardly_less() -> None:
    for kappa in (0.0, 3.0, 100.0):
        fading = Fading(MEAN_DB, kappa, 10.0)
        low, high = snr_quantiles_db(SnrReading(7.0, 1e-5), fading, 0.01, 0.99)
        assert 6.9 < low <= 7.0 <= high < 7.1


def test_an_ancient_report_says_nothing_but_the_margins_of_the_link() -> None:
    """The link margins at 10 % outage: 9.8 dB Rayleigh, 5.8 dB Rician κ = 3."""
    for kappa, margin_db in ((0.0, 9.8), (3.0, 5.8)):
        for fading in (Fading(MEAN_DB, kappa, None), Fading(MEAN_DB, kappa, 2.404825557695773)):
            # Without a Doppler spread any age is ancient; with this one ρ is 0 at 1/(2π) s.
            reading = SnrReading(3.0, age_s=1 / (2 * math.pi))
            [limit_db] = snr_quantiles_db(reading, Fading(MEAN_DB, 0.0, fading.doppler_hz), 0.1)
            if kappa == 0.0:
                assert abs(MEAN_DB - limit_db - margin_db) < 0.1
        gains = predictive_gains(SnrReading(MEAN_DB - 200.0, 1.0), Fading(MEAN_DB, kappa, None))
        assert abs(-10 * math.log10(np.quantile(gains, 0.1)) - margin_db) < 0.1


def test_bessel_is_the_channels_own() -> None:
    for x in (0.0, 0.5, 2.4, 3.14, 30.0):
        assert bessel_j0(x) == pytest.approx(float(channel.bessel_j0(x)), abs=1e-12)


@pytest.mark.parametrize("kappa", [0.0, 3.0, 10.0])
def test_statistics_are_learned_from_readings(kappa: float) -> None:
    estimates = []
    for seed in range(20):
        estimator = FadingEstimator()
        link = RicianChannel(MEAN_DB, 10.0, PERIOD_S, seed, kappa)
        for period, snr_db in enumerate(link.snr_db(256)):
            estimator.add(SnrReading(float(snr_db), 0.02), now_s=period * PERIOD_S + 5.0)
        estimates.append(estimator.estimate())
    mean_db = np.mean([e.mean_snr_db for e in estimates])
    assert abs(mean_db - MEAN_DB) < 0.5
    assert kappa * 0.6 - 0.1 <= np.median([e.rician_k for e in estimates]) <= kappa * 1.5 + 0.3
    doppler = [e.doppler_hz for e in estimates if e.doppler_hz is not None]
    assert len(doppler) == 20
    assert 8.0 < np.median(doppler) < 12.0


def test_readings_too_far_apart_tell_no_doppler_spread() -> None:
    estimator = FadingEstimator()
    for period, snr_db in enumerate(RayleighChannel(MEAN_DB, 10.0, 0.4, 3).snr_db(256)):
        estimator.add(SnrReading(float(snr_db)), now_s=0.4 * period)
    assert estimator.estimate().doppler_hz is None


def test_what_is_given_is_not_estimated_and_what_repeats_not_counted() -> None:
    given = Fading(5.0, 2.0, 7.0)
    estimator = FadingEstimator(given)
    assert estimator.estimate() == given
    for step in range(50):
        estimator.add(SnrReading(20.0, age_s=0.01 * step), now_s=1.0 + 0.01 * step)
    assert estimator.estimate() == given
    unknown = FadingEstimator()
    assert unknown.estimate() == Fading(None, 0.0, None)
    unknown.add(SnrReading(20.0), now_s=1.0)
    for age_s in (0.5, 1.0):
        unknown.add(SnrReading(-20.0, age_s), now_s=1.0)  # older news than the last
    assert unknown.estimate().mean_snr_db == pytest.approx(20.0)


def test_a_constant_link_is_a_large_k() -> None:
    estimator = FadingEstimator()
    for step in range(100):
        estimator.add(SnrReading(12.0), now_s=0.05 * step)
    fading = estimator.estimate()
    [limit_db] = snr_quantiles_db(SnrReading(12.0, 1.0), fading, 0.01)
    assert limit_db > 11.3


@pytest.mark.parametrize(
    "values",
    [
        {"rician_k": -1.0},
        {"doppler_hz": -1.0},
        {"mean_snr_db": math.nan},
        {"los_doppler_hz": math.inf},
    ],
)
def test_statistics_that_no_link_has_are_refused(values: dict[str, float]) -> None:
    with pytest.raises(LinkError, match=next(iter(values))):
        Fading(**values)


def test_a_probability_is_one() -> None:
    for probability in (0.0, 1.0, -0.1):
        with pytest.raises(LinkError, match="probabilities"):
            snr_quantiles_db(SnrReading(0.0, 1.0), Fading(1.0), probability)
