"""One payload on its way in pieces: what a progressive transport is handed, and what it took."""

from __future__ import annotations

import asyncio
import math
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from dataclasses import dataclass, field

from comvla import codec
from comvla.v1.policy_pb2 import InferProgressiveHead, InferProgressiveRequest, InferRequest

BURST_PIECES = 2
"""Pieces that are handed out at once, so that the link never waits for the robot."""


@dataclass
class PayloadStream:
    """A request whose payload is sent piece by piece, most important tokens first.

    Attributes:
        head: the request without its payload.
        payload: the coded tokens.
        ends: where pieces end in the payload, each after a whole token.
        window_s: seconds in which pieces count: the robot hands out none later, and the server
            waits no longer after the head arrived.
        min_tokens: fewer are not worth computing on.
        rate_bytes_per_s: pace at which pieces are handed out, so that what the link cannot carry
            stays with the robot; None hands them out as fast as they are taken.
        taken: pieces that a transport took so far. They may still lie in a buffer of this machine.
    """

    head: InferRequest
    payload: bytes
    ends: Sequence[int]
    window_s: float
    min_tokens: int = 1
    rate_bytes_per_s: float | None = None
    taken: int = field(default=0, init=False)

    def opening(self, window_s: float | None = None) -> InferProgressiveRequest:
        """The first message; a shorter window where less time is left."""
        self.taken = 0
        window_s = self.window_s if window_s is None else window_s
        head = InferProgressiveHead(
            request=self.head, window_s=window_s, min_tokens=self.min_tokens
        )
        return InferProgressiveRequest(head=head)

    def take(self, index: int) -> InferProgressiveRequest:
        """The message of one piece, which counts as taken from now on."""
        self.taken = index + 1
        start = self.ends[index - 1] if index else 0
        return InferProgressiveRequest(piece=self.payload[start : self.ends[index]])

    def release_s(self, index: int) -> float:
        """When a piece may be handed out at the earliest, in seconds after the head."""
        if self.rate_bytes_per_s is None or index < BURST_PIECES:
            return 0.0
        ahead = self.ends[index - 1] - self.ends[BURST_PIECES - 1]
        return ahead / self.rate_bytes_per_s

    def costs(self) -> list[int]:
        """Bytes of DATA frames up to the end of each piece, the head included."""
        head = codec.progressive_head_bytes(
            self.head.ByteSize(), window_s=self.window_s, min_tokens=self.min_tokens
        )
        return codec.progressive_wire_bytes(head, list(self.ends))

    def prefix(self, pieces: int) -> InferRequest:
        """What a server makes of the first pieces: the request with so much of its payload."""
        arrived = InferRequest()
        arrived.CopyFrom(self.head)
        arrived.payload = self.payload[: self.ends[pieces - 1]] if pieces else b""
        return arrived

    @property
    def taken_tokens(self) -> int:
        """Tokens that a transport took."""
        if not self.taken:
            return 0
        header = codec.read_header(self.payload)
        towers = len(header.tower_dims)
        return codec.prefix_tokens(
            self.taken_bytes, header.token_dim, header.quantization, num_towers=towers
        )

    @property
    def taken_bytes(self) -> int:
        """Bytes of the payload that a transport took."""
        return self.ends[self.taken - 1] if self.taken else 0

    @property
    def taken_wire_bytes(self) -> int:
        """Bytes of DATA frames of the messages that a transport took."""
        return self.costs()[self.taken - 1] if self.taken else 0


def periods_of(window_s: float, period_s: float, reserve_s: float) -> int:
    """Control periods that a window of so many seconds spans; its last one has the reserve."""
    return max(1, math.ceil((window_s + reserve_s) / period_s - 1e-6))


def paced(
    stream: PayloadStream,
    window_s: float,
    stopped: threading.Event,
    clock: Callable[[], float] = time.monotonic,
) -> Iterator[InferProgressiveRequest]:
    """The messages of a stream, each when its time has come, until the window ends.

    Args:
        stream: the payload.
        window_s: seconds from now in which pieces are handed out.
        stopped: ends it at once.
        clock: monotonic seconds.
    """
    ends = clock() + window_s
    yield stream.opening(window_s)
    for index in range(len(stream.ends)):
        pause_s = _pause_s(stream, index, ends - clock(), window_s)
        if pause_s is None or stopped.wait(pause_s):
            return
        yield stream.take(index)


async def paced_async(
    stream: PayloadStream, window_s: float, clock: Callable[[], float] = time.monotonic
) -> AsyncIterator[InferProgressiveRequest]:
    """:func:`paced` on an event loop."""
    ends = clock() + window_s
    yield stream.opening(window_s)
    for index in range(len(stream.ends)):
        pause_s = _pause_s(stream, index, ends - clock(), window_s)
        if pause_s is None:
            return
        if pause_s > 0.0:
            await asyncio.sleep(pause_s)
        yield stream.take(index)


def _pause_s(stream: PayloadStream, index: int, left_s: float, window_s: float) -> float | None:
    """Seconds to wait before a piece; None where the window ends before."""
    release_s = stream.release_s(index)
    if left_s <= 0.0 or release_s >= window_s:
        return None
    return max(0.0, release_s - (window_s - left_s))
