"""This machine's own share: TCP settings, and a Wi-Fi card that sleeps."""

from __future__ import annotations

import contextlib
import socket
import struct
from collections.abc import Iterator

from comvla.errors import ComVLAError
from comvla_client.diagnosis.finding import Finding, Status
from comvla_client.diagnosis.reach import Path, mtu
from comvla_client.snr.nl80211 import NET_FOLDER, Interface, Nl80211
from comvla_client.tcp_tuning import examine_tcp

_SIOCGIFADDR = 0x8915


def machine(path: Path, idle_costs: bool) -> Iterator[Finding]:
    """What this machine does to the link.

    Args:
        path: of a connection to the server.
        idle_costs: whether a silence was seen to cost something: only then the setting that causes
            it counts against the link.
    """
    for setting in examine_tcp():
        found = setting.found
        if setting.check == "tcp_congestion_control" and path.congestion_control not in (
            None,
            setting.values.get(setting.check),
        ):
            found += f"; connections to this server use {path.congestion_control}"
        harmful = idle_costs and setting.check == "tcp_slow_start_after_idle"
        status: Status = "fail" if harmful else "note"
        yield Finding(
            setting.check, "ok" if setting.ok else status, found, setting.remedy, setting.values
        )
    size = mtu(path)
    if size is not None:
        yield size
    yield wifi(interface_of(path.local_address))


def interface_of(local_address: str) -> str | None:
    """Name of the interface that has an IPv4 address; None where it cannot be told."""
    try:
        import fcntl

        wanted = socket.inet_aton(local_address)
    except (ImportError, OSError):
        return None
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        for _, name in socket.if_nameindex():
            with contextlib.suppress(OSError):
                request = struct.pack("256s", name.encode()[:15])
                if fcntl.ioctl(asking.fileno(), _SIOCGIFADDR, request)[20:24] == wanted:
                    return name
    return None


def wifi(name: str | None) -> Finding:
    """Whether the interface on the way is a Wi-Fi card that sleeps between beacons."""
    if name is None:
        return Finding("wifi", "skip", "which interface leads to the server cannot be told")
    values: dict[str, object] = {"interface": name}
    if not (NET_FOLDER / name / "phy80211").exists():
        return Finding("wifi", "ok", f"{name} leads to the server, and is no Wi-Fi", values=values)
    try:
        saves = _power_save(name)
    except (ComVLAError, OSError) as error:
        return Finding(
            "wifi",
            "skip",
            f"{name} is Wi-Fi; whether it saves power cannot be told ({error})",
            f"pip install 'comvla[wifi]', or look yourself: iw dev {name} get power_save",
            values,
        )
    values["power_save"] = saves
    if not saves:
        said = "its driver does not say whether it saves power" if saves is None else "always awake"
        return Finding("wifi", "ok", f"{name} is Wi-Fi, {said}", values=values)
    return Finding(
        "wifi",
        "fail",
        f"{name} is Wi-Fi and sleeps between beacons: answers wait up to some 100 ms for it",
        f"iw dev {name} set power_save off (NetworkManager: wifi.powersave = 2)",
        values,
    )


def _power_save(name: str) -> bool | None:
    kernel = Nl80211()
    try:
        for interface in kernel.interfaces():
            if interface.name == name:
                return kernel.power_save(Interface(name, interface.index, 0, None))
        return None
    except Exception as error:  # pyroute2's own errors derive from nothing in common
        raise OSError(str(error)) from error
    finally:
        kernel.close()
