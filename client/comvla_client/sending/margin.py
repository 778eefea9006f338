"""Sends what the link will very likely carry, given how old the report of its SNR is."""

from __future__ import annotations

import time
from collections.abc import Callable

from comvla.errors import LinkError
from comvla_client.fading import Fading, FadingEstimator, snr_quantiles_db
from comvla_client.sending.plan import BasePolicy, Plan, Situation
from comvla_client.snr import SnrReading


class Margin(BasePolicy):
    """Sizes the payload by a low quantile of the capacity now, given the report and its age.

    A report of age 0 is taken at its word. An older one says less, until the quantile is that of
    the link's long-term distribution: a fixed margin, 5.8 dB below the mean for 10 % outage on a
    Rician link with κ = 3, and 9.8 dB on a Rayleigh link.

    Args:
        outage: probability that the payload is too large for the link, in (0, 0.5].
        fading: mean SNR, κ and Doppler spread; what is not given is estimated from the readings.
        clock: seconds, for the times between readings. In simulated time pass the simulation's.

    Raises:
        LinkError: an outage out of range.
    """

    name = "margin"

    def __init__(
        self,
        outage: float = 0.05,
        fading: Fading | None = None,
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        if not 0.0 < outage <= 0.5:
            raise LinkError(f"expected an outage probability in (0, 0.5], got {outage!r}")
        self.outage = outage
        self.estimator = FadingEstimator(fading)
        self._clock = clock

    def hear(self, reading: SnrReading) -> None:
        """Learns the link's statistics."""
        self.estimator.add(reading, self._clock())

    def plan(self, now: Situation) -> Plan:
        """Tokens for a capacity that the link undercuts with the probability of an outage."""
        if now.reading is None and not now.needs_snr:
            return now.unsized()
        reading = now.known(self.name)
        [snr_db] = snr_quantiles_db(reading, self.estimator.estimate(), self.outage)
        return now.sized(now.capacity_bits(snr_db))
