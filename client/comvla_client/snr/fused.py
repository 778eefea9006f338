"""A reported SNR and measured goodput, each weighed by what it can know."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from comvla_client.budget import PAPER_LINK, LinkProfile
from comvla_client.snr.evidence import Evidence
from comvla_client.snr.filter import RAYLEIGH_STD_DB, Gaussian
from comvla_client.snr.goodput import GoodputSnr, checked, checked_process, clipped
from comvla_client.snr.source import SnrInput, SnrReading, as_source

SAME_REPORT_S = 1e-3
"""Readings whose time of measurement differs by less are one report, and count once."""


class FusedSnr(GoodputSnr):
    """The SNR by Bayes' rule from what a modem reports and from what the link was seen to carry.

    A modem reports the downlink, late, and with a bias; goodput is the uplink itself, but only when
    something was sent. :mod:`comvla_client.snr.filter` has the model. A report counts when it is new,
    once, and the more of the fading the younger it is; its bias is learned from what arrives and
    what is lost.

    The value never leaves the range of all that was reported and measured, and a failure never
    raises it; ``age_s`` is that of the newest evidence of either kind, ``std_db`` what remains
    unknown. A report of −inf (no link) stands as it is.

    Args:
        reported: where the reported SNR comes from: a source, a function or a number in dB.
        reported_std_db: how far the uplink may be from what is reported for long, in dB.
        reported_memory_s: seconds in which that becomes another error.
        noise_std_db: how much reports scatter besides, in dB.
        link, level_std_db, level_memory_s, coherence_s, fading_std_db, goodput_std_db, round_trip_s,
            clock: as for :class:`~comvla_client.snr.goodput.GoodputSnr`.

    Raises:
        LinkError: a parameter that is not finite and positive.
    """

    def __init__(
        self,
        reported: SnrInput,
        link: LinkProfile = PAPER_LINK,
        *,
        reported_std_db: float = 6.0,
        reported_memory_s: float = 60.0,
        noise_std_db: float = 1.0,
        level_std_db: float = 10.0,
        level_memory_s: float = 60.0,
        coherence_s: float = 0.02,
        fading_std_db: float = RAYLEIGH_STD_DB,
        goodput_std_db: float = 2.0,
        round_trip_s: float = 0.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__(
            link,
            level_std_db=level_std_db,
            level_memory_s=level_memory_s,
            coherence_s=coherence_s,
            fading_std_db=fading_std_db,
            goodput_std_db=goodput_std_db,
            round_trip_s=round_trip_s,
            clock=clock,
        )
        self._bias = checked_process("report's bias", reported_std_db, reported_memory_s)
        self._noise_variance = checked("noise_std_db", noise_std_db) ** 2
        self._reported = as_source(reported)
        self._reported_s: float | None = None

    def read(self) -> SnrReading:
        """The estimate now."""
        reported = self._reported.read()  # outside the lock: it is somebody else's code
        if reported.snr_db == -math.inf:
            return reported
        with self._lock:
            now_s = self._clock()
            self._take_report(reported, now_s)
            return self._estimate(now_s)

    def _take(self, evidence: Evidence) -> None:
        reported = self._reported.read()
        if reported.snr_db > -math.inf:  # what arrives is compared with the latest report
            with self._lock:
                self._take_report(reported, self._clock())
        super()._take(evidence)

    def _take_report(self, reported: SnrReading, now_s: float) -> None:
        snr_db, measured_s = clipped(reported.snr_db), now_s - reported.age_s
        if self._reported_s is None:
            self._filter = self._new_filter(snr_db, self._bias)
            self._news_s = measured_s
        elif measured_s <= self._reported_s + SAME_REPORT_S:
            return
        self._reported_s = measured_s
        self._news_s = max(self._news_s, measured_s)
        self._filter.report(Gaussian(snr_db, self._noise_variance), reported.age_s, now_s)
