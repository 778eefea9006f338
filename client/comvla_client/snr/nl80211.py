"""What Linux tells of a Wi-Fi link over nl80211: signal, noise, bit rates, power saving.

Messages are made and decoded by pyroute2. Numbers are those of the kernel's ``nl80211.h``.
"""

from __future__ import annotations

import errno
import math
import struct
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

from comvla.errors import DependencyError
from comvla_client.errors import SnrSourceError

NET_FOLDER = Path("/sys/class/net")
"""Where Linux lists its network interfaces, in this network namespace."""

STATION = 2
"""``NL80211_IFTYPE_STATION``: an interface that is a client of an access point."""

# NL80211_CHAN_WIDTH_*: 20 without HT, 20, 40, 80, 80+80, 160, 5, 10, 1, 2, 4, 8, 16, 320 MHz
_WIDTHS_MHZ = (20, 20, 40, 80, 160, 160, 5, 10, 1, 2, 4, 8, 16, 320)

Message: TypeAlias = Any
"""A decoded ``nl80211cmd``; pyroute2 has no types."""


@dataclass(frozen=True)
class Interface:
    """A wireless interface.

    Attributes:
        name: e.g. ``wlan0``.
        index: its number in the kernel.
        kind: ``NL80211_IFTYPE_*``; 2 is a client of an access point.
        width_hz: of the channel; None while there is none.
        frequency_mhz: of the channel's centre; None while there is none.
    """

    name: str
    index: int
    kind: int
    width_hz: float | None = None
    frequency_mhz: int | None = None


@dataclass(frozen=True)
class Station:
    """The other end of a Wi-Fi link, as the driver sees it.

    Attributes:
        address: its MAC address.
        signal_dbm: strength of its last frame; None where the driver does not say.
        inactive_s: seconds since that frame.
        tx_bitrate_bps: PHY rate of what is sent to it; None where the driver does not say.
    """

    address: str
    signal_dbm: float | None
    inactive_s: float
    tx_bitrate_bps: float | None


def interfaces_in(messages: Iterable[Message]) -> list[Interface]:
    """The interfaces of a dump of ``NL80211_CMD_GET_INTERFACE``."""
    found = []
    for message in messages:
        name, index = (
            message.get_attr("NL80211_ATTR_IFNAME"),
            message.get_attr("NL80211_ATTR_IFINDEX"),
        )
        if name is None or index is None:  # a P2P device has no network interface
            continue
        width = message.get_attr("NL80211_ATTR_CHANNEL_WIDTH")
        has_width = width is not None and width < len(_WIDTHS_MHZ)
        found.append(
            Interface(
                name,
                index,
                message.get_attr("NL80211_ATTR_IFTYPE") or 0,
                1e6 * _WIDTHS_MHZ[width] if has_width else None,
                message.get_attr("NL80211_ATTR_WIPHY_FREQ"),
            )
        )
    return found


def station_in(messages: Iterable[Message]) -> Station | None:
    """The station heard most recently in a dump of ``NL80211_CMD_GET_STATION``; None without any.

    A client has one, its access point. An access point or mesh node has many, and the one that just
    spoke is the one that traffic goes to.
    """
    stations = [_station(message) for message in messages]
    return min(stations, key=lambda station: station.inactive_s, default=None)


def noise_in(messages: Iterable[Message], frequency_mhz: int | None = None) -> float | None:
    """Noise in dBm of the channel in use, from a dump of ``NL80211_CMD_GET_SURVEY``.

    Args:
        messages: one for each channel that was surveyed.
        frequency_mhz: of the interface's channel, for drivers that mark none as in use.

    Returns:
        None where the driver does not survey that channel, or not its noise.
    """
    mine = None
    for message in messages:
        survey = message.get_attr("NL80211_ATTR_SURVEY_INFO")
        if survey is None:
            continue
        if survey.get_attr("NL80211_SURVEY_INFO_IN_USE") is not None:
            mine = survey
            break
        if frequency_mhz == survey.get_attr("NL80211_SURVEY_INFO_FREQUENCY"):
            mine = survey
    noise = None if mine is None else mine.get_attr("NL80211_SURVEY_INFO_NOISE")
    # The kernel's u8 holds a negative number, in two's complement.
    return None if noise is None else float(noise - 256 if noise > 127 else noise)


def thermal_noise_dbm(width_hz: float, noise_figure_db: float = 7.0) -> float:
    """Noise of a receiver at room temperature: −174 dBm/Hz, its bandwidth, and what it adds."""
    return -174.0 + 10.0 * math.log10(width_hz) + noise_figure_db


