"""Rayleigh and Rician block fading with the exact autocorrelation of Clarke's model.

Within a control period of T seconds the channel is constant. In period t it is

    h[t] = sqrt(κ / (κ + 1)) exp(j (2π f_LOS t T + φ0)) + sqrt(1 / (κ + 1)) g[t],
    E[g[t + d] g*[t]] = J0(2π f_d d T),        SNR[t] = mean SNR · |h[t]|²,

with g complex Gaussian, φ0 uniform, f_d the Doppler spread and κ the Rician K-factor; κ = 0 is
Rayleigh fading.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from comvla_sim.channel.base import Channel, checked, checked_period_s, checked_seed

BLOCK_PERIODS = 256
"""Fading is drawn in blocks of so many periods, each conditioned on the one before."""

# Eigenvalues below this share of the largest are rounding noise: slow fading is almost perfectly
# predictable, and its covariance has numerically few dimensions.
_EIGENVALUE_FLOOR = 1e-10


def bessel_j0(x: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Bessel function of the first kind and order 0, to about 1e-14.

    J0(x) = (1/π) ∫ cos(x sin θ) dθ over [0, π) by the trapezoidal rule. The integrand is periodic
    and analytic, so n points leave an error of 2 J_2n(x), which vanishes faster than exponentially
    once 2n exceeds |x|.
    """
    values = np.abs(np.asarray(x, dtype=np.float64))
    result = np.empty_like(values)
    for index, value in np.ndenumerate(values):
        points = int(0.6 * value) + 32
        theta = np.arange(points) * (np.pi / points)
        result[index] = np.cos(value * np.sin(theta)).mean()
    return result


@dataclass(frozen=True)
class _GaussianBlocks:
    """How to draw a stationary Gaussian sequence block by block.

    With R the (n, n) covariance of a block and C that of a block with the one before:

    Attributes:
        first: (n, r), a square root of R, for the first block.
        predict: (n, n), C R^-1: the mean of a block, given the one before.
        innovation: (n, n), a square root of R - C R^-1 C^T.
    """

    first: npt.NDArray[np.float64]
    predict: npt.NDArray[np.float64]
    innovation: npt.NDArray[np.float64]


@functools.lru_cache(maxsize=16)
def _gaussian_blocks(cycles_per_period: float) -> _GaussianBlocks:
    """Factors for the covariance J0(2π f_d T d).

    The joint law of two neighbouring blocks is exact, whatever f_d T is. A Cholesky factor does the
    same for fast fading; eigenvectors also serve slow fading, whose covariance is singular to
    machine precision.
    """
    n = BLOCK_PERIODS
    correlation = bessel_j0(2 * np.pi * cycles_per_period * np.arange(2 * n))
    row, column = np.indices((n, n))
    within = correlation[np.abs(row - column)]
    across = correlation[n + row - column]
    values, vectors = np.linalg.eigh(within)
    kept = values > _EIGENVALUE_FLOOR * values[-1]
    values, vectors = values[kept], vectors[:, kept]
    predict = (across @ vectors / values) @ vectors.T
    rest = within - predict @ across.T
    rest_values, rest_vectors = np.linalg.eigh((rest + rest.T) / 2)
    return _GaussianBlocks(
        first=vectors * np.sqrt(values),
        predict=predict,
        innovation=rest_vectors * np.sqrt(np.clip(rest_values, 0.0, None)),
    )


