"""Propagation delay in user space: holds every packet of both directions for a while.

Linux' own ``sch_netem`` is missing from many kernels. The relay stands in the middle namespace and
passes whole packets on, so the connection is one from end to end and its round trip is what the
delay makes it; a proxy that ended the connection would hide the round trip from TCP.
"""

from __future__ import annotations

import selectors
import socket
import struct
import time
from collections import deque
from multiprocessing.connection import Connection

from comvla_sim.bench.processes import announce
from comvla_sim.netlink.namespaces import enter
from comvla_sim.netlink.realtime import prefer_this_thread, settle

_ETH_P_IP = 0x0800
_BUFFER_BYTES = 64 << 20
_MAX_FRAME_BYTES = 1 << 16
_SO_RCVBUFFORCE = 33
_SO_TIMESTAMPNS = 35
_SPIN_S = 0.0001


def serve(lifeline: Connection, namespace: str, left: str, right: str, delay_s: float) -> None:
    """Passes packets between two devices of a namespace until the lifeline ends.

    Args:
        lifeline: to the process that keeps the link.
        namespace: where both devices are.
        left: one device.
        right: the other.
        delay_s: one-way delay, seconds.
    """
    enter(namespace)
    settle()
    prefer_this_thread()
    ports = {left: _open(left), right: _open(right)}
    other = {ports[left]: ports[right], ports[right]: ports[left]}
    held: deque[tuple[float, socket.socket, bytes]] = deque()
    with selectors.DefaultSelector() as selector:
        selector.register(lifeline.fileno(), selectors.EVENT_READ)
        for port in other:
            selector.register(port, selectors.EVENT_READ)
        announce(lifeline, "relay")
        while True:
            timeout_s = None if not held else max(0.0, held[0][0] - time.time() - _SPIN_S)
            for key, _ in selector.select(timeout_s):
                if not isinstance(key.fileobj, socket.socket):
                    return  # the lifeline: the link is taken down, or its keeper died
                arrived, frame = _receive(key.fileobj)
                held.append((arrived + delay_s, other[key.fileobj], frame))
            while held and held[0][0] - _SPIN_S <= time.time():
                due, port, frame = held.popleft()
                while time.time() < due:
                    pass
                try:
                    port.send(frame)
                except OSError:
                    continue  # the device is down: the packet is lost, as on a radio


def _open(device: str) -> socket.socket:
    port = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(_ETH_P_IP))
    port.bind((device, _ETH_P_IP))
    port.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _BUFFER_BYTES)
    port.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
    return port


def _receive(port: socket.socket) -> tuple[float, bytes]:
    """The next packet, and when the kernel saw it (seconds since the epoch)."""
    try:
        frame, extras, _, _ = port.recvmsg(_MAX_FRAME_BYTES, 64)
    except OSError:  # the device went down under the socket
        return time.time(), b""
    for _, kind, data in extras:
        if kind == _SO_TIMESTAMPNS:
            seconds, nanoseconds = struct.unpack("qq", data[:16])
            return seconds + 1e-9 * nanoseconds, frame
    return time.time(), frame
