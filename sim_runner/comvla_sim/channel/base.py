"""What every channel is: the SNR of each control period, in dB, without end."""

from __future__ import annotations

import abc
import itertools
import math
from collections.abc import Iterable, Iterator

import numpy as np
import numpy.typing as npt

from comvla.errors import LinkError


class Channel(abc.ABC):
    """A radio channel: iterating gives the SNR in dB of period 0, 1, 2, ... without end."""

    @abc.abstractmethod
    def __iter__(self) -> Iterator[float]:
        """The SNR in dB of every control period, from period 0; ``-inf`` where there is no link."""

    def snr_db(self, periods: int) -> npt.NDArray[np.float64]:
        """The first values, shape (periods,), in dB."""
        return np.fromiter(itertools.islice(self, periods), np.float64, periods)


def checked(name: str, value: float, *, unit: str, minimum: float = -math.inf) -> float:
    """A finite number of at least ``minimum``.

    Raises:
        LinkError: names the argument, what it must be, and what came.
    """
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise LinkError(f"{name} must be a number{unit}, got {value!r}") from None
    if not math.isfinite(number) or number < minimum:
        limit = "finite" if math.isinf(minimum) else f"finite and at least {minimum:g}"
        raise LinkError(f"{name} must be {limit}{unit}, got {value!r}")
    return number


def checked_period_s(period_s: float) -> float:
    """A control period of more than 0 seconds.

    Raises:
        LinkError: anything else.
    """
    number = checked("period_s", period_s, unit=" (seconds)", minimum=0.0)
    if number == 0:
        raise LinkError("period_s must be more than 0 seconds: give the control period")
    return number


def checked_seed(seed: int) -> int:
    """A seed that a channel can have.

    Raises:
        LinkError: no integer, or outside [0, 2**32).
    """
    if not isinstance(seed, int | np.integer) or not 0 <= seed < 2**32:
        raise LinkError(f"seed must be an integer in [0, 2**32), got {seed!r}")
    return int(seed)


def checked_snr_db(name: str, value: float) -> float:
    """An SNR in dB: finite, or −inf for no link.

    Raises:
        LinkError: NaN, plus infinity, or no number.
    """
    return -math.inf if value == -math.inf else checked(name, value, unit=" (dB)")


class ConstantChannel(Channel):
    """A link that never changes.

    Args:
        snr_db: in dB; ``-inf`` is a link that is always down.

    Raises:
        LinkError: for NaN or plus infinity.
    """

    def __init__(self, snr_db: float) -> None:
        self._snr_db = checked_snr_db("snr_db", snr_db)

    def __iter__(self) -> Iterator[float]:
        return itertools.repeat(self._snr_db)


class DelayedChannel(Channel):
    """What a robot is told about a channel whose state takes some periods to reach it.

    In period t it gives the SNR of period t − d. In the first d periods nothing older than period 0
    is known, and it gives the SNR of period 0, as if the channel had stood still before.

    Args:
        channel: the true SNR in dB of each period; any iterable that can be iterated again.
        periods: d, from 0.

    Raises:
        LinkError: d is no whole number from 0.
    """

    def __init__(self, channel: Iterable[float], periods: int) -> None:
        is_count = isinstance(periods, int | np.integer) and not isinstance(periods, bool)
        if not is_count or periods < 0:
            raise LinkError(f"a delay is a whole number of control periods from 0, got {periods!r}")
        self.channel = channel
        self.periods = int(periods)

    def __iter__(self) -> Iterator[float]:
        values = iter(self.channel)
        first = next(values, None)
        if first is None:
            return
        yield from itertools.repeat(first, self.periods + 1)
        yield from values

    def pairs(self) -> Iterator[tuple[float, float]]:
        """(reported, true) SNR in dB of each period."""
        return zip(self, self.channel, strict=False)  # a true channel that ends, ends first


def delayed(channel: Iterable[float], periods: int) -> DelayedChannel:
    """Stale channel state: what is reported of ``channel`` when reports are d periods old.

    Args:
        channel: the true SNR in dB of each period.
        periods: d; 0 reports the truth.

    Returns:
        A channel of the reported SNR; its ``pairs()`` are (reported, true).

    Raises:
        LinkError: d is no whole number from 0.
    """
    return DelayedChannel(channel, periods)
