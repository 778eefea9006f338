"""What this machine's TCP does to a robot that sends in bursts, and what to do about it.

A chunked policy is silent between queries. Linux forgets how fast a connection was after a silence
of one retransmission timeout (RFC 2861), and the next query starts slowly: at a round trip of 40 ms
its 68 KiB then take three round trips instead of one. Nothing here changes anything; the remedies
need root, except :class:`comvla_client.warm_up.WarmUp`, which buys the same with bytes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

SYSCTL_FOLDER = Path("/proc/sys/net/ipv4")
"""Where Linux shows its TCP settings, one file each; every network namespace sees its own."""

_CLIENT_REMEDY = "or, without root, ComVLAClient(..., warm_up=True), which costs bytes instead"
_KEEP = "(a file in /etc/sysctl.d keeps it)"


@dataclass(frozen=True)
class TcpFinding:
    """One TCP setting, and whether it suits a robot that sends in bursts.

    Attributes:
        check: the setting, e.g. ``tcp_slow_start_after_idle``.
        ok: whether it is as it should be.
        found: what it is, in words.
        remedy: what to do about it; empty when all is well.
        values: the setting itself, for JSON.
    """

    check: str
    ok: bool
    found: str
    remedy: str = ""
    values: dict[str, Any] = field(default_factory=dict)


def examine_tcp(folder: Path = SYSCTL_FOLDER) -> list[TcpFinding]:
    """Reads this machine's (this network namespace's) TCP settings.

    Args:
        folder: holds the settings; another one than Linux's own for tests.

    Returns:
        One finding for each setting that matters and that the kernel has; none where the system is
        not Linux.
    """
    names = (*_CHECKS, "tcp_available_congestion_control")
    settings = {name: _read(folder / name) for name in names}
    return [
        check(settings[name] or "", settings)
        for name, check in _CHECKS.items()
        if settings[name] is not None
    ]


def _slow_start_after_idle(value: str, settings: dict[str, str | None]) -> TcpFinding:
    check = "tcp_slow_start_after_idle"
    values = {check: int(value)}
    if value == "0":
        return TcpFinding(check, True, "0: a query after a silence goes at full speed", "", values)
    if (settings["tcp_congestion_control"] or "").startswith("bbr"):
        found = "1, which bbr ignores: it keeps its own model of the link through a silence"
        return TcpFinding(check, True, found, "", values)
    return TcpFinding(
        check,
        False,
        "1: after a silence of some 0.2 s a query starts slowly, at two round trips more for 68 KiB",
        f"sysctl -w net.ipv4.tcp_slow_start_after_idle=0 {_KEEP}, {_CLIENT_REMEDY}",
        values,
    )


def _congestion_control(value: str, settings: dict[str, str | None]) -> TcpFinding:
    check = "tcp_congestion_control"
    values = {check: value, "available": (settings["tcp_available_congestion_control"] or "")}
    if value in ("cubic", "reno") or value.startswith("bbr"):
        return TcpFinding(check, True, value, "", values)
    return TcpFinding(
        check,
        False,
        f"{value}: made for other networks than a robot's radio",
        f"sysctl -w net.ipv4.tcp_congestion_control=cubic {_KEEP}",
        values,
    )


def _metrics(value: str, settings: dict[str, str | None]) -> TcpFinding:
    check = "tcp_no_metrics_save"
    values = {check: int(value)}
    if value == "1":
        return TcpFinding(check, True, "1: a new connection starts without prejudice", "", values)
    return TcpFinding(
        check,
        False,
        "0: a bad moment of the radio is remembered, and slows later connections to this server",
        f"sysctl -w net.ipv4.tcp_no_metrics_save=1 {_KEEP}",
        values,
    )


def _rto_max(value: str, settings: dict[str, str | None]) -> TcpFinding:
    check = "tcp_rto_max_ms"
    values = {check: int(value)}
    if int(value) <= 1000:
        return TcpFinding(
            check, True, f"{value} ms: looks for a lost link again each second", "", values
        )
    return TcpFinding(
        check,
        False,
        f"{value} ms: the pause between looks for a lost link doubles up to this",
        f"sysctl -w net.ipv4.tcp_rto_max_ms=1000 {_KEEP}; the client opens fresh connections "
        "meanwhile, so this only saves it some",
        values,
    )


_CHECKS: dict[str, Callable[[str, dict[str, str | None]], TcpFinding]] = {
    "tcp_slow_start_after_idle": _slow_start_after_idle,
    "tcp_congestion_control": _congestion_control,
    "tcp_no_metrics_save": _metrics,
    "tcp_rto_max_ms": _rto_max,
}


def _read(path: Path) -> str | None:
    try:
        return path.read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError):
        return None
