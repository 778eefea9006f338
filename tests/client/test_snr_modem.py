"""A modem's SNR, asked of a ModemManager on a real message bus."""

from __future__ import annotations

import builtins
import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from fake_modem_manager import MODEM_PATH, FakeModemManager, bus
from waiting import until

from comvla.errors import DependencyError
from comvla_client.errors import SnrSourceError
from comvla_client.snr import ModemManagerSnr
from comvla_client.snr.modem import RESOURCE_ELEMENT_NOISE_DBM, snr_of

pytest.importorskip("jeepney", reason="needs jeepney")


@pytest.fixture
def address(tmp_path: Path) -> Iterator[str]:
    with bus(tmp_path) as address:
        yield address


@pytest.fixture
def manager(address: str) -> Iterator[FakeModemManager]:
    with FakeModemManager(address) as manager:
        yield manager


def source(address: str, **options: Any) -> ModemManagerSnr:
    return ModemManagerSnr(bus=address, poll_s=0.01, **{"start_timeout_s": 60.0, **options})


def test_it_reads_lte_and_asks_for_measurements(address: str, manager: FakeModemManager) -> None:
    with source(address, rate_s=2) as snr:
        reading = snr.read()
        assert reading.snr_db == 12.0
        assert reading.age_s >= 0.0
        assert manager.rates == [2]
        assert snr.details["technology"] == "Lte"
        assert snr.details["signals"]["Lte"] == {"snr": 12.0, "rsrp": -95.0}
        manager.signals = {"Lte": {"snr": 12.0}, "Nr5g": {"snr": 21.5, "rsrp": -80.0}}
        until(lambda: snr.read().snr_db == 21.5)
        assert snr.details["technology"] == "Nr5g"


def test_a_value_that_does_not_change_is_never_younger_than_it_may_be(
    address: str, manager: FakeModemManager
) -> None:
    now_s = [0.0]
    with source(address, rate_s=5, clock=lambda: now_s[0]) as snr:
        assert snr.read().age_s == pytest.approx(0.01)  # it just appeared: one poll
        now_s[0] = 3.0
        until(lambda: snr._latest is not None and snr._latest[0] == pytest.approx(-0.01))
        assert snr.read().age_s == pytest.approx(3.01)
        now_s[0] = 60.0  # by now the modem has measured again, and found the same
        until(lambda: snr.read().age_s == pytest.approx(5.01))


def test_a_modem_without_a_network_or_unplugged_is_a_link_that_is_down(
    address: str, manager: FakeModemManager
) -> None:
    with source(address) as snr:
        manager.state = 7  # searching
        until(lambda: snr.read().snr_db == -math.inf)
        assert snr.details["state"] == "no network"
        manager.state = 11
        until(lambda: snr.read().snr_db == 12.0)
        manager.present = False
        until(lambda: snr.details["state"] == "gone")
        assert snr.read().snr_db == -math.inf
        assert snr.problem is None  # that was an answer
        manager.present = True
        until(lambda: snr.read().snr_db == 12.0)


def test_without_modem_manager_the_last_reading_grows_old_until_it_is_back(
    address: str, manager: FakeModemManager
) -> None:
    with source(address) as snr:
        manager.close()
        until(lambda: "systemctl start ModemManager" in str(snr.problem))
        first = snr.read()
        assert first.snr_db == 12.0
        until(lambda: snr.read().age_s > first.age_s)
        with FakeModemManager(address) as restarted:
            restarted.signals = {"Lte": {"snr": 3.0}}
            until(lambda: snr.read().snr_db == 3.0)
            assert restarted.rates == [1]  # it was told anew what to measure
        assert snr.problem is None or "ModemManager" in snr.problem


def test_a_bus_that_goes_away_is_survived(tmp_path: Path) -> None:
    with bus(tmp_path) as address, FakeModemManager(address) as manager:
        snr = source(address)
        manager.close()
    until(lambda: snr.problem is not None and "D-Bus" in snr.problem)
    assert snr.read().snr_db == 12.0
    snr.close()


def test_a_modem_that_measures_late_is_waited_for(address: str, manager: FakeModemManager) -> None:
    manager.signals = {}
    with ThreadPoolExecutor() as pool:
        made = pool.submit(source, address)
        until(lambda: bool(manager.rates))
        manager.signals = {"Lte": {"snr": 5.0}}
        with made.result(20) as snr:
            assert snr.read().snr_db == 5.0
    manager.signals = {}
    with pytest.raises(SnrSourceError, match=r"nothing without one: use GoodputSnr"):
        source(address, start_timeout_s=0.1)


def test_every_absence_says_what_to_use_instead(address: str, manager: FakeModemManager) -> None:
    def error(**options: Any) -> str:
        with pytest.raises(SnrSourceError) as raised:
            source(address, **options)
        assert "GoodputSnr" in str(raised.value)
        return str(raised.value)

    assert f"has {MODEM_PATH}" in error(modem="7")
    manager.refuse = "org.freedesktop.ModemManager1.Error.Core.Unauthorized"
    assert "polkit" in error()
    manager.refuse = "org.freedesktop.ModemManager1.Error.Core.Unsupported"
    assert "Unsupported" in error()
    manager.present = False
    assert "has none" in error()
    manager.close()
    assert "does not run" in error()


def test_no_bus_and_no_library_are_told_apart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(SnrSourceError, match="start dbus and ModemManager"):
        source(f"unix:path={tmp_path}/none")
    imported = builtins.__import__

    def without_jeepney(name: str, *arguments: Any, **keywords: Any) -> Any:
        if name.startswith("jeepney"):
            raise ImportError(name)
        return imported(name, *arguments, **keywords)

    monkeypatch.setattr(builtins, "__import__", without_jeepney)
    with pytest.raises(DependencyError, match=r"comvla\[modem\]"):
        source("SYSTEM")


def test_options_out_of_range_are_refused() -> None:
    for options in ({"rate_s": 0}, {"rate_s": 1.5}, {"poll_s": 0.0}, {"poll_s": math.nan}):
        with pytest.raises(SnrSourceError, match="expected a"):
            ModemManagerSnr(**options)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("signals", "expected"),
    [
        ({"Lte": {"snr": 8.0}, "Nr5g": {"snr": 15.0}}, (15.0, "Nr5g", "snr")),
        ({"Lte": {"snr": 8.0}, "Nr5g": {"rsrp": -90.0}}, (8.0, "Lte", "snr")),
        ({"Evdo": {"sinr": 4.0}}, (4.0, "Evdo", "sinr")),
        ({"Lte": {"rsrp": -100.0}}, (-100.0 - RESOURCE_ELEMENT_NOISE_DBM, "Lte", "rsrp")),
        ({"Umts": {"rssi": -70.0}}, None),
        ({}, None),
    ],
)
def test_which_value_tells_the_snr(signals: Any, expected: Any) -> None:
    assert snr_of(signals) == expected