class RicianChannel(Channel):
    """Rician fading with a Jakes spectrum and a line of sight.

    The SNR follows mean · ncx2(df=2, nc=2κ) / (2 (κ + 1)). With ρ = J0(2π f_d τ), its
    autocorrelation coefficient is (ρ² + 2κ ρ cos(2π f_LOS τ)) / (1 + 2κ).

    Args:
        mean_snr_db: in dB, the mean of the *linear* SNR over time.
        doppler_hz: f_d, maximum Doppler shift in Hz; 0 draws one gain for ever.
        period_s: T, control period in seconds.
        seed: an integer in [0, 2**32).
        rician_k: κ, power of the line of sight over the scattered power, linear; 0 is Rayleigh.
        los_doppler_hz: Doppler shift of the line of sight in Hz.

    Raises:
        LinkError: for a value that makes no sense.
    """

    def __init__(
        self,
        mean_snr_db: float,
        doppler_hz: float,
        period_s: float,
        seed: int,
        rician_k: float,
        los_doppler_hz: float = 0.0,
    ) -> None:
        self.mean_snr_db = checked("mean_snr_db", mean_snr_db, unit=" (dB)")
        self.doppler_hz = checked("doppler_hz", doppler_hz, unit=" (Hz)", minimum=0.0)
        self.period_s = checked_period_s(period_s)
        self.seed = checked_seed(seed)
        self.rician_k = checked("rician_k", rician_k, unit=" (linear, not dB)", minimum=0.0)
        self.los_doppler_hz = checked("los_doppler_hz", los_doppler_hz, unit=" (Hz)")

    def _blocks(self) -> Iterator[npt.NDArray[np.complex128]]:
        for (block,) in self._blocks_of([self.seed]):
            yield block

    def _blocks_of(
        self, seeds: Sequence[int], periods: int | None = None
    ) -> Iterator[npt.NDArray[np.complex128]]:
        """Gains (seeds, BLOCK_PERIODS) block after block; with ``periods``, only as many as asked."""
        factors = _gaussian_blocks(self.doppler_hz * self.period_s)
        one_block = periods is not None and periods <= BLOCK_PERIODS
        # RandomState, unlike Generator, promises the same stream for ever: a seed stays a channel.
        shared = np.random.RandomState(0)
        randoms, phases, first = [], [], []
        for seed in seeds:
            if one_block:  # seeding anew is much cheaper than making anew
                shared.seed(seed)
            randoms.append(shared if one_block else np.random.RandomState(seed))
            phases.append(randoms[-1].uniform(0, 2 * np.pi))
            first.append(randoms[-1].standard_normal((factors.first.shape[1], 2)))
        # (seeds, periods, 2): real and imaginary parts
        g = np.matmul(factors.first[:periods], np.stack(first) / math.sqrt(2))
        yield self._with_line_of_sight(g, phases, 0)
        for block in itertools.count(1):
            if periods is not None and block * BLOCK_PERIODS >= periods:
                return
            noise = np.stack([r.standard_normal((BLOCK_PERIODS, 2)) for r in randoms])
            noise /= math.sqrt(2)
            g = np.matmul(factors.predict, g) + np.matmul(factors.innovation, noise)
            yield self._with_line_of_sight(g, phases, block)

    def _with_line_of_sight(
        self, g: npt.NDArray[np.float64], phases: Sequence[float], block: int
    ) -> npt.NDArray[np.complex128]:
        time_s = self.period_s * (block * BLOCK_PERIODS + np.arange(g.shape[1]))
        angles = 2 * np.pi * self.los_doppler_hz * time_s + np.array(phases)[:, None]
        sight = math.sqrt(self.rician_k / (self.rician_k + 1)) * np.exp(1j * angles)
        gains: npt.NDArray[np.complex128] = sight + math.sqrt(1 / (self.rician_k + 1)) * (
            g[..., 0] + 1j * g[..., 1]
        )
        return gains

    def gains(self, periods: int) -> npt.NDArray[np.complex128]:
        """The complex gains h of the first periods, shape (periods,); E|h|² = 1."""
        # Whole blocks, as iterating draws them: parts may differ in their last bits.
        blocks = itertools.islice(self._blocks(), -(-periods // BLOCK_PERIODS))
        gains: npt.NDArray[np.complex128] = np.concatenate([np.empty(0, np.complex128), *blocks])
        return gains[:periods]

    def gains_of(self, seeds: Sequence[int], periods: int) -> npt.NDArray[np.complex128]:
        """Complex gains of many independent channels that differ in their seed only.

        Args:
            seeds: of the channels; this channel's own counts for nothing here.
            periods: of each.

        Returns:
            (seeds, periods): row i is what a channel with seed ``seeds[i]`` has for gains, but for
            rounding.
        """
        checked_seeds = [checked_seed(seed) for seed in seeds]
        if not checked_seeds:
            return np.empty((0, periods), np.complex128)
        blocks = list(self._blocks_of(checked_seeds, periods))
        gains: npt.NDArray[np.complex128] = np.concatenate(blocks, axis=1)[:, :periods]
        return gains

    def _to_snr_db(self, gains: npt.NDArray[np.complex128]) -> npt.NDArray[np.float64]:
        with np.errstate(divide="ignore"):  # a gain of exactly 0 is -inf dB: no link
            snr_db: npt.NDArray[np.float64] = self.mean_snr_db + 20 * np.log10(np.abs(gains))
        return snr_db

    def snr_db(self, periods: int) -> npt.NDArray[np.float64]:
        """The first values, shape (periods,), in dB."""
        return self._to_snr_db(self.gains(periods))

    def __iter__(self) -> Iterator[float]:
        for block in self._blocks():
            yield from self._to_snr_db(block).tolist()


class RayleighChannel(RicianChannel):
    """Rayleigh fading with a Jakes spectrum: no line of sight, exponentially distributed SNR.

    Args:
        mean_snr_db: in dB, the mean of the *linear* SNR over time.
        doppler_hz: f_d, maximum Doppler shift in Hz.
        period_s: T, control period in seconds.
        seed: an integer in [0, 2**32).

    Raises:
        LinkError: for a value that makes no sense.
    """

    def __init__(self, mean_snr_db: float, doppler_hz: float, period_s: float, seed: int) -> None:
        super().__init__(mean_snr_db, doppler_hz, period_s, seed, rician_k=0.0)
