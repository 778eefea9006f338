"""Virtual Ethernet between the namespaces: addresses, neighbours, real packets, TCP settings."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from comvla.errors import LinkError
from comvla_sim.netlink.namespaces import entered, routes_in

ROBOT_ADDRESS = "10.53.0.1"
CLOUD_ADDRESS = "10.53.0.2"
DEVICE = "radio0"
"""Name of the device in the robot's and in the cloud's namespace."""

ROBOT_MAC = "02:c0:5a:00:00:01"
CLOUD_MAC = "02:c0:5a:00:00:02"

ETHERNET_HEADER_BYTES = 14

_BRIDGE = "air0"
_PREFIX_LENGTH = 30
# What lets one packet stand for many, or leaves its checksum to a card that is not there: a shaper
# and a capture would then see packets that no radio carries.
_OFFLOADS = (
    "generic-segmentation-offload",
    "tcp-segmentation-offload",
    "generic-receive-offload",
    "tx-checksumming",
)


@dataclass(frozen=True)
class Side:
    """One end of a cable.

    Attributes:
        namespace: where it is.
        device: its name there.
        mac: its Ethernet address; None leaves it to the kernel.
    """

    namespace: str
    device: str
    mac: str | None = None


def join(left: Side, right: Side, *, mtu_bytes: int) -> None:
    """Lays a cable between two namespaces and switches both ends on.

    Raises:
        LinkError: the system refuses, e.g. an MTU out of range.
    """
    from pyroute2 import NetlinkError

    try:
        with routes_in(left.namespace) as routes:
            routes.link(
                "add",
                kind="veth",
                ifname=left.device,
                mtu=mtu_bytes,
                peer={"ifname": right.device, "mtu": mtu_bytes, "net_ns_fd": right.namespace},
            )
        for side in (left, right):
            with routes_in(side.namespace) as routes:
                index = routes.link_lookup(ifname=side.device)[0]
                if side.mac is not None:
                    routes.link("set", index=index, address=side.mac)
                routes.link("set", index=index, state="up")
    except NetlinkError as error:
        raise LinkError(f"cannot lay a cable of MTU {mtu_bytes} bytes: {error}") from error
    for side in (left, right):
        send_real_packets(side)


def address(side: Side, own: str, peer: str, peer_mac: str) -> None:
    """Gives an end its address, and tells it the other's, so that nothing is asked on the air."""
    with routes_in(side.namespace) as routes:
        index = routes.link_lookup(ifname=side.device)[0]
        routes.addr("add", index=index, address=own, prefixlen=_PREFIX_LENGTH)
        routes.neigh("replace", dst=peer, lladdr=peer_mac, ifindex=index, state="permanent")


def steer(
    side: Side,
    peer: str,
    *,
    congestion_control: str | None = None,
    initcwnd: int | None = None,
    quickack: bool = False,
) -> None:
    """Sets what the route to the other end says about its connections.

    A route may name any congestion control that the kernel has loaded, where the sysctl of a
    namespace may name only those that the machine's owner allowed (tcp_allowed_congestion_control).

    Args:
        side: the end whose route it is.
        peer: address of the other end.
        congestion_control: e.g. ``cubic`` or ``bbr``; None leaves the machine's default.
        initcwnd: packets that a new connection sends before the first answer; None leaves 10.
        quickack: acknowledge every packet at once.

    Raises:
        LinkError: the kernel does not have this congestion control, or refuses a number.
    """
    from pyroute2 import NetlinkError

    metrics: dict[str, str | int] = {}
    if congestion_control is not None:
        metrics["cc_algo"] = congestion_control
    if initcwnd is not None:
        metrics["initcwnd"] = initcwnd
    if quickack:
        metrics["quickack"] = 1
    with routes_in(side.namespace) as routes:
        index = routes.link_lookup(ifname=side.device)[0]
        try:
            routes.route("replace", dst=f"{peer}/32", oif=index, metrics=metrics)
        except NetlinkError as error:
            known = Path("/proc/sys/net/ipv4/tcp_available_congestion_control")
            raise LinkError(
                f"cannot set {metrics} for the way to {peer}: {error}; congestion controls of "
                f"this kernel: {known.read_text(encoding='ascii').strip()}"
            ) from error


def send_real_packets(side: Side) -> None:
    """Switches offloads off: every packet is one that a radio could carry, checksum included."""
    from pyroute2.ethtool.ioctl import IoctlEthtool, NotSupportedError

    with entered(side.namespace), contextlib.closing(IoctlEthtool(side.device)) as device:
        for offload in _OFFLOADS:
            with contextlib.suppress(NotSupportedError):
                device.set_offload_flag(offload, 0)


def bridge(namespace: str, ports: Sequence[Side]) -> None:
    """Joins devices of one namespace, so that packets pass between them as on one cable.

    Raises:
        LinkError: the kernel has no bridges.
    """
    from pyroute2 import NetlinkError

    with routes_in(namespace) as routes:
        try:
            routes.link("add", ifname=_BRIDGE, kind="bridge", br_forward_delay=0, br_stp_state=0)
        except NetlinkError as error:
            raise LinkError(
                f"cannot make a bridge ({error}): this kernel has none (module bridge); a link with "
                "a delay does without"
            ) from error
        index = routes.link_lookup(ifname=_BRIDGE)[0]
        for port in ports:
            member = routes.link_lookup(ifname=port.device)[0]
            routes.link("set", index=member, master=index)
        routes.link("set", index=index, state="up")
    send_real_packets(Side(namespace, _BRIDGE))


def set_carrier(side: Side, up: bool) -> None:
    """Switches an end on or off; the other end loses its carrier, as behind an unplugged cable."""
    with routes_in(side.namespace) as routes:
        index = routes.link_lookup(ifname=side.device)[0]
        routes.link("set", index=index, state="up" if up else "down")


def tune(namespace: str, settings: Mapping[str, str | int]) -> None:
    """Sets TCP settings (``net.ipv4.*``) of a namespace.

    Raises:
        LinkError: the kernel has no such setting or refuses the value.
    """
    with entered(namespace):
        for name, value in settings.items():
            try:
                Path("/proc/sys/net/ipv4", name).write_text(str(value), encoding="ascii")
            except OSError as error:
                raise LinkError(
                    f"cannot set net.ipv4.{name} = {value} in {namespace}: {error.strerror}"
                ) from error
