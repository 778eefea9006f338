"""Is the port open, and what does this machine's TCP say of the way there?"""

from __future__ import annotations

import contextlib
import socket
import struct
import time
from dataclasses import dataclass

from comvla_client.diagnosis.finding import Finding

SMALLEST_GOOD_MTU = 1280
"""Below this every packet's 40 to 60 bytes of headers weigh more than 3 %."""

_IP_MTU, _IPV6_MTU = 14, 24  # Linux; the socket module does not name them
# struct tcp_info: eight bytes of flags, then u32 rto, ato, snd_mss, ...
_TCP_INFO_SND_MSS = 8 + 4 * 2


@dataclass(frozen=True)
class Path:
    """A TCP connection as the kernel describes it; None where the system does not say.

    Attributes:
        local_address: address of this end.
        congestion_control: its algorithm.
        mtu_bytes: of the path, as far as it is known.
        segment_bytes: largest TCP segment.
    """

    local_address: str
    congestion_control: str | None
    mtu_bytes: int | None
    segment_bytes: int | None


def reach(target: str, timeout_s: float) -> tuple[Finding, Path | None]:
    """Opens a TCP connection and closes it.

    Args:
        target: ``host:port``.
        timeout_s: longest to wait, in seconds.

    Returns:
        The finding, and the path where there is one.
    """
    host, _, port = target.rpartition(":")
    began = time.perf_counter()
    try:
        connection = socket.create_connection((host.strip("[]"), int(port)), timeout_s)
    except OSError as error:
        return Finding(
            "reach",
            "fail",
            f"no TCP connection to {target} within {timeout_s:g} s: {error}",
            "start `comvla-server serve` there, listening on an address that this robot reaches "
            "(--host 0.0.0.0 opens it to the network); check the port, the route and the firewall",
        ), None
    elapsed_s = time.perf_counter() - began
    with connection:
        path = _path(connection)
    found = f"TCP connects in {1e3 * elapsed_s:.1f} ms"
    return Finding("reach", "ok", found, values={"connect_s": elapsed_s}), path


def mtu(path: Path) -> Finding | None:
    """The path's MTU; None where the system does not say."""
    if path.mtu_bytes is None:
        return None
    values = {"mtu_bytes": path.mtu_bytes, "segment_bytes": path.segment_bytes}
    found = f"{path.mtu_bytes} bytes, TCP segments of {path.segment_bytes or 'unknown'}"
    if path.mtu_bytes >= SMALLEST_GOOD_MTU:
        return Finding("mtu", "ok", found, values=values)
    return Finding(
        "mtu",
        "note",
        found,
        f"headers take more than 3 % of each packet: raise the MTU to {SMALLEST_GOOD_MTU} or more "
        "(ip link set DEV mtu 1500), on tunnels too",
        values,
    )


def _path(connection: socket.socket) -> Path:
    is_ipv6 = connection.family == socket.AF_INET6
    level, option = (socket.IPPROTO_IPV6, _IPV6_MTU) if is_ipv6 else (socket.IPPROTO_IP, _IP_MTU)
    mtu_bytes = segment_bytes = congestion = None
    with contextlib.suppress(OSError, AttributeError):
        name = connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_CONGESTION, 16)
        congestion = name.split(b"\0")[0].decode("ascii", "replace")
    with contextlib.suppress(OSError):
        mtu_bytes = connection.getsockopt(level, option)
    with contextlib.suppress(OSError, AttributeError, struct.error):
        info = connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 104)
        (segment_bytes,) = struct.unpack_from("=I", info, _TCP_INFO_SND_MSS)
    return Path(connection.getsockname()[0], congestion, mtu_bytes, segment_bytes)
