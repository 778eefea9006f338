"""The SNR of a mobile network, as ModemManager reports it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping

from comvla_client.errors import SnrSourceError
from comvla_client.snr.modem_manager import REGISTERED, ModemGoneError, ModemManager, ModemState
from comvla_client.snr.polled import Measurement, NoReadingYetError, PolledSource

RESOURCE_ELEMENT_NOISE_DBM = -125.2
"""Thermal noise in one 15 kHz resource element with a noise figure of 7 dB: what RSRP is above."""

# Where several technologies report, the newest carries the data.
_TECHNOLOGIES = ("Nr5g", "Lte", "Umts", "Evdo", "Cdma", "Gsm")


def snr_of(signals: Mapping[str, Mapping[str, float]]) -> tuple[float, str, str] | None:
    """SNR in dB, its technology and the value it comes from; None where no value tells it.

    ``snr`` (LTE, 5G) and ``sinr`` (EV-DO) are taken as they are. Without them LTE's and 5G's RSRP
    over thermal noise is an upper bound: it knows nothing of interference.
    """
    for technology in _TECHNOLOGIES:
        values = signals.get(technology, {})
        for name in ("snr", "sinr"):
            if name in values:
                return values[name], technology, name
    for technology in ("Nr5g", "Lte"):
        if "rsrp" in signals.get(technology, {}):
            snr_db = signals[technology]["rsrp"] - RESOURCE_ELEMENT_NOISE_DBM
            return snr_db, technology, "rsrp"
    return None


class ModemManagerSnr(PolledSource):
    """The SNR that a modem reports for LTE or 5G, through ModemManager's Signal interface.

    It is the downlink's, and one to several seconds old when it comes: use it as the ``reported``
    of :class:`~comvla_client.snr.fused.FusedSnr`. ``details`` holds RSRP, RSRQ and the rest.

    ModemManager measures every ``rate_s`` seconds and does not say when. A value that just changed
    is as old as one poll; one that did not is at most as old as the time since it did, or as
    ``rate_s`` and one poll.

    A modem that is gone or without a network is a link that is down: −inf. When ModemManager itself
    stops, nothing is known of the link, and the last reading grows old.

    Args:
        modem: object path, or its end (``"0"``); None takes the first that reports.
        rate_s: seconds between measurements of the modem, at least 1. Set for all users of the modem.
        poll_s: seconds between questions to ModemManager.
        bus: ``"SYSTEM"``, ``"SESSION"``, or the address of a bus.
        start_timeout_s: longest that the constructor waits for the first reading; default two
            rates and 3 s.
        clock: monotonic seconds.

    Raises:
        DependencyError: jeepney is missing.
        SnrSourceError: no bus, no ModemManager, no (such) modem, or none that reports; the message
            says what to use instead.
    """

    def __init__(
        self,
        modem: str | None = None,
        *,
        rate_s: int = 1,
        poll_s: float = 0.2,
        bus: str = "SYSTEM",
        start_timeout_s: float | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        if not (isinstance(rate_s, int) and rate_s >= 1):
            raise SnrSourceError(f"expected a rate_s of whole seconds >= 1, got {rate_s!r}")
        super().__init__(
            poll_s, 2.0 * rate_s + 3.0 if start_timeout_s is None else start_timeout_s, clock
        )
        self._wanted = modem
        self._rate_s = rate_s
        self._bus = bus
        self._manager: ModemManager | None = None
        self._modem: str | None = None
        self._changed_s = -math.inf
        self._signals: Mapping[str, Mapping[str, float]] = {}
        self._start()

    def _measure(self) -> Measurement:
        try:
            if self._manager is None:
                self._manager = ModemManager(self._bus)
            if self._modem is None:
                self._modem = self._find(self._manager)
                if self._modem is None:
                    return Measurement(-math.inf, details={"state": "gone"})
                self._manager.set_up(self._modem, self._rate_s)
            state = self._manager.state(self._modem)
            if state.rate_s == 0:  # ModemManager was restarted, or another program stopped it
                self._manager.set_up(self._modem, self._rate_s)
        except ModemGoneError:
            self._modem = None
            if self._latest is None:
                raise
            return Measurement(-math.inf, details={"state": "gone"})
        except (OSError, SnrSourceError):
            self._release()  # connect anew next time
            raise
        return self._reading(state)

    def _release(self) -> None:
        manager, self._manager, self._modem = self._manager, None, None
        if manager is not None:
            manager.close()

    def _find(self, manager: ModemManager) -> str | None:
        """The modem to watch; None where the one that was watched is gone."""
        found = manager.modems()
        wanted = self._wanted
        for path in found:
            if wanted is None or path == wanted or path.rpartition("/")[2] == wanted:
                return path
        if self._latest is not None:
            return None
        raise SnrSourceError(
            f"expected {'a modem' if wanted is None else f'modem {wanted}'} that reports its signal, "
            f"ModemManager has {', '.join(found) or 'none'}: use GoodputSnr (measures what arrives, "
            "over any interface) or ConstantSnr"
        )

    def _reading(self, state: ModemState) -> Measurement:
        details: dict[str, object] = {
            "modem": self._modem,
            "signals": {name: dict(values) for name, values in state.signals.items()},
        }
        now_s = self._clock()
        if state.state < REGISTERED:
            return Measurement(-math.inf, details=details | {"state": "no network"})
        told = snr_of(state.signals)
        if told is None:
            # The first measurement comes up to rate_s after it was asked for.
            raise NoReadingYetError(
                f"expected an SNR from {self._modem}, it reports {sorted(state.signals) or 'nothing'} "
                "without one: use GoodputSnr (measures what arrives, over any interface) or "
                "ConstantSnr"
            )
        if state.signals != self._signals:
            self._signals, self._changed_s = state.signals, now_s - self._period_s
        measured_s = max(self._changed_s, now_s - self._rate_s - self._period_s)
        snr_db, technology, value = told
        details |= {"state": "registered", "technology": technology, "from": value}
        return Measurement(snr_db, now_s - measured_s, details)
