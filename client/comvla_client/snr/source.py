"""Readings of the link's signal-to-noise ratio, and what can give them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeAlias, runtime_checkable

from comvla.errors import LinkError
from comvla_client.budget import check_snr_db


@dataclass(frozen=True)
class SnrReading:
    """One report of the link's quality.

    Attributes:
        snr_db: signal-to-noise ratio in dB; −inf means no link.
        age_s: seconds since it was measured. At 10 Hz Doppler anything older than 20 ms says little.
        std_db: standard deviation in dB of the SNR now, given all that the source knows; None where
            it does not say.

    Raises:
        LinkError: the SNR is NaN or +inf, or the age or deviation is negative or not finite.
    """

    snr_db: float
    age_s: float = 0.0
    std_db: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "snr_db", check_snr_db(self.snr_db))
        if not (math.isfinite(self.age_s) and self.age_s >= 0.0):
            raise LinkError(f"expected an SNR age in seconds >= 0, got {self.age_s!r}")
        if self.std_db is not None and not (math.isfinite(self.std_db) and self.std_db >= 0.0):
            raise LinkError(f"expected an SNR deviation in dB >= 0, got {self.std_db!r}")


@runtime_checkable
class SnrSource(Protocol):
    """Anything that can tell the SNR when a step asks for it.

    A source that also has ``observe(report: StepReport)`` is told how each step of its client ended.
    """

    def read(self) -> SnrReading:
        """The latest reading. Called once per step on the control thread, so it must not block."""
        ...


class ConstantSnr:
    """A link that never changes.

    Args:
        snr_db: the SNR in dB.

    Raises:
        LinkError: NaN or +inf.
    """

    def __init__(self, snr_db: float) -> None:
        self._reading = SnrReading(snr_db)

    def read(self) -> SnrReading:
        """The constant."""
        return self._reading


class CallableSnr:
    """A function called once per step, e.g. ``iter(channel).__next__`` of a simulated channel.

    Args:
        function: gives the SNR in dB, or an :class:`SnrReading` where the age is known.
    """

    def __init__(self, function: Callable[[], float | SnrReading]) -> None:
        self._function = function

    def read(self) -> SnrReading:
        """What the function says now."""
        return as_reading(self._function())


SnrInput: TypeAlias = "float | Callable[[], float | SnrReading] | SnrSource"


def as_reading(value: float | SnrReading) -> SnrReading:
    """A bare number of dB as a reading of age 0; a reading unchanged."""
    return value if isinstance(value, SnrReading) else SnrReading(value)


def as_source(value: SnrInput) -> SnrSource:
    """The source that a client was configured with: a number, a function, or a source."""
    if isinstance(value, SnrSource):
        return value
    if callable(value):
        return CallableSnr(value)
    return ConstantSnr(value)
