"""Devices that have to be asked: a thread asks them, so that a step never waits."""

from __future__ import annotations

import abc
import logging
import math
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import TracebackType
from typing import TYPE_CHECKING, Any

from comvla.errors import ComVLAError
from comvla_client.errors import SnrSourceError
from comvla_client.snr.source import SnrReading

if TYPE_CHECKING:
    from typing_extensions import Self

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Measurement:
    """What a device said when it was asked.

    Attributes:
        snr_db: SNR in dB; −inf where the device knows that there is no link.
        age_s: how old that already was.
        details: the values behind it, for people and JSON.
    """

    snr_db: float
    age_s: float = 0.0
    details: Mapping[str, Any] = field(default_factory=dict)


class NoReadingYetError(SnrSourceError):
    """The device is there and has not measured yet; before the first reading this is waited out."""


class PolledSource(abc.ABC):
    """An SNR source that asks a device from a thread of its own.

    The constructor waits for the first answer, so a missing device is an error there and then. Later
    the rule is: what the device says is taken, −inf for "no link" included; what it does not say
    lets the last reading grow old (``age_s``), and :attr:`problem` says why. A broken thermometer is
    no fever: a failed poll never makes a link count as lost.

    The thread is a daemon; :meth:`close` or ``with`` ends it. The device is touched by that thread only.

    Args:
        period_s: seconds from one question to the next.
        start_timeout_s: longest that the constructor waits for the first answer.
        clock: monotonic seconds.
    """

    def __init__(
        self,
        period_s: float,
        start_timeout_s: float = 5.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        if not (math.isfinite(period_s) and period_s > 0.0):
            raise SnrSourceError(f"expected a period_s > 0 in seconds, got {period_s!r}")
        self._period_s = period_s
        self._start_timeout_s = start_timeout_s
        self._clock = clock
        self._stop = threading.Event()
        self._started = threading.Event()
        self._first_error: Exception | None = None
        # One assignment replaces it, so a reader sees either the old or the new.
        self._latest: tuple[float, Measurement] | None = None
        self._problem: str | None = None
        self._thread = threading.Thread(target=self._run, name=type(self).__name__, daemon=True)

    def read(self) -> SnrReading:
        """The latest reading and its age. Does not wait for anything."""
        assert self._latest is not None, "the constructor waited for the first reading"
        measured_s, measurement = self._latest
        return SnrReading(measurement.snr_db, max(0.0, self._clock() - measured_s))

    @property
    def details(self) -> dict[str, Any]:
        """The values behind the latest reading."""
        return {} if self._latest is None else dict(self._latest[1].details)

    @property
    def problem(self) -> str | None:
        """Why the device gives no new readings; None while it does."""
        return self._problem

    def close(self) -> None:
        """Ends the thread and frees the device. Closing twice does no harm."""
        self._stop.set()
        if self._thread.ident is not None and self._thread is not threading.current_thread():
            self._thread.join(self._start_timeout_s)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    @abc.abstractmethod
    def _measure(self) -> Measurement:
        """Asks the device.

        Raises:
            Exception: it gave no answer; the next call tries again.
        """

    @abc.abstractmethod
    def _release(self) -> None:
        """Frees the device."""

    def _start(self) -> None:
        """Begins to ask, and waits for the first answer.

        Raises:
            ComVLAError: there is none, and why.
        """
        self._thread.start()
        if not self._started.wait(self._start_timeout_s):
            self._stop.set()
            raise SnrSourceError(
                f"{type(self).__name__} got no first reading within {self._start_timeout_s:g} s: "
                + (self._problem or "use GoodputSnr, which needs no device, or ConstantSnr")
            )
        if self._first_error is not None:
            self.close()
            raise self._first_error

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                began_s = self._clock()
                try:
                    measurement = self._measure()
                except Exception as error:  # whatever a library raises must not end the thread
                    waits = self._started.is_set() or isinstance(error, NoReadingYetError)
                    if not waits:
                        self._first_error = self._first(error)
                        self._started.set()
                        return
                    self._note(str(error) or type(error).__name__)
                else:
                    self._latest = (self._clock() - measurement.age_s, measurement)
                    self._note(None)
                    self._started.set()
                self._stop.wait(max(0.0, self._period_s - (self._clock() - began_s)))
        finally:
            self._release()

    def _first(self, error: Exception) -> Exception:
        if isinstance(error, ComVLAError):
            return error
        wrapped = SnrSourceError(
            f"{type(self).__name__} got no reading ({type(error).__name__}: {error}): use "
            "GoodputSnr, which needs no device, or ConstantSnr"
        )
        wrapped.__cause__ = error
        return wrapped

    def _note(self, problem: str | None) -> None:
        if problem is not None and self._problem is None and self._started.is_set():
            _log.warning("%s: no new reading: %s", type(self).__name__, problem)
        elif problem is None and self._problem is not None:
            _log.info("%s: readings again", type(self).__name__)
        self._problem = problem
