"""A Wi-Fi link's SNR: decoding what the kernel says, and living with what it stops to say."""

from __future__ import annotations

import builtins
import math
import time
from pathlib import Path
from typing import Any

import nl80211_bytes as raw
import pytest
from waiting import until

from comvla.errors import DependencyError
from comvla_client.errors import SnrSourceError
from comvla_client.snr import WifiSnr, nl80211, wifi
from comvla_client.snr.nl80211 import (
    Interface,
    Station,
    interfaces_in,
    noise_in,
    power_save_in,
    station_in,
    thermal_noise_dbm,
)

pytest.importorskip("pyroute2", reason="needs pyroute2")


def decoded(*messages: bytes) -> list[Any]:
    return [raw.decoded(message) for message in messages]


def test_what_a_real_kernel_answered_is_understood() -> None:
    assert interfaces_in(decoded(*raw.recorded("interface"))) == [
        Interface("wlan1", 3, 1, 20e6, 2412),
        Interface("wlan0", 2, 1, 20e6, 2412),
    ]
    assert station_in(decoded(*raw.recorded("station"))) == Station(
        "02:00:00:00:01:00", signal_dbm=-30.0, inactive_s=0.088, tx_bitrate_bps=1e6
    )
    surveyed = decoded(*raw.recorded("survey"))
    assert noise_in(surveyed, 2412) == -92.0  # this driver marks no channel as in use
    assert noise_in(surveyed) is None
    assert power_save_in(decoded(*raw.recorded("power_save"))) is False


def test_interfaces_are_read_with_their_bandwidth() -> None:
    found = interfaces_in(
        decoded(raw.interface(7, "wlan0", width=3), raw.interface(8, "ap0", kind=3, width=None))
    )
    assert found == [Interface("wlan0", 7, 2, 80e6, 5180), Interface("ap0", 8, 3)]
    assert interfaces_in(decoded(raw.message(raw.GET_INTERFACE, raw.u32(5, 10)))) == []  # P2P


def test_the_station_that_spoke_last_is_the_link() -> None:
    assert station_in([]) is None
    rate = (
        raw.attribute(raw.RATE_BITRATE, b"\xff\xff"),
        raw.u32(raw.RATE_BITRATE32, 86_670),
    )
    found = station_in(
        decoded(raw.station(-70, inactive_ms=500), raw.station(-52, inactive_ms=12, rate=rate))
    )
    assert found is not None
    assert (found.address, found.signal_dbm) == ("02:aa:bb:cc:dd:ee", -52.0)
    assert (found.inactive_s, found.tx_bitrate_bps) == (0.012, 8.667e9)


def test_drivers_that_say_less_are_understood() -> None:
    average = station_in(decoded(raw.station(None, average_dbm=-61)))
    assert average is not None
    assert (average.signal_dbm, average.tx_bitrate_bps) == (-61.0, None)
    old = station_in(decoded(raw.station(rate=(raw.attribute(raw.RATE_BITRATE, b"\x1c\x02"),))))
    assert old is not None
    assert old.tx_bitrate_bps == 54e6
    silent = station_in(decoded(raw.message(raw.GET_STATION, raw.u32(3, 7))))
    assert silent is not None
    assert silent.signal_dbm is None


def test_noise_is_that_of_the_channel_in_use() -> None:
    other, mine = raw.survey(-80, in_use=False), raw.survey(-95, in_use=True)
    assert noise_in(decoded(other, mine)) == -95.0
    assert noise_in(decoded(raw.survey(None, in_use=True))) is None
    assert noise_in(decoded(other)) is None
    # Some drivers mark no channel as in use.
    unmarked = raw.survey(-91, in_use=False, frequency_mhz=2412)
    assert noise_in(decoded(other, unmarked), 2412) == -91.0
    assert noise_in(decoded(other, unmarked), 2417) is None
    assert thermal_noise_dbm(20e6) == pytest.approx(-94.0, abs=0.05)


def test_power_saving_is_read() -> None:
    assert power_save_in(decoded(raw.power_save(1))) is True
    assert power_save_in(decoded(raw.power_save(0))) is False
    assert power_save_in([]) is None


class GoneError(Exception):
    """Like pyroute2's NetlinkError."""

    code = 19


class UnsupportedError(Exception):
    code = 95


class Radio:
    """A kernel with Wi-Fi, in the place of ``Nl80211``: what it answers may change at any time.

    Like Linux 6.1 it gives an empty list of stations for an interface that is no longer there.
    """

    raises_when_gone = False

    def __init__(self) -> None:
        self.listed: bytes | None = raw.interface(7, "wlan0")
        self.heard: bytes | None = raw.station(-52, inactive_ms=0)
        self.surveyed: bytes | None = raw.survey(-95, in_use=True)
        self.fault: Exception | None = None
        self.polls = 0
        self.closed = False

    def interfaces(self) -> list[Interface]:
        self.polls += 1
        return interfaces_in(decoded(self.listed) if self.listed else [])

    def station(self, interface: Interface) -> Station | None:
        self.polls += 1
        if self.fault is not None:
            raise self.fault
        there = any(interface.index == each.index for each in self.interfaces())
        if not there and self.raises_when_gone:
            raise GoneError
        return station_in(decoded(self.heard) if self.heard and there else [])

    def noise_dbm(self, interface: Interface) -> float | None:
        if self.surveyed is None:
            raise UnsupportedError
        return noise_in(decoded(self.surveyed))

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def radio(monkeypatch: pytest.MonkeyPatch) -> Radio:
    radio = Radio()
    monkeypatch.setattr(wifi, "Nl80211", lambda: radio)
    return radio