def network_interfaces() -> list[str]:
    """Names of all network interfaces but loopback."""
    try:
        return sorted(entry.name for entry in NET_FOLDER.iterdir() if entry.name != "lo")
    except OSError:
        return []


def is_gone(error: Exception) -> bool:
    """Whether a netlink error says that there is no such interface."""
    return getattr(error, "code", None) in (errno.ENODEV, errno.ENXIO)


class Nl80211:
    """A socket to the kernel's wireless subsystem.

    Raises:
        DependencyError: pyroute2 is not installed.
        SnrSourceError: the kernel has no wireless subsystem, or this is not Linux.
    """

    def __init__(self) -> None:
        try:
            from pyroute2.iwutil import IW
        except ImportError as error:
            raise DependencyError(
                "reading Wi-Fi needs pyroute2: pip install 'comvla[wifi]', or use GoodputSnr or "
                "ConstantSnr"
            ) from error
        with _no_wireless():
            self._socket = IW()

    def interfaces(self) -> list[Interface]:
        """All wireless interfaces of this network namespace."""
        return interfaces_in(list(self._socket.get_interfaces_dump()))

    def station(self, interface: Interface) -> Station | None:
        """Who is at the other end; None while the interface is not associated, or gone."""
        return station_in(list(self._socket.get_stations(interface.index)))

    def noise_dbm(self, interface: Interface) -> float | None:
        """Noise in the channel in use; None where the driver does not measure it."""
        return noise_in(list(self._socket.survey(interface.index)), interface.frequency_mhz)

    def power_save(self, interface: Interface) -> bool | None:
        """Whether the card sleeps between beacons; None where the driver does not say."""
        from pyroute2.netlink import NLM_F_ACK, NLM_F_REQUEST
        from pyroute2.netlink.nl80211 import NL80211_NAMES, nl80211cmd

        message = nl80211cmd()
        message["cmd"] = NL80211_NAMES["NL80211_CMD_GET_POWER_SAVE"]
        message["attrs"] = [["NL80211_ATTR_IFINDEX", interface.index]]
        flags = NLM_F_REQUEST | NLM_F_ACK
        answers = self._socket.nlm_request(message, msg_type=self._socket.prid, msg_flags=flags)
        return power_save_in(list(answers))

    def close(self) -> None:
        """Closes the socket."""
        self._socket.close()


def power_save_in(messages: Iterable[Message]) -> bool | None:
    """Whether power saving is on, from an answer to ``NL80211_CMD_GET_POWER_SAVE``."""
    for message in messages:
        state = message.get_attr("NL80211_ATTR_PS_STATE")
        if state is not None:  # pyroute2 leaves it as hexadecimal bytes, "01:00:00:00"
            return bool(struct.unpack("=I", bytes.fromhex(state.replace(":", "")))[0])
    return None


def no_interface(wanted: str | None = None) -> SnrSourceError:
    """The error of a machine without (that) Wi-Fi: what there is, and what to use instead."""
    found = network_interfaces()
    expected = "a wireless interface" if wanted is None else f"a wireless interface {wanted}"
    return SnrSourceError(
        f"expected {expected}, found {', '.join(found) if found else 'no network interface'}: use "
        "GoodputSnr (measures what arrives, over any interface) or ConstantSnr"
    )


@contextmanager
def _no_wireless() -> Iterator[None]:
    try:
        yield
    except Exception as error:
        # ENOENT: no generic netlink family of this name, so the kernel has no wireless at all.
        if getattr(error, "code", None) == errno.ENOENT or isinstance(error, OSError):
            raise no_interface() from error
        raise


def _station(message: Message) -> Station:
    info = message.get_attr("NL80211_ATTR_STA_INFO")
    address = message.get_attr("NL80211_ATTR_MAC") or ""
    if info is None:
        return Station(address, None, math.inf, None)
    signal = info.get_attr("NL80211_STA_INFO_SIGNAL")
    if signal is None:
        signal = info.get_attr("NL80211_STA_INFO_SIGNAL_AVG")
    inactive_ms = info.get_attr("NL80211_STA_INFO_INACTIVE_TIME")
    return Station(
        address,
        None if signal is None else float(signal),
        0.0 if inactive_ms is None else inactive_ms / 1e3,
        _bitrate_bps(info.get_attr("NL80211_STA_INFO_TX_BITRATE")),
    )


def _bitrate_bps(rate: Message | None) -> float | None:
    if rate is None:
        return None
    # In units of 100 kbit/s; the 16 bit field came first and is too short for modern rates.
    units = rate.get_attr("NL80211_RATE_INFO_BITRATE32") or rate.get_attr(
        "NL80211_RATE_INFO_BITRATE"
    )
    return None if units is None else 1e5 * units
