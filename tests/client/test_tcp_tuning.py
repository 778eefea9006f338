"""What a robot is told about its machine's TCP settings."""

from __future__ import annotations

from pathlib import Path

import pytest

from comvla_client.tcp_tuning import SYSCTL_FOLDER, TcpFinding, examine_tcp

GOOD = {
    "tcp_slow_start_after_idle": "0",
    "tcp_congestion_control": "cubic",
    "tcp_available_congestion_control": "reno bbr cubic",
    "tcp_no_metrics_save": "1",
    "tcp_rto_max_ms": "1000",
}


def findings(tmp_path: Path, **changes: str | None) -> dict[str, TcpFinding]:
    for name, value in (GOOD | changes).items():
        if value is not None:
            (tmp_path / name).write_text(f"{value}\n", encoding="ascii")
    return {finding.check: finding for finding in examine_tcp(tmp_path)}


def test_a_tuned_machine_has_nothing_to_remedy(tmp_path: Path) -> None:
    found = findings(tmp_path)
    assert len(found) == 4
    assert all(finding.ok and not finding.remedy for finding in found.values())


@pytest.mark.parametrize(
    ("name", "value", "remedy"),
    [
        ("tcp_slow_start_after_idle", "1", "net.ipv4.tcp_slow_start_after_idle=0"),
        ("tcp_congestion_control", "westwood", "net.ipv4.tcp_congestion_control=cubic"),
        ("tcp_no_metrics_save", "0", "net.ipv4.tcp_no_metrics_save=1"),
        ("tcp_rto_max_ms", "120000", "net.ipv4.tcp_rto_max_ms=1000"),
    ],
)
def test_each_unsuitable_setting_comes_with_the_command_that_mends_it(
    tmp_path: Path, name: str, value: str, remedy: str
) -> None:
    found = findings(tmp_path, **{name: value})
    assert [finding.check for finding in found.values() if not finding.ok] == [name]
    assert remedy in found[name].remedy


def test_slow_start_after_idle_does_no_harm_under_bbr(tmp_path: Path) -> None:
    found = findings(tmp_path, tcp_slow_start_after_idle="1", tcp_congestion_control="bbr")
    assert found["tcp_slow_start_after_idle"].ok


def test_settings_that_the_kernel_does_not_have_are_left_out(tmp_path: Path) -> None:
    assert "tcp_rto_max_ms" not in findings(tmp_path, tcp_rto_max_ms=None)


def test_a_system_that_is_not_linux_has_no_findings(tmp_path: Path) -> None:
    assert examine_tcp(tmp_path / "missing") == []


@pytest.mark.skipif(not SYSCTL_FOLDER.exists(), reason="needs Linux's /proc/sys/net/ipv4")
def test_this_machine_can_be_examined() -> None:
    assert "tcp_slow_start_after_idle" in {finding.check for finding in examine_tcp()}
