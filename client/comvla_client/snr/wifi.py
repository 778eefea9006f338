"""The SNR of a Wi-Fi link on Linux."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from comvla_client.errors import SnrSourceError
from comvla_client.snr.nl80211 import (
    STATION,
    Interface,
    Nl80211,
    Station,
    is_gone,
    no_interface,
    thermal_noise_dbm,
)
from comvla_client.snr.polled import Measurement, PolledSource

SURVEY_PERIOD_S = 1.0
"""Noise changes slowly, and some drivers list all their channels to tell that of one."""


class WifiSnr(PolledSource):
    """Signal less noise of a Wi-Fi interface, as its driver reports them over nl80211.

    The signal is that of the last frame received, and the reading as old as that frame. Noise comes
    from the channel survey where the driver has one, else from bandwidth and a noise figure of 7 dB.
    It is the downlink that is measured; for a first guess the uplink is alike.

    An interface that is not associated, or gone, is a link that is down: −inf, until it is back under
    the same name. See :class:`~comvla_client.snr.polled.PolledSource` for failed polls.

    Args:
        interface: its name, e.g. ``"wlan0"``; None takes the first that is associated.
        period_s: seconds between polls; one takes less than a millisecond.
        noise_dbm: noise to assume instead of what the driver or physics say.
        start_timeout_s: longest that the constructor waits for the first reading.
        clock: monotonic seconds.

    Raises:
        DependencyError: pyroute2 is missing.
        SnrSourceError: no (such) wireless interface, or a driver that reports no signal; the message
            says what to use instead.
    """

    def __init__(
        self,
        interface: str | None = None,
        *,
        period_s: float = 0.05,
        noise_dbm: float | None = None,
        start_timeout_s: float = 5.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__(period_s, start_timeout_s, clock)
        if noise_dbm is not None and not math.isfinite(noise_dbm):
            raise SnrSourceError(f"expected a finite noise_dbm, got {noise_dbm!r}")
        self._name = interface
        self._noise_dbm = noise_dbm
        self._socket: Nl80211 | None = None
        self._interface: Interface | None = None
        self._surveyed_s = -math.inf
        self._survey_dbm: float | None = None
        self._start()

    def _measure(self) -> Measurement:
        if self._socket is None:
            self._socket = Nl80211()
        station = None if self._interface is None else self._station(self._socket, self._interface)
        if station is None:
            # Nobody there, or no such interface: a dump tells the two apart in no kernel. After a
            # reset the name has another index.
            self._interface = self._find(self._socket)
            if self._interface is None:
                return Measurement(-math.inf, details={"interface": self._name, "state": "gone"})
            self._name = self._interface.name
            station = self._station(self._socket, self._interface)
        if station is None:
            return Measurement(-math.inf, details=self._details("not associated"))
        if station.signal_dbm is None:
            raise SnrSourceError(
                f"expected a signal strength from {self._name}, its driver reports none: use "
                "GoodputSnr or ConstantSnr"
            )
        noise_dbm, noise_from = self._noise(self._socket)
        return self._reading(station, station.signal_dbm, noise_dbm, noise_from)

    def _release(self) -> None:
        if self._socket is not None:
            self._socket.close()

    def _reading(
        self, station: Station, signal_dbm: float, noise_dbm: float, noise_from: str
    ) -> Measurement:
        details = self._details("associated") | {
            "peer": station.address,
            "signal_dbm": signal_dbm,
            "noise_dbm": round(noise_dbm, 1),
            "noise_from": noise_from,
            "tx_bitrate_bps": station.tx_bitrate_bps,
        }
        return Measurement(signal_dbm - noise_dbm, station.inactive_s, details)

    def _details(self, state: str) -> dict[str, object]:
        return {"interface": self._name, "state": state}

    def _find(self, socket: Nl80211) -> Interface | None:
        """The interface to watch; None where the one that was watched is gone."""
        first = self._name is None or self._latest is None
        found = socket.interfaces()
        if self._name is not None:
            named = next((each for each in found if each.name == self._name), None)
            if named is None and first:
                raise no_interface(self._name)
            return named
        # Associated ones first, then clients of an access point, which may yet be.
        ranked = sorted(
            found, key=lambda each: (socket.station(each) is None, each.kind != STATION, each.name)
        )
        if not ranked:
            raise no_interface()
        return ranked[0]

    def _station(self, socket: Nl80211, interface: Interface) -> Station | None:
        try:
            return socket.station(interface)
        except Exception as error:
            if is_gone(error):
                return None
            raise

    def _noise(self, socket: Nl80211) -> tuple[float, str]:
        if self._noise_dbm is not None:
            return self._noise_dbm, "given"
        now_s = self._clock()
        if now_s - self._surveyed_s >= SURVEY_PERIOD_S:
            self._surveyed_s = now_s
            # The channel may be another one since the last time.
            self._interface = self._find(socket) or self._interface
            self._survey_dbm = self._survey(socket)
        if self._survey_dbm is not None:
            return self._survey_dbm, "survey"
        width_hz = None if self._interface is None else self._interface.width_hz
        return thermal_noise_dbm(width_hz or 20e6), "bandwidth"

    def _survey(self, socket: Nl80211) -> float | None:
        assert self._interface is not None, "a station was heard through it"
        try:
            return socket.noise_dbm(self._interface)
        except Exception:  # EOPNOTSUPP: this driver has no survey
            return None
