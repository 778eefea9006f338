"""One payload on its way in pieces: what a progressive transport is handed, and what it took."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from comvla import codec
from comvla.v1.policy_pb2 import InferProgressiveHead, InferProgressiveRequest, InferRequest


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
        taken: pieces that a transport took so far. They may still lie in a buffer of this machine.
    """

    head: InferRequest
    payload: bytes
    ends: Sequence[int]
    window_s: float
    min_tokens: int = 1
    taken: int = field(default=0, init=False)

    def opening(self) -> InferProgressiveRequest:
        """The first message."""
        head = InferProgressiveHead(
            request=self.head, window_s=self.window_s, min_tokens=self.min_tokens
        )
        return InferProgressiveRequest(head=head)

    def pieces(self) -> Iterator[InferProgressiveRequest]:
        """All further messages, from the first piece on; a piece is taken when the next is asked."""
        self.taken, start = 0, 0
        for end in self.ends:
            self.taken += 1
            yield InferProgressiveRequest(piece=self.payload[start:end])
            start = end

    def costs(self) -> list[int]:
        """Bytes of DATA frames up to the end of each piece, the head included."""
        return codec.progressive_wire_bytes(self.opening().ByteSize(), list(self.ends))

    def prefix(self, pieces: int) -> InferRequest:
        """What a server makes of the first pieces: the request with so much of its payload."""
        arrived = InferRequest()
        arrived.CopyFrom(self.head)
        arrived.payload = self.payload[: self.ends[pieces - 1]] if pieces else b""
        return arrived

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
