"""The token bucket on the robot's way out, whose rate follows a channel.

One bucketful is free whenever the rate changes, because Linux fills the bucket up at a change. So a
period's rate is set such that the bucketful and the rate together make up the capacity:
burst + rate · T = capacity. What is left is the granularity of packets. In a fade so deep that a
period carries less than a bucketful, that much still crosses: at most one packet too many.
"""

from __future__ import annotations

import errno
import math
import socket
from contextlib import ExitStack
from types import TracebackType
from typing import TYPE_CHECKING

from comvla.errors import LinkError
from comvla_sim.netlink.namespaces import entered, routes_in
from comvla_sim.netlink.wires import ETHERNET_HEADER_BYTES, Side

if TYPE_CHECKING:
    from pyroute2 import IPRoute

QUEUE_BYTES = 4 << 20
"""What waits for the radio at most; more is dropped, as a modem does."""

BURST_SHARE = 0.06
"""Size of the bucket as a share of the period's capacity, where a packet is less.

What a busy processor sends late it can send at once from a bucket of so much, 3 ms at T = 50 ms,
and does not lose. The price: so much of a period's capacity is there at its very beginning.
"""

SPARE_BYTES = 100
"""What a bucket holds beyond the largest packet: an acknowledgement must not keep that one waiting
for a period, in fades in which the bucket is all that a period has."""

# Linux keeps the bucket's size as a time of at most 4.29 s, so at a lower rate than this one the
# bucket would hold less than a packet, and packets would be dropped instead of delayed.
_LONGEST_BURST_S = 4.0

_NUDGE_ETHERTYPE = 0x88B5  # for local experiments (IEEE 802)
_NUDGE = bytes.fromhex("02000000000002000000000188b500")


class Shaper:
    """Shapes what leaves one end of a cable. Use as a context manager.

    Args:
        side: the end.
        mtu_bytes: of the cable.
        period_s: T, how long a rate holds.

    Raises:
        LinkError: the kernel has no token bucket (``sch_tbf``).
    """

    def __init__(self, side: Side, *, mtu_bytes: int, period_s: float) -> None:
        self._side = side
        self._mtu_bytes = mtu_bytes
        self._period_s = period_s
        self._least_burst_bytes = mtu_bytes + ETHERNET_HEADER_BYTES + SPARE_BYTES
        self._stack = ExitStack()
        self._routes: IPRoute | None = None
        self._nudge: socket.socket | None = None
        self._index = 0
        self._rate: float | None = None

    def __enter__(self) -> Shaper:
        self._routes = self._stack.enter_context(routes_in(self._side.namespace))
        self._index = self._routes.link_lookup(ifname=self._side.device)[0]
        with entered(self._side.namespace):
            self._nudge = self._stack.enter_context(
                socket.socket(socket.AF_PACKET, socket.SOCK_RAW)
            )
            self._nudge.bind((self._side.device, _NUDGE_ETHERTYPE))
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._routes = self._nudge = None
        self._stack.close()

    @property
    def least_bytes(self) -> float:
        """What a period carries at least, however deep the fade, in bytes at the IP layer."""
        return self._at_ip_layer(self._least_burst_bytes * (1 + self._period_s / _LONGEST_BURST_S))

    def set_capacity(self, capacity_bytes: float) -> float:
        """Starts a period that carries so many bytes of IP packets.

        Returns:
            The rate of the bucket in bytes per second (of Ethernet frames, as Linux counts).

        Raises:
            LinkError: the device is gone.
        """
        frames_bytes = capacity_bytes * self._frame_share()
        burst_bytes = max(self._least_burst_bytes, BURST_SHARE * frames_bytes)
        rate = (frames_bytes - burst_bytes) / self._period_s
        return self._set(rate, burst_bytes)

    def set_rate(self, bytes_per_s: float) -> float:
        """Holds one rate of IP packets from now on, in bytes per second; see :meth:`set_capacity`."""
        rate = bytes_per_s * self._frame_share()
        return self._set(rate, max(self._least_burst_bytes, BURST_SHARE * rate * self._period_s))

    def _set(self, rate: float, burst_bytes: float) -> float:
        from pyroute2 import NetlinkError

        rate = max(rate, burst_bytes / _LONGEST_BURST_S)
        if rate == self._rate:  # a change would only fill the bucket up
            self._wake()
            return rate
        assert self._routes is not None, "a shaper works inside its with block"
        command = "add" if self._rate is None else "change"
        # The bucket's size travels as whole microseconds at this rate: never round it down to less
        # than a packet, which would be dropped.
        burst_us = math.ceil(1e6 * burst_bytes / int(rate))
        try:
            self._routes.tc(
                command,
                "tbf",
                index=self._index,
                handle=0x10000,
                rate=int(rate),
                burst=(burst_us + 0.5) * int(rate) / 1e6,
                limit=QUEUE_BYTES,
            )
        except NetlinkError as error:
            missing = "no such" in str(error).lower() or error.code == 2
            raise LinkError(
                f"cannot shape {self._side.device} in {self._side.namespace} ({error}): "
                + (
                    "this kernel has no token bucket (CONFIG_NET_SCH_TBF, module sch_tbf)"
                    if missing and command == "add"
                    else "was the link taken down meanwhile?"
                )
            ) from error
        self._rate = rate
        self._wake()
        return rate

    def _wake(self) -> None:
        """Makes the bucket look at its queue again.

        Linux set an alarm for the next packet by the old rate, and keeps it at a change: after a
        deep fade the queue would sleep for seconds into the good period. A packet, here one of a
        few bytes and of no protocol, wakes it.

        Raises:
            LinkError: the device is gone.
        """
        assert self._nudge is not None, "a shaper works inside its with block"
        try:
            self._nudge.send(_NUDGE)
        except OSError as error:
            if error.errno in (errno.ENXIO, errno.ENODEV):
                raise LinkError(
                    f"{self._side.device} in {self._side.namespace} has vanished: was the link taken "
                    "down meanwhile?"
                ) from error
            # A device that is only down has no queue to wake.

    def _frame_share(self) -> float:
        return (self._mtu_bytes + ETHERNET_HEADER_BYTES) / self._mtu_bytes

    def _at_ip_layer(self, frame_bytes: float) -> float:
        return frame_bytes / self._frame_share()
