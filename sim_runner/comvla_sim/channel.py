"""The SNR of a radio link, one value for each control period.

Block fading: within a control period of T seconds the channel is constant. In period t it is

    h[t] = sqrt(κ / (κ + 1)) exp(j (2π f_LOS t T + φ0)) + sqrt(1 / (κ + 1)) g[t],
    E[g[t + d] g*[t]] = J0(2π f_d d T),        SNR[t] = mean SNR · |h[t]|²,

with g complex Gaussian, φ0 uniform, f_d the Doppler spread and κ the Rician K-factor (Clarke's
model; κ = 0 is Rayleigh fading). Every channel here is an iterable without end: ``for snr_db in
channel`` always starts at period 0, and the same seed gives the same values everywhere.
"""

from __future__ import annotations

import abc
import csv
import functools
import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from comvla.errors import LinkError

BLOCK_PERIODS = 256
"""Fading is drawn in blocks of so many periods, each conditioned on the one before."""

# Eigenvalues below this share of the largest are rounding noise: slow fading is almost perfectly
# predictable, and its covariance has numerically few dimensions.
_EIGENVALUE_FLOOR = 1e-10


class Channel(abc.ABC):
    """A radio channel: iterating gives the SNR in dB of period 0, 1, 2, ... without end."""

    @abc.abstractmethod
    def __iter__(self) -> Iterator[float]:
        """The SNR in dB of every control period, from period 0; ``-inf`` where there is no link."""

    def snr_db(self, periods: int) -> npt.NDArray[np.float64]:
        """The first values, shape (periods,), in dB."""
        return np.fromiter(itertools.islice(self, periods), np.float64, periods)


def _checked(name: str, value: float, *, unit: str, minimum: float = -math.inf) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise LinkError(f"{name} must be a number{unit}, got {value!r}") from None
    if not math.isfinite(number) or number < minimum:
        limit = "finite" if math.isinf(minimum) else f"finite and at least {minimum:g}"
        raise LinkError(f"{name} must be {limit}{unit}, got {value!r}")
    return number


class ConstantChannel(Channel):
    """A link that never changes.

    Args:
        snr_db: in dB; ``-inf`` is a link that is always down.

    Raises:
        LinkError: for NaN or plus infinity.
    """

    def __init__(self, snr_db: float) -> None:
        no_link = snr_db == -math.inf
        self._snr_db = -math.inf if no_link else _checked("snr_db", snr_db, unit=" (dB)")

    def __iter__(self) -> Iterator[float]:
        return itertools.repeat(self._snr_db)


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
        self.mean_snr_db = _checked("mean_snr_db", mean_snr_db, unit=" (dB)")
        self.doppler_hz = _checked("doppler_hz", doppler_hz, unit=" (Hz)", minimum=0.0)
        self.period_s = _checked("period_s", period_s, unit=" (seconds)", minimum=0.0)
        if self.period_s == 0:
            raise LinkError("period_s must be more than 0 seconds: give the control period")
        if not isinstance(seed, int | np.integer) or not 0 <= seed < 2**32:
            raise LinkError(f"seed must be an integer in [0, 2**32), got {seed!r}")
        self.seed = int(seed)
        self.rician_k = _checked("rician_k", rician_k, unit=" (linear, not dB)", minimum=0.0)
        self.los_doppler_hz = _checked("los_doppler_hz", los_doppler_hz, unit=" (Hz)")

    def _blocks(self) -> Iterator[npt.NDArray[np.complex128]]:
        # RandomState, unlike Generator, promises the same stream for ever: a seed stays a channel.
        random = np.random.RandomState(self.seed)
        phase = random.uniform(0, 2 * np.pi)
        factors = _gaussian_blocks(self.doppler_hz * self.period_s)
        line_of_sight = math.sqrt(self.rician_k / (self.rician_k + 1))
        scattered = math.sqrt(1 / (self.rician_k + 1))

        def noise(size: int) -> npt.NDArray[np.float64]:
            return random.standard_normal((size, 2)) / math.sqrt(2)

        g = factors.first @ noise(factors.first.shape[1])  # (n, 2): real and imaginary parts
        for block in itertools.count():
            time_s = self.period_s * (block * BLOCK_PERIODS + np.arange(BLOCK_PERIODS))
            angle = 2 * np.pi * self.los_doppler_hz * time_s + phase
            yield line_of_sight * np.exp(1j * angle) + scattered * (g[:, 0] + 1j * g[:, 1])
            g = factors.predict @ g + factors.innovation @ noise(BLOCK_PERIODS)

    def gains(self, periods: int) -> npt.NDArray[np.complex128]:
        """The complex gains h of the first periods, shape (periods,); E|h|² = 1."""
        blocks = -(-periods // BLOCK_PERIODS)
        values: list[npt.NDArray[np.complex128]] = [np.empty(0, np.complex128)]
        values.extend(itertools.islice(self._blocks(), blocks))
        gains: npt.NDArray[np.complex128] = np.concatenate(values)[:periods]
        return gains

    def __iter__(self) -> Iterator[float]:
        for block in self._blocks():
            with np.errstate(divide="ignore"):  # a gain of exactly 0 is -inf dB: no link
                snr_db = self.mean_snr_db + 20 * np.log10(np.abs(block))
            yield from snr_db.tolist()


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


class TraceChannel(Channel):
    """A recorded link, repeated from its start when it ends.

    The file is text: one SNR in dB per line, or CSV with a header that has a column ``snr_db``.
    Empty lines and lines that start with ``#`` are skipped; ``-inf`` means no link.

    Args:
        path: the file; one value for each control period.

    Raises:
        LinkError: for a file that cannot be read, has no values, or has one that is no SNR; the
            message names the line.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        try:
            lines = self.path.read_text(encoding="utf-8").splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise LinkError(f"cannot read the SNR trace {self.path}: {error}") from error
        numbered = [(i, line.strip()) for i, line in enumerate(lines, start=1)]
        numbered = [(i, line) for i, line in numbered if line and not line.startswith("#")]
        column = 0
        if numbered:
            header = [cell.strip() for cell in next(csv.reader([numbered[0][1]]))]
            if "snr_db" in header:
                column = header.index("snr_db")
                numbered = numbered[1:]
        self._values = [self._value(i, line, column) for i, line in numbered]
        if not self._values:
            raise LinkError(f"the SNR trace {self.path} has no values: one SNR in dB per line")

    def _value(self, number: int, line: str, column: int) -> float:
        cells = next(csv.reader([line]))
        try:
            value = float(cells[column])
        except (IndexError, ValueError):
            value = math.nan
        if math.isnan(value) or value == math.inf:
            raise LinkError(
                f"{self.path}, line {number}: expected an SNR in dB (or -inf for no link), "
                f"got {line!r}"
            )
        return value

    def __len__(self) -> int:
        """Periods in the file."""
        return len(self._values)

    def __iter__(self) -> Iterator[float]:
        return itertools.cycle(self._values)
