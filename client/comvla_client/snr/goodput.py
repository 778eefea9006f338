"""The SNR from nothing but what the link was seen to carry."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable

from comvla.errors import LinkError
from comvla_client.budget import PAPER_LINK, LinkProfile, check_snr_db
from comvla_client.report import StepReport
from comvla_client.snr.evidence import Evidence, equivalent_snr_db, evidence_of
from comvla_client.snr.filter import RAYLEIGH_STD_DB, Gaussian, LinkFilter, Process
from comvla_client.snr.source import SnrReading

LOWEST_DB, HIGHEST_DB = -40.0, 80.0
"""Beyond these no radio works, or none needs better; what comes in is clipped to them."""


class GoodputSnr:
    """An equivalent SNR from acknowledged bytes: works over any interface, and needs no modem.

    It says what Eq. (1) needs to hear for the budget to be what the link really carried. Each step
    of the client is evidence (:func:`~comvla_client.snr.evidence.evidence_of`), a step without an
    answer too: the link was slower than what was sent. A failure therefore never raises the value.

    Before the first answer it is ``initial_db``, and back there a link drifts that was silent for
    long, so that a robot that stopped sending tries again. ``age_s`` is that of the newest evidence,
    ``std_db`` what remains unknown. Safe to use from several threads.

    Args:
        link: the profile whose Eq. (1) turns rates into SNR; use the client's own.
        initial_db: a first guess of the mean SNR, in dB.
        level_std_db: how far off it may be, in dB.
        level_memory_s: seconds in which the mean SNR of a moving robot becomes another one.
        coherence_s: seconds after which fading has changed; about 0.2 / Doppler spread.
        fading_std_db: how deep it fades, in dB.
        goodput_std_db: error of one measurement of goodput, in dB.
        round_trip_s: what a call without payload takes (``comvla doctor`` measures it). Left at 0,
            goodput errs on the low side.
        clock: monotonic seconds.

    Raises:
        LinkError: a parameter that is not finite and positive.
    """

    def __init__(
        self,
        link: LinkProfile = PAPER_LINK,
        *,
        initial_db: float = 10.0,
        level_std_db: float = 10.0,
        level_memory_s: float = 60.0,
        coherence_s: float = 0.02,
        fading_std_db: float = RAYLEIGH_STD_DB,
        goodput_std_db: float = 2.0,
        round_trip_s: float = 0.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._link = link
        self._level = checked_process("level", level_std_db, level_memory_s)
        self._fading = checked_process("fading", fading_std_db, coherence_s)
        self._goodput_variance = checked("goodput_std_db", goodput_std_db) ** 2
        if not (math.isfinite(round_trip_s) and round_trip_s >= 0.0):
            raise LinkError(f"expected a round_trip_s >= 0 in seconds, got {round_trip_s!r}")
        self._round_trip_s = round_trip_s
        self._clock = clock
        self._lock = threading.Lock()
        self._news_s = clock()
        self._filter = self._new_filter(check_snr_db(initial_db), Process(1.0, 1.0))

    def read(self) -> SnrReading:
        """The estimate now."""
        with self._lock:
            return self._estimate(self._clock())

    def observe(self, report: StepReport) -> None:
        """Takes in how a step ended; the client calls this after each."""
        evidence = evidence_of(report, self._link, self._round_trip_s)
        if evidence is not None:
            self._take(evidence)

    def observe_transfer(self, delivered_bytes: float, elapsed_s: float) -> None:
        """Takes in bytes that were acknowledged, for programs with traffic of their own.

        Raises:
            LinkError: no bytes, or no time.
        """
        self._take(Evidence(equivalent_snr_db(delivered_bytes, elapsed_s, self._link)))

    def observe_loss(self, offered_bytes: float, waited_s: float) -> None:
        """Takes in bytes that did not arrive in time.

        Raises:
            LinkError: no bytes, or no time.
        """
        self._take(Evidence(equivalent_snr_db(offered_bytes, waited_s, self._link), bound=True))

    def _take(self, evidence: Evidence) -> None:
        snr_db = clipped(evidence.snr_db)
        with self._lock:
            now_s = self._clock()
            if not evidence.bound:
                self._filter.measure(Gaussian(snr_db, self._goodput_variance), now_s)
            else:
                # Cut the estimate off above the bound, by the measurement that has this effect
                # (assumed density filtering).
                known = self._filter.at(now_s)
                measured = known.below(snr_db).over(known)
                if measured is None:
                    return
                self._filter.measure(Gaussian(clipped(measured.mean), measured.variance), now_s)
            self._news_s = now_s

    def _estimate(self, now_s: float) -> SnrReading:
        known = self._filter.at(now_s)
        return SnrReading(known.mean, max(0.0, now_s - self._news_s), math.sqrt(known.variance))

    def _new_filter(self, level_db: float, bias: Process) -> LinkFilter:
        return LinkFilter(clipped(level_db), self._level, self._fading, bias, self._clock())


def clipped(snr_db: float) -> float:
    """The SNR, within what radios have."""
    return min(max(snr_db, LOWEST_DB), HIGHEST_DB)


def checked(name: str, value: float) -> float:
    """A parameter that must be finite and positive.

    Raises:
        LinkError: it is not.
    """
    if not (math.isfinite(value) and value > 0.0):
        raise LinkError(f"expected a finite {name} > 0, got {value!r}")
    return value


def checked_process(name: str, std_db: float, memory_s: float) -> Process:
    """Deviation and memory of an unknown.

    Raises:
        LinkError: one is not finite and positive.
    """
    return Process(
        checked(f"deviation of the {name} in dB", std_db),
        checked(f"memory of the {name} in seconds", memory_s),
    )
