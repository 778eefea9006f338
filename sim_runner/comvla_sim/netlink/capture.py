"""A packet capture in the robot's namespace: bytes of IP packets, and when each call passed.

The socket sees a packet after the token bucket has let it go, with the kernel's own time stamp, so
neither a busy processor nor this process changes what is measured.
"""

from __future__ import annotations

import dataclasses
import json
import selectors
import socket
import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any

from comvla.errors import LinkError
from comvla_sim.bench.processes import announce, connected
from comvla_sim.netlink.http2 import Call, CallReader
from comvla_sim.netlink.namespaces import enter
from comvla_sim.netlink.realtime import prefer_this_thread, settle
from comvla_sim.netlink.wires import ETHERNET_HEADER_BYTES, Side

_ETH_P_ALL, _ETH_P_IP = 0x0003, 0x0800
_PACKET_OUTGOING = 4
_TCP = 6
_SYN = 0x02
_BUFFER_BYTES = 128 << 20
_MAX_FRAME_BYTES = 1 << 16
_SO_RCVBUFFORCE = 33
_SOL_PACKET, _PACKET_STATISTICS = 263, 6
_SO_TIMESTAMPNS = 35
_ANSWER_WITHIN_S = 60.0


@dataclass
class Counts:
    """Packets of one direction so far, at the IP layer.

    Attributes:
        packets: all of them.
        bytes: their bytes, IP headers included.
        empty_packets: those that carry no data: acknowledgements, and what opens and ends
            connections.
        empty_bytes: their bytes.
        repeated_bytes: bytes of packets whose data had passed before (sent again).
    """

    packets: int = 0
    bytes: int = 0
    empty_packets: int = 0
    empty_bytes: int = 0
    repeated_bytes: int = 0


@dataclass
class Captured:
    """What a capture saw.

    Attributes:
        up: what left the robot.
        down: what reached it.
        calls: of the robot, in the order in which they began on the wire; times on
            ``time.monotonic``.
        period_bytes: bytes that left the robot in each control period, where periods are counted.
        lost: packets that the capture itself missed; more than 0 make all of this a lower bound.
    """

    up: Counts = field(default_factory=Counts)
    down: Counts = field(default_factory=Counts)
    calls: list[Call] = field(default_factory=list)
    period_bytes: list[int] = field(default_factory=list)
    lost: int = 0


class Capture:
    """A running capture, to be asked.

    Args:
        lifeline: to the capturing process.
    """

    def __init__(self, lifeline: Connection) -> None:
        self._lifeline = lifeline

    def count_periods(self, start: float, period_s: float) -> None:
        """Counts bytes by control period from now on; period 0 begins at ``start`` (monotonic)."""
        self._ask({"start": start, "period_s": period_s})

    def counts(self) -> tuple[Counts, Counts]:
        """Bytes and packets so far, up and down."""
        answer = self._ask({"what": "counts"})
        return Counts(**answer["up"]), Counts(**answer["down"])

    def result(self) -> Captured:
        """Everything so far."""
        answer = self._ask({"what": "all"})
        return Captured(
            up=Counts(**answer["up"]),
            down=Counts(**answer["down"]),
            calls=[Call(**call) for call in answer["calls"]],
            period_bytes=answer["period_bytes"],
            lost=answer["lost"],
        )

    def _ask(self, question: dict[str, Any]) -> dict[str, Any]:
        try:
            self._lifeline.send_bytes(json.dumps(question).encode())
            if self._lifeline.poll(_ANSWER_WITHIN_S):
                answer: dict[str, Any] = json.loads(self._lifeline.recv_bytes())
                return answer
        except (OSError, EOFError):
            pass
        raise LinkError(
            "the packet capture has ended (its message is above): was the link taken down meanwhile?"
        )


@contextmanager
def capturing(side: Side) -> Iterator[Capture]:
    """Captures what passes one end of a cable while the block lasts, in a process of its own."""
    with connected(serve, side) as (lifeline, _):
        yield Capture(lifeline)


def serve(lifeline: Connection, side: Side) -> None:
    """Captures until the lifeline ends; answers what :class:`Capture` asks."""
    enter(side.namespace)
    prefer_this_thread()
    tap = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(_ETH_P_ALL))
    tap.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _BUFFER_BYTES)
    tap.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
    tap.bind((side.device, _ETH_P_ALL))
    tap.setblocking(False)
    reader = PacketReader()
    settle()
    with selectors.DefaultSelector() as selector:
        selector.register(tap, selectors.EVENT_READ)
        selector.register(lifeline.fileno(), selectors.EVENT_READ, lifeline)
        announce(lifeline, "capture")
        while True:
            ready = selector.select()
            _drain(tap, reader)
            if any(key.data is not None for key, _ in ready):
                try:
                    question = json.loads(lifeline.recv_bytes())
                except EOFError:
                    return
                lifeline.send_bytes(json.dumps(_answer(question, reader, tap)).encode())


