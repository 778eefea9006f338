"""What an old SNR report says about the SNR now: Rician block fading, given and estimated.

With h the complex gain (E|h|² = 1), κ the Rician K-factor and ρ = J0(2π f_d τ) the correlation of
the scattered part over a report's age τ (Clarke's model, as in ``comvla_sim.channel``):

    h(0) = m e^{jψ} + s g,    m² = κ / (κ + 1),    s² = 1 / (κ + 1)
    h(τ) = m e^{j(ψ + 2π f_LOS τ)} + ρ (h(0) - m e^{jψ}) + s √(1 - ρ²) w

A report tells |h(0)| and nothing of the angle ψ between line of sight and gain, whose posterior is
von Mises with concentration 2 m |h(0)| / s². Averaged over ψ and the new part w, this is the
predictive distribution; κ = 0 (Rayleigh) leaves a noncentral χ² of two degrees of freedom.
"""

from __future__ import annotations

import functools
import math
from collections import deque
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from comvla.errors import LinkError
from comvla_client.snr import SnrReading

Floats = npt.NDArray[np.float64]

LARGEST_K = 1000.0
"""κ beyond which fading is not told from a constant link."""

_POINTS = 4093  # of the quasi-random rule; prime, so that no coordinate repeats early
_ANGLES = 720
_FIRST_ZERO = 2.404825557695773  # of J0


@dataclass(frozen=True)
class Fading:
    """Statistics of a fading link; what is None is estimated from the readings as they come.

    Attributes:
        mean_snr_db: mean of the *linear* SNR, in dB.
        rician_k: κ, power of the line of sight over the scattered power, linear; 0 is Rayleigh.
        doppler_hz: f_d, maximum Doppler shift in hertz. Where nothing resolves it, a report of any
            age above 0 counts as independent of the SNR now.
        los_doppler_hz: Doppler shift of the line of sight in hertz.

    Raises:
        LinkError: a value that no link has.
    """

    mean_snr_db: float | None = None
    rician_k: float | None = None
    doppler_hz: float | None = None
    los_doppler_hz: float = 0.0

    def __post_init__(self) -> None:
        for name, least in (
            ("mean_snr_db", -math.inf),
            ("rician_k", 0.0),
            ("doppler_hz", 0.0),
            ("los_doppler_hz", -math.inf),
        ):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value >= least):
                limit = "finite" if math.isinf(least) else f"finite and at least {least:g}"
                raise LinkError(f"expected {name} to be {limit}, got {value!r}")


def bessel_j0(x: float) -> float:
    """Bessel function of the first kind and order 0, by the trapezoidal rule over its integral."""
    points = int(0.6 * abs(x)) + 32
    theta = np.arange(points) * (np.pi / points)
    return float(np.cos(x * np.sin(theta)).mean())


def snr_quantiles_db(reading: SnrReading, fading: Fading, *probabilities: float) -> list[float]:
    """The SNR in dB that the link undercuts with each probability, given a report and its age.

    Args:
        reading: the report; −inf dB stays −inf, because a modem says so when there is no link.
        fading: where the mean is not known yet, or the report is of now, it is taken at its word.
        probabilities: each in (0, 1).

    Raises:
        LinkError: a probability out of range.
    """
    if not all(0.0 < probability < 1.0 for probability in probabilities):
        raise LinkError(f"expected probabilities in (0, 1), got {probabilities!r}")
    mean_db = fading.mean_snr_db
    if mean_db is None or reading.age_s == 0.0 or reading.snr_db == -math.inf:
        return [reading.snr_db] * len(probabilities)
    gains = np.quantile(predictive_gains(reading, fading), probabilities)
    return [mean_db + 10.0 * math.log10(gain) for gain in gains.tolist()]


def predictive_gains(reading: SnrReading, fading: Fading) -> Floats:
    """Equally likely values of |h|² now, a few thousand quasi-random points, shape (n,).

    Args:
        reading: the report, finite.
        fading: the mean must be known; an unknown κ counts as 0.
    """
    assert fading.mean_snr_db is not None
    kappa = min(fading.rician_k or 0.0, LARGEST_K)
    m, s = math.sqrt(kappa / (kappa + 1)), math.sqrt(1 / (kappa + 1))
    age_s = reading.age_s
    rho = 0.0 if fading.doppler_hz is None else bessel_j0(2 * math.pi * fading.doppler_hz * age_s)
    r = 10.0 ** ((reading.snr_db - fading.mean_snr_db) / 20.0)
    angle_ranks, new_part = _unit_points()
    sight = m * np.exp(1j * _von_mises(angle_ranks, 2 * m * r / s**2))
    moved = sight * np.exp(2j * math.pi * fading.los_doppler_hz * age_s)
    gain = moved + rho * (r - sight) + s * math.sqrt(max(0.0, 1 - rho**2)) * new_part
    power: Floats = np.abs(gain) ** 2
    return power


