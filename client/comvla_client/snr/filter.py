"""A Kalman filter for the SNR of a fading link, in dB.

Three things are unknown, and each forgets at its own pace (Ornstein-Uhlenbeck processes: mean 0 or
a first guess, stationary deviation σ, covariance σ² exp(−a / τ) over a time a):

* the **level** that distance and shadowing make of the link: seconds to minutes;
* **fading** around it, which nobody can predict for longer than the coherence time;
* the **bias** of what a modem reports: it hears the downlink, and has its own idea of noise.

The uplink's SNR is level + fading. Goodput measures that sum; a report measures level + bias and as
much of the fading as its age has left. So a biased modem is found out by what arrives, and old
measurements still tell the level.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

RAYLEIGH_STD_DB = 5.57
"""Standard deviation of Rayleigh fading in dB: that of 10 log10 of an exponential variable."""


@dataclass(frozen=True)
class Gaussian:
    """A normal distribution.

    Attributes:
        mean: in dB.
        variance: in dB², more than 0.
    """

    mean: float
    variance: float

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
        """The measurement that turns ``other`` into this; None where it would say nothing."""
        precision = 1.0 / self.variance - 1.0 / other.variance
        if precision <= 1e-9:
            return None
        mean = (self.mean / self.variance - other.mean / other.variance) / precision
        return Gaussian(mean, 1.0 / precision)


@dataclass(frozen=True)
class Process:
    """How one of the unknowns moves.

    Attributes:
        std_db: its stationary deviation, in dB.
        memory_s: τ, seconds in which it forgets.
    """

    std_db: float
    memory_s: float


class LinkFilter:
    """Knows the link from measurements of its rate and reports of its SNR.

    Args:
        level_db: first guess of the level, to which it returns when nothing is heard for long.
        level: how the level moves.
        fading: how fading moves; its memory is the coherence time.
        bias: how the bias of reports moves.
        time_s: now, on a clock of the caller's; later calls must not go back.
    """

    def __init__(
        self, level_db: float, level: Process, fading: Process, bias: Process, time_s: float
    ) -> None:
        processes = (level, fading, bias)
        self._memory_s = np.array([process.memory_s for process in processes])
        self._stationary = np.diag([process.std_db**2 for process in processes])
        self._fading = fading
        self._rest = np.array([level_db, 0.0, 0.0])
        self._state = self._rest.copy()  # level, fading, bias
        self._covariance = self._stationary.copy()
        self._time_s = time_s
        self._lowest = self._highest = level_db

    def at(self, time_s: float) -> Gaussian:
        """What is known of the uplink's SNR at a time."""
        self._go_to(time_s)
        sees = np.array([1.0, 1.0, 0.0])
        mean = float(sees @ self._state)
        # The sum of a bias that was learned and a report that jumps may leave all that was ever
        # heard; a budget should not.
        mean = min(max(mean, self._lowest), self._highest)
        return Gaussian(mean, max(float(sees @ self._covariance @ sees), 1e-6))

    def measure(self, measured: Gaussian, time_s: float) -> None:
        """Takes in the uplink's SNR as it was just seen; the variance is the measurement's own."""
        self._go_to(time_s)
        self._update(np.array([1.0, 1.0, 0.0]), measured)

    def report(self, reported: Gaussian, age_s: float, time_s: float) -> None:
        """Takes in what a modem says; the variance is its noise from one report to the next."""
        self._go_to(time_s)
        kept = math.exp(-age_s / self._fading.memory_s)
        other_fading = (1.0 - kept**2) * self._fading.std_db**2
        noisy = Gaussian(reported.mean, reported.variance + other_fading)
        self._update(np.array([1.0, kept, 1.0]), noisy)

    def _update(self, sees: np.ndarray, measured: Gaussian) -> None:
        self._lowest = min(self._lowest, measured.mean)
        self._highest = max(self._highest, measured.mean)
        spread = self._covariance @ sees
        gain = spread / (sees @ spread + measured.variance)
        self._state = self._state + gain * (measured.mean - sees @ self._state)
        covariance = self._covariance - np.outer(gain, spread)
        self._covariance = (covariance + covariance.T) / 2.0

    def _go_to(self, time_s: float) -> None:
        elapsed_s = max(0.0, time_s - self._time_s)
        self._time_s += elapsed_s
        kept = np.exp(-elapsed_s / self._memory_s)
        self._state = self._rest + kept * (self._state - self._rest)
        self._covariance = self._stationary + np.outer(kept, kept) * (
            self._covariance - self._stationary
        )
