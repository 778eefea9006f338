"""Links that come and go: two states with dwell times, and a link that behaves like Wi-Fi."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from comvla.errors import LinkError
from comvla_sim.channel.base import (
    Channel,
    checked,
    checked_period_s,
    checked_seed,
    checked_snr_db,
)
from comvla_sim.channel.fading import RicianChannel

_VISITS = 64
"""Dwell times are drawn in batches of so many visits to each state."""


class GilbertElliottChannel(Channel):
    """Two states, good and bad, each left with a constant probability in every control period.

    So dwell times are geometric with the means given here, at least one period long, and the link
    is bad for ``bad_s / (good_s + bad_s)`` of the time. The first state is drawn from those shares.
    (E. N. Gilbert, Capacity of a burst-noise channel, Bell System Technical Journal 39, 1960;
    E. O. Elliott, Estimates of error rates for codes on burst-noise channels, ibid. 42, 1963.)

    Args:
        good_snr_db: in the good state, dB.
        bad_snr_db: in the bad state, dB; ``-inf`` is an outage.
        good_s: mean dwell time in the good state in seconds, at least one period.
        bad_s: mean dwell time in the bad state in seconds, at least one period.
        period_s: T, control period in seconds.
        seed: an integer in [0, 2**32).

    Raises:
        LinkError: for a value that makes no sense.
    """

    def __init__(
        self,
        good_snr_db: float,
        bad_snr_db: float,
        good_s: float,
        bad_s: float,
        period_s: float,
        seed: int,
    ) -> None:
        self.period_s = checked_period_s(period_s)
        self.good_snr_db = checked_snr_db("good_snr_db", good_snr_db)
        self.bad_snr_db = checked_snr_db("bad_snr_db", bad_snr_db)
        self.good_s = checked("good_s", good_s, unit=" (seconds)", minimum=self.period_s)
        self.bad_s = checked("bad_s", bad_s, unit=" (seconds)", minimum=self.period_s)
        self.seed = checked_seed(seed)

    def _batches(self) -> Iterator[npt.NDArray[np.bool_]]:
        random = np.random.RandomState(self.seed)
        first_good = random.uniform() * (self.good_s + self.bad_s) < self.good_s
        leaving = [self.period_s / self.good_s, self.period_s / self.bad_s]
        if not first_good:
            leaving.reverse()
        states = np.tile([first_good, not first_good], _VISITS)
        while True:
            # The past does not matter to a geometric law, so the first visit is like all others.
            yield np.repeat(states, random.geometric(np.tile(leaving, _VISITS)))

    def good(self, periods: int) -> npt.NDArray[np.bool_]:
        """Whether each of the first periods is good, shape (periods,)."""
        batches, length = [np.empty(0, np.bool_)], 0
        for batch in self._batches():
            if length >= periods:
                break
            batches.append(batch)
            length += len(batch)
        return np.concatenate(batches)[:periods]

    def snr_db(self, periods: int) -> npt.NDArray[np.float64]:
        """The first values, shape (periods,), in dB."""
        return np.where(self.good(periods), self.good_snr_db, self.bad_snr_db)

    def __iter__(self) -> Iterator[float]:
        for batch in self._batches():
            yield from np.where(batch, self.good_snr_db, self.bad_snr_db).tolist()


WIFI_BITS_PER_S_PER_HZ = (0.325, 0.65, 0.975, 1.3, 1.95, 2.6, 2.925, 3.25, 3.9)
"""MCS 0 to 8 of IEEE 802.11ac, one stream, guard interval of 800 ns: 6.5 to 78 Mbit/s in 20 MHz."""

WIFI_LEAST_SNR_DB = (4.0, 7.0, 9.0, 12.0, 16.0, 20.0, 21.0, 22.0, 27.0)
"""SNR that each of them needs: the standard's minimum sensitivity in 20 MHz (-82, -79, -77, -74,
-70, -66, -65, -64, -59 dBm) over thermal noise of -101 dBm, less the 10 dB noise figure and the
5 dB implementation margin that the standard assumes in it."""


class WifiChannel(Channel):
    """A link like Wi-Fi: steps of rate instead of Shannon's curve, and bursts without any link.

    A model, not a measurement. Rician fading at a walking person's Doppler; the sender chooses the
    highest MCS that the SNR allows once in ``update_s`` and steps down at once when the SNR falls
    below it, as rate control in Linux does with its interval and its retry chain. The value of a
    period is the SNR at which Shannon's formula gives the MCS's bit/s/Hz, so that ``LinkProfile``
    turns it into that rate times efficiency; below MCS 0 it is −inf. Outages come at random, on
    average ``up_s`` apart, and last between the two ``outage_s``, short ones more often than long
    ones (log-uniform): a change of access point takes some hundred milliseconds, one with a new
    authentication seconds.

    Args:
        mean_snr_db: in dB, the mean of the linear SNR of the fading underneath.
        period_s: T, control period in seconds.
        seed: an integer in [0, 2**32).
        doppler_hz: of the fading, Hz; 6 Hz is 1.2 km/h at 5 GHz, the speed in the task group n's
            indoor channel models (Erceg et al., IEEE 802.11-03/940).
        rician_k: κ of the fading, linear.
        up_s: mean time between outages in seconds.
        outage_s: shortest and longest outage in seconds.
        update_s: interval of rate control in seconds.

    Raises:
        LinkError: for a value that makes no sense.
    """

    def __init__(
        self,
        mean_snr_db: float,
        period_s: float,
        seed: int,
        *,
        doppler_hz: float = 6.0,
        rician_k: float = 3.0,
        up_s: float = 5.0,
        outage_s: tuple[float, float] = (0.1, 3.0),
        update_s: float = 0.1,
    ) -> None:
        self.fading = RicianChannel(mean_snr_db, doppler_hz, period_s, seed, rician_k)
        self.period_s = self.fading.period_s
        self.seed = self.fading.seed
        self.up_s = checked("up_s", up_s, unit=" (seconds)", minimum=self.period_s)
        shortest, longest = outage_s
        shortest = checked("outage_s", shortest, unit=" (seconds)", minimum=self.period_s)
        self.outage_s = (shortest, checked("outage_s", longest, unit=" (seconds)", minimum=0.0))
        if longest < shortest:
            raise LinkError(f"outage_s is (shortest, longest), got {outage_s!r}")
        update_s = checked("update_s", update_s, unit=" (seconds)", minimum=self.period_s)
        self._update_periods = max(1, round(update_s / self.period_s))
        self._steps_db = [10 * math.log10(2**rate - 1) for rate in WIFI_BITS_PER_S_PER_HZ]

    def _outages(self) -> Iterator[bool]:
        # Another stream than the fading's, which is seeded by the number alone.
        random = np.random.RandomState([self.seed, 1])
        low, high = (math.log(limit / self.period_s) for limit in self.outage_s)
        while True:
            yield from itertools.repeat(False, random.geometric(self.period_s / self.up_s))
            yield from itertools.repeat(True, max(1, round(math.exp(random.uniform(low, high)))))

    def __iter__(self) -> Iterator[float]:
        chosen = -1
        for period, (snr_db, out) in enumerate(zip(self.fading, self._outages(), strict=False)):
            allowed = sum(snr_db >= least for least in WIFI_LEAST_SNR_DB) - 1
            chosen = allowed if period % self._update_periods == 0 else min(chosen, allowed)
            yield -math.inf if out or chosen < 0 else self._steps_db[chosen]
