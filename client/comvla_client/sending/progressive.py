"""Sends the most important tokens first, piece by piece, until the window ends."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable

from comvla.errors import LinkError
from comvla_client.fading import Fading, FadingEstimator, snr_quantiles_db
from comvla_client.sending.plan import BasePolicy, Outcome, Plan, Situation
from comvla_client.snr import SnrReading


class Progressive(BasePolicy):
    """Lets the link decide: the server computes on the tokens that arrived in time.

    It needs no SNR to be right. A cap keeps what is handed to the network near what it can carry,
    because bytes that were written and not yet delivered when the window ends still stand before
    the next payload: a high quantile of the capacity where an SNR is reported, the goodput of the
    last payloads where none is.

    Args:
        cap: probability that the link carries no more than the cap, in [0.5, 1).
        headroom: factor on the cap, at least 1, for links that carry more than the profile says.
        fading: mean SNR, κ and Doppler spread; what is not given is estimated from the readings.
        clock: seconds, for the times between readings. In simulated time pass the simulation's.

    Raises:
        LinkError: a number out of range.
    """

    name = "progressive"
    progressive = True

    def __init__(
        self,
        cap: float = 0.95,
        headroom: float = 1.1,
        fading: Fading | None = None,
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        if not 0.5 <= cap < 1.0:
            raise LinkError(f"expected a cap in [0.5, 1), got {cap!r}: a probability")
        if not headroom >= 1.0:
            raise LinkError(f"expected a headroom of at least 1, got {headroom!r}")
        self.cap = cap
        self.headroom = headroom
        self.estimator = FadingEstimator(fading)
        self._clock = clock
        self._goodput_bits: deque[float] = deque(maxlen=8)  # per period

    def hear(self, reading: SnrReading) -> None:
        """Learns the link's statistics."""
        self.estimator.add(reading, self._clock())

    def plan(self, now: Situation) -> Plan:
        """All tokens up to the cap."""
        if now.reading is None:
            if not self._goodput_bits:
                return now.unsized(progressive=True)
            expected = now.periods * sum(self._goodput_bits) / len(self._goodput_bits)
            most = now.periods * max(self._goodput_bits)
            return now.sized(self.headroom * most, expected_bits=expected)
        fading = self.estimator.estimate()
        high_db, middle_db = snr_quantiles_db(now.reading, fading, self.cap, 0.5)
        return now.sized(
            self.headroom * now.capacity_bits(high_db),
            expected_bits=now.capacity_bits(middle_db),
        )

    def learn(self, outcome: Outcome) -> None:
        """Learns the goodput, where it is not known from an SNR.

        A payload that arrived whole says only that more was possible, one without an answer only
        that it was too much. After a step that sent nothing the next dares twice as much, because
        nothing else could tell that the link is back.
        """
        measured = outcome.arrived_bits / outcome.periods
        if not outcome.answered:
            if not self._goodput_bits:
                return
            usual = sum(self._goodput_bits) / len(self._goodput_bits)
            measured = 0.5 * usual if outcome.offered_tokens else 2.0 * usual
        elif outcome.arrived_tokens >= outcome.offered_tokens:
            measured *= 2.0
        self._goodput_bits.append(measured)