def _drain(tap: socket.socket, reader: PacketReader) -> None:
    while True:
        try:
            frame, extras, _, address = tap.recvmsg(_MAX_FRAME_BYTES, 64)
        except BlockingIOError:
            return
        except OSError:  # the device went down under the socket; it may come back
            time.sleep(0.001)
            return
        stamp = next((data for _, kind, data in extras if kind == _SO_TIMESTAMPNS), None)
        passed = time.time()
        if stamp is not None:
            seconds, nanoseconds = struct.unpack("qq", stamp[:16])
            passed = seconds + 1e-9 * nanoseconds
        reader.take(frame, outgoing=address[2] == _PACKET_OUTGOING, wall_s=passed)


def _answer(question: dict[str, Any], reader: PacketReader, tap: socket.socket) -> dict[str, Any]:
    seen = reader.captured
    if "start" in question:
        reader.count_periods(question["start"], question["period_s"])
        return {}
    answer: dict[str, Any] = {
        "up": dataclasses.asdict(seen.up),
        "down": dataclasses.asdict(seen.down),
    }
    if question["what"] == "all":
        statistics = tap.getsockopt(_SOL_PACKET, _PACKET_STATISTICS, 8)
        seen.lost += struct.unpack("II", statistics)[1]
        answer["calls"] = [dataclasses.asdict(call) for call in seen.calls]
        answer["period_bytes"] = seen.period_bytes
        answer["lost"] = seen.lost
    return answer


@dataclass
class _Stream:
    """What one side of a connection sent, put in order."""

    reader: CallReader
    next_seq: int
    waiting: dict[int, bytes] = field(default_factory=dict)


class PacketReader:
    """Counts packets and follows the calls inside them."""

    def __init__(self) -> None:
        self.captured = Captured()
        self._streams: dict[int, _Stream] = {}
        self._start: float | None = None
        self._period_s = 0.0
        self._wall_to_monotonic_s = time.monotonic() - time.time()

    def count_periods(self, start: float, period_s: float) -> None:
        """See :meth:`Capture.count_periods`."""
        self._start, self._period_s = start, period_s
        self._wall_to_monotonic_s = time.monotonic() - time.time()

    def take(self, frame: bytes, *, outgoing: bool, wall_s: float) -> None:
        """Takes one Ethernet frame that passed at ``wall_s`` seconds since the epoch."""
        if len(frame) < ETHERNET_HEADER_BYTES + 20 or frame[12:14] != _ETH_P_IP.to_bytes(2, "big"):
            return
        packet = frame[ETHERNET_HEADER_BYTES:]
        length = int.from_bytes(packet[2:4], "big")
        now_s = wall_s + self._wall_to_monotonic_s
        counts = self.captured.up if outgoing else self.captured.down
        counts.packets += 1
        counts.bytes += length
        if outgoing and self._start is not None and now_s >= self._start:
            period = int((now_s - self._start) / self._period_s)
            bins = self.captured.period_bytes
            bins.extend([0] * (period + 1 - len(bins)))
            bins[period] += length
        if packet[9] != _TCP:
            return
        segment = packet[4 * (packet[0] & 0x0F) : length]
        data = segment[4 * (segment[12] >> 4) :]
        if not data:
            counts.empty_packets += 1
            counts.empty_bytes += length
        if outgoing:
            self._follow(segment, data, now_s, length)

    def _follow(self, segment: bytes, data: bytes, now_s: float, length: int) -> None:
        port = int.from_bytes(segment[0:2], "big")
        seq = int.from_bytes(segment[4:8], "big")
        if segment[13] & _SYN:
            reader = CallReader(self.captured.calls.append)
            self._streams[port] = _Stream(reader, (seq + 1) & 0xFFFF_FFFF)
            return
        stream = self._streams.get(port)
        if stream is None or not data:
            return
        ahead = (seq - stream.next_seq) & 0xFFFF_FFFF
        if ahead >= 1 << 31:  # behind: some or all of it has passed before
            data, ahead = data[(1 << 32) - ahead :], 0
            if not data:
                self.captured.up.repeated_bytes += length
                return
        if ahead:
            stream.waiting[(stream.next_seq + ahead) & 0xFFFF_FFFF] = data
            return
        while True:
            stream.reader.feed(data, now_s)
            stream.next_seq = (stream.next_seq + len(data)) & 0xFFFF_FFFF
            if stream.next_seq not in stream.waiting:
                return
            data = stream.waiting.pop(stream.next_seq)  # whole only now that the gap is filled