@functools.cache
def _unit_points() -> tuple[Floats, npt.NDArray[np.complex128]]:
    """Points of a Kronecker lattice: ranks in (0, 1), and complex Gaussians of power 1."""
    index = np.arange(_POINTS)[:, None]
    # Powers of the root of x⁴ = x + 1 fill three dimensions evenly.
    root = 1.2207440846057596
    u = (0.5 + index * root ** -np.arange(1.0, 4.0)) % 1.0
    new_part = np.sqrt(-np.log1p(-u[:, 1])) * np.exp(2j * np.pi * u[:, 2])
    return u[:, 0], new_part


def _von_mises(ranks: Floats, concentration: float) -> Floats:
    """Angles with density ∝ exp(concentration · cos ψ), by their ranks."""
    # A sharp peak needs its grid where it is: beyond 8 deviations there is nothing.
    width = min(math.pi, 8.0 / math.sqrt(max(concentration, 1e-9)))
    edges = np.linspace(-width, width, _ANGLES + 1)
    middles = (edges[1:] + edges[:-1]) / 2
    share = np.cumsum(np.exp(concentration * (np.cos(middles) - 1.0)))
    return np.interp(ranks, np.concatenate([[0.0], share / share[-1]]), edges)


class FadingEstimator:
    """Fills the gaps of given statistics from the readings of a link.

    Mean and κ come from the first two moments of the linear SNR: its squared coefficient of
    variation is (1 + 2κ) / (1 + κ)². f_d comes from the correlation of readings in a row, where it
    is plain enough to be told from none.

    Args:
        given: what is known; None fields are estimated.
        memory: readings that count, the latest ones.
    """

    LEAST = 12
    """Readings before anything but the mean is believed."""

    def __init__(self, given: Fading | None = None, memory: int = 256) -> None:
        self._given = given or Fading()
        self._seen: deque[tuple[float, float]] = deque(maxlen=memory)  # time in s, linear SNR
        self._estimate: Fading | None = None

    def add(self, reading: SnrReading, now_s: float) -> None:
        """Takes a reading in.

        Args:
            reading: the report.
            now_s: the time now, in seconds on any clock that does not run backwards.
        """
        measured_s = now_s - reading.age_s
        if self._seen and measured_s <= self._seen[-1][0]:
            return  # the same report again
        self._seen.append((measured_s, 10.0 ** (reading.snr_db / 10.0)))
        self._estimate = None

    def estimate(self) -> Fading:
        """The statistics as far as they are known; Rayleigh where too little was seen."""
        if self._estimate is None:
            self._estimate = self._of_seen()
        return self._estimate

    def _of_seen(self) -> Fading:
        given = self._given
        snr = np.array([value for _, value in self._seen])
        mean_db = given.mean_snr_db
        if mean_db is None and snr.size and snr.mean() > 0.0:
            mean_db = 10.0 * math.log10(snr.mean())
        kappa = given.rician_k
        if kappa is None:
            kappa = _moment_k(snr) if snr.size >= self.LEAST else 0.0
        doppler_hz = given.doppler_hz
        if doppler_hz is None and snr.size >= self.LEAST:
            doppler_hz = self._doppler_hz(snr, kappa)
        return Fading(mean_db, kappa, doppler_hz, given.los_doppler_hz)

    def _doppler_hz(self, snr: Floats, kappa: float) -> float | None:
        steps_s = np.diff([time_s for time_s, _ in self._seen])
        lag_s = float(np.median(steps_s))
        alike = np.abs(steps_s - lag_s) <= 0.2 * lag_s
        before, after = snr[:-1][alike], snr[1:][alike]
        if before.size < self.LEAST or before.std() == 0.0 or after.std() == 0.0:
            return None
        correlation = float(np.corrcoef(before, after)[0, 1])
        if correlation < 3.0 / math.sqrt(before.size):
            return None
        # (ρ² + 2κρ) / (1 + 2κ), solved for ρ on the first, falling part of J0.
        rho = math.sqrt(kappa**2 + (1 + 2 * kappa) * correlation) - kappa
        low, high = 0.0, _FIRST_ZERO
        for _ in range(40):
            middle = (low + high) / 2
            low, high = (middle, high) if bessel_j0(middle) > rho else (low, middle)
        return low / (2 * math.pi * lag_s)


def _moment_k(snr: Floats) -> float:
    mean = float(snr.mean())
    if mean <= 0.0:
        return 0.0
    spread = float(snr.var(ddof=1)) / mean**2
    if spread >= 1.0:
        return 0.0
    free = 1.0 - spread
    return min(LARGEST_K, (free + math.sqrt(free)) / max(spread, 1e-12))
