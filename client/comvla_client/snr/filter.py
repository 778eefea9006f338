"""A Kalman filter for the SNR of a fading link, in dB: a level that drifts, and fading around it.

    x(t) = m(t) + f(t),   m: random walk, d Var = q dt,   f: mean 0, Cov(f(t), f(t + a)) = σ² exp(−a / τ)

The level m is what distance and shadowing make of the link; f is multipath fading, which nobody can
predict for longer than the coherence time τ. What was measured long ago therefore still tells the
level, and nothing about the fading.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

RAYLEIGH_STD_DB = 5.57
"""Standard deviation of Rayleigh fading in dB: that of 10 log10 of an exponential variable."""

_WIDEST_VARIANCE = 900.0  # (30 dB)²: what is known of a link of which nothing was measured for long


@dataclass(frozen=True)
class Gaussian:
    """A normal distribution.

    Attributes:
        mean: in dB.
        variance: in dB², more than 0.
    """

    mean: float
    variance: float

    def times(self, other: Gaussian) -> Gaussian:
        """The normalised product: what two independent opinions say together (Bayes)."""
        share = other.variance / (self.variance + other.variance)  # of this one
        mean = share * self.mean + (1.0 - share) * other.mean
        # Rounding must not carry the mean out of the interval between the two.
        low, high = sorted((self.mean, other.mean))
        return Gaussian(min(max(mean, low), high), share * self.variance)

    def below(self, bound: float) -> Gaussian:
        """Moments of this distribution cut off above ``bound`` (at most 2 deviations below its mean).

        The limit keeps one observation from overthrowing all others: a lost answer may have had
        another reason than the link. Several of them in a row do overthrow it.
        """
        std = math.sqrt(self.variance)
        alpha = max((bound - self.mean) / std, -2.0)
        below = 0.5 * math.erfc(-alpha / math.sqrt(2.0))
        hazard = math.exp(-0.5 * alpha * alpha) / math.sqrt(2.0 * math.pi) / below
        return Gaussian(
            self.mean - std * hazard, self.variance * (1.0 - alpha * hazard - hazard * hazard)
        )

    def over(self, other: Gaussian) -> Gaussian | None:
        """What ``other`` must be multiplied with to give this; None where that says nothing."""
        precision = 1.0 / self.variance - 1.0 / other.variance
        if precision <= 1e-9:
            return None
        mean = (self.mean / self.variance - other.mean / other.variance) / precision
        return Gaussian(mean, 1.0 / precision)


class FadingFilter:
    """Knows the link from noisy measurements of its SNR.

    Args:
        coherence_s: τ, seconds after which fading has changed.
        fading_std_db: σ, its deviation in dB.
        drift_db: what the level moves in a second, as a deviation in dB.
    """

    def __init__(self, coherence_s: float, fading_std_db: float, drift_db: float) -> None:
        self._coherence_s = coherence_s
        self._fading_variance = fading_std_db**2
        self._drift_variance = drift_db**2
        self._time_s: float | None = None
        self._level = self._fading = 0.0
        # Variances of level and fading, and their covariance.
        self._level_variance = self._fading_variance_now = self._covariance = 0.0
        self._lowest, self._highest = math.inf, -math.inf

    def at(self, time_s: float) -> Gaussian | None:
        """What is known of the SNR at a time; None where nothing was ever measured."""
        if self._time_s is None:
            return None
        self._go_to(time_s)
        return Gaussian(self._clipped(self._level + self._fading), self._variance())

    def measure(self, measured: Gaussian, time_s: float) -> None:
        """Takes in a measurement, with its own noise as variance."""
        self._lowest = min(self._lowest, measured.mean)
        self._highest = max(self._highest, measured.mean)
        if self._time_s is None:
            # Of the level nothing was known, so it takes all: m = y − f − noise.
            self._time_s = time_s
            self._level, self._fading = measured.mean, 0.0
            self._level_variance = self._fading_variance + measured.variance
            self._fading_variance_now = self._fading_variance
            self._covariance = -self._fading_variance
            return
        self._go_to(time_s)
        innovation = measured.mean - self._level - self._fading
        to_level = self._level_variance + self._covariance
        to_fading = self._fading_variance_now + self._covariance
        total = self._variance() + measured.variance
        self._level += to_level / total * innovation
        self._fading += to_fading / total * innovation
        self._level_variance -= to_level**2 / total
        self._fading_variance_now -= to_fading**2 / total
        self._covariance -= to_level * to_fading / total

    def _go_to(self, time_s: float) -> None:
        assert self._time_s is not None
        elapsed_s = max(0.0, time_s - self._time_s)
        self._time_s += elapsed_s
        kept = math.exp(-elapsed_s / self._coherence_s)
        self._fading *= kept
        self._covariance *= kept
        self._fading_variance_now = (
            kept**2 * self._fading_variance_now + (1.0 - kept**2) * self._fading_variance
        )
        drifted = self._level_variance + self._drift_variance * elapsed_s
        self._level_variance = max(self._level_variance, min(drifted, _WIDEST_VARIANCE))

    def _variance(self) -> float:
        variance = self._level_variance + self._fading_variance_now + 2.0 * self._covariance
        return max(variance, 1e-6)

    def _clipped(self, snr_db: float) -> float:
        return min(max(snr_db, self._lowest), self._highest)
