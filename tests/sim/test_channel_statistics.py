"""Fading against its closed forms, on 20 000 independent realisations (fixed seeds: no luck)."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import special, stats

from comvla_client import LinkProfile, token_budget
from comvla_sim.channel import RayleighChannel, RicianChannel, bessel_j0

REALISATIONS = 20_000
PERIOD_S = 0.05
DOPPLER_HZ = 10.0


@functools.lru_cache
def gains(kappa: float, periods: int = 8, period_s: float = PERIOD_S) -> NDArray[np.complex128]:
    """(realisations, periods)."""
    channel = RicianChannel(0.0, DOPPLER_HZ, period_s, seed=0, rician_k=kappa)
    return channel.gains_of(range(REALISATIONS), periods)


def test_many_channels_at_once_are_those_channels() -> None:
    for periods in (1, 5, 600):
        channel = RicianChannel(0.0, DOPPLER_HZ, PERIOD_S, 3, rician_k=2.0, los_doppler_hz=1.5)
        together = channel.gains_of([7, 3, 11], periods)
        assert together.shape == (3, periods)
        for row, seed in zip(together, (7, 3, 11), strict=True):
            alone = RicianChannel(0.0, DOPPLER_HZ, PERIOD_S, seed, 2.0, 1.5)
            np.testing.assert_allclose(row, alone.gains(periods), atol=1e-12)
    assert RayleighChannel(0.0, 1.0, PERIOD_S, 0).gains_of([], 4).shape == (0, 4)


def test_rayleigh_power_is_exponential() -> None:
    power = np.abs(gains(0.0)[:, 0]) ** 2
    assert stats.kstest(power, stats.expon.cdf).pvalue > 0.01
    # The test is sharp enough to tell even a weak line of sight from none.
    assert stats.kstest(power, rician(1.0).cdf).pvalue < 1e-6  # type: ignore[attr-defined]


def rician(kappa: float) -> object:
    return stats.ncx2(df=2, nc=2 * kappa, scale=1 / (2 * (1 + kappa)))


@pytest.mark.parametrize(("kappa", "period"), [(0.5, 0), (3.0, 0), (3.0, 7), (10.0, 0)])
def test_rician_power_is_noncentral_chi_square(kappa: float, period: int) -> None:
    power = np.abs(gains(kappa)[:, period]) ** 2
    assert stats.kstest(power, rician(kappa).cdf).pvalue > 0.01  # type: ignore[attr-defined]


@pytest.mark.parametrize("lag", [1, 2, 3, 4])
def test_complex_gains_are_correlated_like_j0(lag: int) -> None:
    g = gains(0.0)
    estimate = np.mean(g[:, lag] * g[:, 0].conj())
    assert abs(estimate - special.j0(2 * np.pi * DOPPLER_HZ * lag * PERIOD_S)) < 0.02


def test_scattered_power_has_the_second_moment_of_a_complex_gaussian() -> None:
    power = np.abs(gains(0.0)) ** 2
    assert power.mean() == pytest.approx(1.0, abs=0.01)
    assert (power**2).mean() == pytest.approx(2.0, abs=0.05)


def test_our_bessel_function_is_scipys() -> None:
    x = np.concatenate([np.linspace(0, 60, 301), [3e3]])
    np.testing.assert_allclose(bessel_j0(x), special.j0(x), atol=1e-12)


def crossings_and_fades(
    envelope: NDArray[np.float64], threshold: float, period_s: float
) -> tuple[float, float]:
    """Upward crossings per second and mean duration of a fade, over all realisations."""
    below = envelope < threshold
    upward = np.count_nonzero(below[:, :-1] & ~below[:, 1:])
    rate_hz = upward / (below.shape[0] * (below.shape[1] - 1) * period_s)
    return rate_hz, below.mean() / rate_hz


FAST_S = 1 / 4000
"""Sampled at 4 kHz, where a fade of the deepest threshold lasts 16 samples."""


@pytest.mark.parametrize("rho", [0.1, 0.3, 1.0])
def test_level_crossings_and_fades_of_rayleigh(rho: float) -> None:
    rate_hz, fade_s = crossings_and_fades(np.abs(gains(0.0, 256, FAST_S)), rho, FAST_S)
    expected_hz = math.sqrt(2 * math.pi) * DOPPLER_HZ * rho * math.exp(-(rho**2))
    expected_s = (math.exp(rho**2) - 1) / (math.sqrt(2 * math.pi) * DOPPLER_HZ * rho)
    assert rate_hz == pytest.approx(expected_hz, rel=0.05)
    assert fade_s == pytest.approx(expected_s, rel=0.05)


@pytest.mark.parametrize("rho", [0.3, 0.7, 1.0])
def test_level_crossings_and_fades_of_rice(rho: float) -> None:
    kappa = 3.0
    rate_hz, fade_s = crossings_and_fades(np.abs(gains(kappa, 256, FAST_S)), rho, FAST_S)
    expected_hz = (
        math.sqrt(2 * math.pi * (kappa + 1))
        * DOPPLER_HZ
        * rho
        * math.exp(-kappa - (kappa + 1) * rho**2)
        * special.i0(2 * rho * math.sqrt(kappa * (kappa + 1)))
    )
    # 1 - Q1(√(2κ), √(2(κ + 1)) ρ) is the distribution function of |h|² at ρ².
    expected_s = rician(kappa).cdf(rho**2) / expected_hz  # type: ignore[attr-defined]
    assert rate_hz == pytest.approx(expected_hz, rel=0.05)
    assert fade_s == pytest.approx(expected_s, rel=0.05)


# Mean K*, P(K* < 16), P(K* = 0) on the paper's link with η = 0.40, known beforehand.
BUDGETS = {
    (0.0, 0.0): (19.3, 0.462, 0.030),
    (0.0, 5.0): (38.9, 0.178, 0.0096),
    (0.0, 10.0): (66.3, 0.060, 0.0031),
    (0.0, 15.0): (99.0, 0.019, 0.001),
    (0.0, 20.0): (134.7, 0.006, 0.0003),
    (3.0, 0.0): (20.8, 0.329, 0.0068),
    (3.0, 5.0): (42.7, 0.067, 0.0020),
    (3.0, 10.0): (72.5, 0.015, 0.0006),
    (3.0, 15.0): (107.0, 0.004, 0.001),
    (3.0, 20.0): (143.8, 0.001, 0.0001),
}


@pytest.mark.parametrize(("kappa", "mean_snr_db"), list(BUDGETS))
def test_token_budgets_of_the_papers_link(kappa: float, mean_snr_db: float) -> None:
    link, bits_per_token = LinkProfile(efficiency=0.4), 2176 * 8
    snr_db = mean_snr_db + 20 * np.log10(np.abs(gains(kappa)[:, 0]))
    capacity = 0.4 * 20e6 * 0.05 * np.log2(1 + 10 ** (snr_db / 10))
    budget = np.floor(capacity / bits_per_token)
    for value, k in list(zip(snr_db, budget, strict=True))[:200]:
        assert token_budget(value, link, bits_per_token) == k
    mean, below_16, none = BUDGETS[kappa, mean_snr_db]
    # Four standard errors, and half a unit of the last digit that is known.
    error = 4 / math.sqrt(REALISATIONS)
    assert budget.mean() == pytest.approx(mean, abs=error * budget.std() + 0.05)
    for share, expected in ((budget < 16, below_16), (budget == 0, none)):
        spread = math.sqrt(max(expected * (1 - expected), 1 / REALISATIONS))
        assert share.mean() == pytest.approx(expected, abs=error * spread + 0.0005)