def test_snr_is_signal_less_noise(radio: Radio) -> None:
    with WifiSnr(period_s=0.001) as snr:
        assert snr.read().snr_db == -52.0 + 95.0
        assert snr.details["noise_from"] == "survey"
        radio.heard = raw.station(-80)
        until(lambda: snr.read().snr_db == -80.0 + 95.0)
    assert radio.closed


def test_a_reading_is_as_old_as_the_frame_it_comes_from(radio: Radio) -> None:
    radio.heard = raw.station(-52, inactive_ms=3000)
    with WifiSnr(clock=lambda: 0.0) as snr:
        assert snr.read().age_s == 3.0


def test_noise_comes_from_bandwidth_where_the_driver_has_none(radio: Radio) -> None:
    radio.surveyed = None
    with WifiSnr("wlan0") as snr:
        assert snr.read().snr_db == pytest.approx(-52.0 - thermal_noise_dbm(80e6))
        assert snr.details["noise_from"] == "bandwidth"
    with WifiSnr("wlan0", noise_dbm=-90.0) as snr:
        assert snr.read().snr_db == 38.0


@pytest.mark.parametrize("raises", [False, True])
def test_a_link_that_is_down_reads_minus_infinity_until_it_is_back(
    radio: Radio, raises: bool
) -> None:
    radio.raises_when_gone = raises
    with WifiSnr(period_s=0.001) as snr:
        radio.heard = None
        until(lambda: snr.read().snr_db == -math.inf)
        assert snr.details["state"] == "not associated"
        radio.listed = None  # the adapter is pulled out
        until(lambda: snr.details["state"] == "gone")
        assert snr.read().snr_db == -math.inf
        assert snr.problem is None
        radio.listed, radio.heard = raw.interface(9, "wlan0"), raw.station(-60)
        until(lambda: snr.read().snr_db == 35.0)


def test_a_failed_poll_lets_the_reading_grow_old_and_is_no_lost_link(
    radio: Radio, caplog: pytest.LogCaptureFixture
) -> None:
    with WifiSnr(period_s=0.001) as snr:
        radio.fault = OSError("netlink is busy")
        until(lambda: snr.problem == "netlink is busy")
        before = snr.read()
        assert before.snr_db == 43.0
        until(lambda: snr.read().age_s > before.age_s)
        radio.fault = None
        until(lambda: snr.problem is None)
    assert caplog.text.count("no new reading") == 1


def test_a_driver_without_signal_is_refused_at_the_start(radio: Radio) -> None:
    radio.heard = raw.station(None)
    with pytest.raises(SnrSourceError, match="its driver reports none: use GoodputSnr"):
        WifiSnr()
    radio.heard, radio.fault = raw.station(), OSError("broken")
    with pytest.raises(SnrSourceError, match=r"OSError: broken\): use GoodputSnr"):
        WifiSnr()


def test_an_interface_that_is_not_there_is_named(
    radio: Radio, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for name in ("eth0", "lo", "wlan0"):
        (tmp_path / name).mkdir()
    monkeypatch.setattr(nl80211, "NET_FOLDER", tmp_path)
    expected = r"a wireless interface wlan9, found eth0, wlan0: use GoodputSnr"
    with pytest.raises(SnrSourceError, match=expected):
        WifiSnr("wlan9")
    radio.listed = None
    with pytest.raises(SnrSourceError, match="expected a wireless interface, found eth0"):
        WifiSnr()
    with pytest.raises(SnrSourceError, match="noise_dbm"):
        WifiSnr(noise_dbm=math.nan)


def test_a_machine_without_wifi_says_what_to_use_instead() -> None:
    if any((entry / "phy80211").exists() for entry in nl80211.NET_FOLDER.iterdir()):
        pytest.skip("this machine has Wi-Fi")
    with pytest.raises(SnrSourceError, match="use GoodputSnr"):
        WifiSnr()


def test_without_the_library_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    imported = builtins.__import__

    def without_pyroute2(name: str, *arguments: Any, **keywords: Any) -> Any:
        if name.startswith("pyroute2"):
            raise ImportError(name)
        return imported(name, *arguments, **keywords)

    monkeypatch.setattr(builtins, "__import__", without_pyroute2)
    with pytest.raises(DependencyError, match=r"comvla\[wifi\]"):
        WifiSnr()


def test_a_simulated_radio_of_the_kernel_reads_as_not_associated() -> None:
    """mac80211_hwsim gives interfaces without an access point: real netlink, both ways."""
    if not Path("/sys/module/mac80211_hwsim").exists():
        pytest.skip("needs the kernel module mac80211_hwsim: modprobe mac80211_hwsim")
    with WifiSnr() as snr:
        assert snr.read().snr_db == -math.inf
        assert snr.details["state"] == "not associated"


@pytest.mark.alone
def test_decoding_a_poll_takes_less_than_a_millisecond() -> None:
    (message,) = raw.recorded("station")  # with its 17 sets of counters
    elapsed_s = []
    for _ in range(50):
        began = time.perf_counter()
        station_in(decoded(message))
        elapsed_s.append(time.perf_counter() - began)
    assert min(elapsed_s) < 1e-3
