"""A reported SNR and measured goodput, each weighed by what it can know."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable

from comvla.errors import LinkError
from comvla_client.budget import PAPER_LINK, LinkProfile
from comvla_client.report import StepReport
from comvla_client.snr.evidence import Evidence, equivalent_snr_db, evidence_of
from comvla_client.snr.filter import RAYLEIGH_STD_DB, FadingFilter, Gaussian
from comvla_client.snr.source import SnrInput, SnrReading, as_source

LOWEST_DB, HIGHEST_DB = -40.0, 80.0
"""Beyond these no radio works, or none needs better; evidence is clipped to them."""


class FusedSnr:
    """The SNR by Bayes' rule from what a modem reports and from what the link was seen to carry.

    A modem reports the downlink, late; goodput is the uplink itself, but only when something was
    sent. The report counts as N(z, s² + σ²(1 − exp(−2a/τ))) at age a: its own error s, and the
    fading that has passed since. Goodput runs through :class:`~comvla_client.snr.filter.FadingFilter`.
    A step without an answer is evidence too: the link was slower than what was sent
    (:func:`~comvla_client.snr.evidence.evidence_of`).

    The value lies between the report and the measurements, a failure never raises it, ``age_s`` is
    that of the newest evidence, ``std_db`` what remains unknown. A report of −inf (no link) stands
    as it is. Safe to use from several threads.

    Args:
        reported: where the reported SNR comes from: a source, a function or a number in dB.
        link: the profile whose Eq. (1) turns rates into SNR; use the client's own.
        coherence_s: τ, seconds after which fading has changed; about 0.2 / Doppler spread.
        fading_std_db: σ, how deep it fades, in dB.
        reported_std_db: s, how far the uplink may be from the report, in dB.
        goodput_std_db: error of one measurement of goodput, in dB.
        drift_db: how much the mean SNR wanders in a second, in dB.
        round_trip_s: what a call without payload takes (``comvla doctor`` measures it). Left at 0,
            goodput errs on the low side.
        clock: monotonic seconds.

    Raises:
        LinkError: a parameter that is not finite and positive.
    """

    def __init__(
        self,
        reported: SnrInput,
        link: LinkProfile = PAPER_LINK,
        *,
        coherence_s: float = 0.02,
        fading_std_db: float = RAYLEIGH_STD_DB,
        reported_std_db: float = 6.0,
        goodput_std_db: float = 2.0,
        drift_db: float = 2.0,
        round_trip_s: float = 0.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        for name, value in (
            ("coherence_s", coherence_s),
            ("fading_std_db", fading_std_db),
            ("reported_std_db", reported_std_db),
            ("goodput_std_db", goodput_std_db),
            ("drift_db", drift_db),
        ):
            if not (math.isfinite(value) and value > 0.0):
                raise LinkError(f"expected a finite {name} > 0, got {value!r}")
        if not (math.isfinite(round_trip_s) and round_trip_s >= 0.0):
            raise LinkError(f"expected a round_trip_s >= 0 in seconds, got {round_trip_s!r}")
        self._reported = as_source(reported)
        self._link = link
        self._coherence_s = coherence_s
        self._fading_variance = fading_std_db**2
        self._reported_variance = reported_std_db**2
        self._goodput_variance = goodput_std_db**2
        self._round_trip_s = round_trip_s
        self._clock = clock
        self._lock = threading.Lock()
        self._filter = FadingFilter(coherence_s, fading_std_db, drift_db)
        self._evidence_s: float | None = None

    def read(self) -> SnrReading:
        """The estimate now."""
        reported = self._reported.read()
        if reported.snr_db == -math.inf:
            return reported
        with self._lock:
            now_s = self._clock()
            known = self._posterior(reported, now_s)
            return SnrReading(known.mean, self._age_s(reported, now_s), math.sqrt(known.variance))

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
        snr_db = min(max(evidence.snr_db, LOWEST_DB), HIGHEST_DB)
        # Before the lock: a source may be slow, or may itself be asked from elsewhere.
        reported = self._reported.read() if evidence.bound else None
        with self._lock:
            now_s = self._clock()
            if reported is None:
                self._filter.measure(Gaussian(snr_db, self._goodput_variance), now_s)
            elif not self._take_bound(snr_db, reported, now_s):
                return
            self._evidence_s = now_s

    def _take_bound(self, bound_db: float, reported: SnrReading, now_s: float) -> bool:
        # Cut the estimate off above the bound, and give the filter the measurement that would have
        # had the same effect (expectation propagation): so the report's share is not counted twice.
        if reported.snr_db == -math.inf:
            return False
        before = self._posterior(reported, now_s)
        measured = before.below(bound_db).over(before)
        if measured is None:
            return False
        mean = min(max(measured.mean, LOWEST_DB), HIGHEST_DB)
        self._filter.measure(Gaussian(mean, measured.variance), now_s)
        return True

    def _posterior(self, reported: SnrReading, now_s: float) -> Gaussian:
        changed = -math.expm1(-2.0 * reported.age_s / self._coherence_s)
        snr_db = min(max(reported.snr_db, LOWEST_DB), HIGHEST_DB)
        prior = Gaussian(snr_db, self._reported_variance + changed * self._fading_variance)
        measured = self._filter.at(now_s)
        return prior if measured is None else prior.times(measured)

    def _age_s(self, reported: SnrReading, now_s: float) -> float:
        if self._evidence_s is None:
            return reported.age_s
        return min(reported.age_s, max(0.0, now_s - self._evidence_s))
