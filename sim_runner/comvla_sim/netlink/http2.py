"""Reads the calls of a robot off its TCP stream: when each began, ended, and how much of it passed.

Works on gRPC without encryption (RFC 9113). The first bytes of a request tell session and step, so
that what a capture saw and what a client reports can be laid side by side.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

_PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"
_FRAME_HEADER_BYTES = 9
_DATA, _HEADERS, _RST_STREAM, _WINDOW_UPDATE = 0x0, 0x1, 0x3, 0x8
_END_STREAM = 0x1
_PEEK_BYTES = 300
_GRPC_PREFIX_BYTES = 5


@dataclass
class Call:
    """One call, as it passed the wire.

    Attributes:
        stream: HTTP/2's number of it.
        first_s: when its first byte passed.
        last_s: when its latest byte passed.
        data_bytes: bytes of its DATA frames, their headers included.
        complete_s: when its last byte passed; None where it never did.
        reset: the robot gave it up.
        session: of the request; empty until so much of it has passed.
        step: of the request; None until so much of it has passed.
    """

    stream: int
    first_s: float
    last_s: float
    data_bytes: int = 0
    complete_s: float | None = None
    reset: bool = False
    session: str = ""
    step: int | None = None


class CallReader:
    """Splits what one side of a connection sent into calls.

    Args:
        on_call: told of each new call; the object goes on changing as more of it passes.

    Attributes:
        other_bytes: bytes of frames that belong to no call (settings, pings, window updates), by
            HTTP/2's number of the kind.
    """

    def __init__(self, on_call: Callable[[Call], None]) -> None:
        self._on_call = on_call
        self.other_bytes: Counter[int] = Counter()
        self._calls: dict[int, Call] = {}
        self._peeked: dict[int, bytearray] = {}
        self._head = bytearray()
        self._started = False
        self._left = 0
        self._frame: tuple[int, int, int] = (0, 0, 0)

    def feed(self, data: bytes, now_s: float) -> None:
        """Takes the next bytes of the stream, which passed at ``now_s``."""
        at = 0
        while at < len(data):
            if self._left:
                at = self._inside(data, at, now_s)
                continue
            wanted = _FRAME_HEADER_BYTES if self._started else len(_PREFACE)
            taken = data[at : at + wanted - len(self._head)]
            self._head += taken
            at += len(taken)
            if len(self._head) < wanted:
                return
            if not self._started:
                self._started = True
                if bytes(self._head) == _PREFACE:
                    self._head.clear()
                    continue
            self._begin_frame(now_s)

    def _begin_frame(self, now_s: float) -> None:
        head = bytes(self._head[:_FRAME_HEADER_BYTES])
        del self._head[:_FRAME_HEADER_BYTES]
        length, kind, flags = int.from_bytes(head[:3], "big"), head[3], head[4]
        stream = int.from_bytes(head[5:9], "big") & 0x7FFF_FFFF
        self._frame, self._left = (kind, flags, stream), length
        if not stream or kind == _WINDOW_UPDATE:
            self.other_bytes[kind] += _FRAME_HEADER_BYTES + length
        if kind == _HEADERS and stream not in self._calls:
            call = self._calls[stream] = Call(stream, now_s, now_s)
            self._peeked[stream] = bytearray()
            self._on_call(call)
        if kind == _DATA and stream in self._calls:
            self._calls[stream].data_bytes += _FRAME_HEADER_BYTES
        if not length:
            self._end_frame(now_s)

    def _inside(self, data: bytes, at: int, now_s: float) -> int:
        part = min(self._left, len(data) - at)
        kind, _, stream = self._frame
        call = self._calls.get(stream)
        if call is not None:
            call.last_s = now_s
            if kind == _DATA:
                call.data_bytes += part
                self._peek(call, data[at : at + part])
        self._left -= part
        if not self._left:
            self._end_frame(now_s)
        return at + part

    def _end_frame(self, now_s: float) -> None:
        kind, flags, stream = self._frame
        call = self._calls.get(stream)
        if call is None:
            return
        if kind == _RST_STREAM:
            call.reset = True
        if (kind in (_DATA, _HEADERS) and flags & _END_STREAM) or kind == _RST_STREAM:
            if kind != _RST_STREAM:
                call.complete_s = now_s
            del self._calls[stream]
            self._peeked.pop(stream, None)

    def _peek(self, call: Call, data: bytes) -> None:
        seen = self._peeked.get(call.stream)
        if seen is None or call.step is not None or len(seen) >= _PEEK_BYTES:
            return
        seen += data[: _PEEK_BYTES - len(seen)]
        found = session_and_step(bytes(seen[_GRPC_PREFIX_BYTES:]))
        if found is not None:
            call.session, call.step = found


def session_and_step(message: bytes) -> tuple[str, int] | None:
    """Session and step at the beginning of an ``InferRequest``, or of a message that begins with one.

    Returns:
        None where the bytes are too few or begin otherwise.
    """
    for _ in range(3):  # InferProgressiveRequest(head=InferProgressiveHead(request=InferRequest))
        if len(message) < 3 or message[0] != 0x0A:
            return None
        length, at = _varint(message, 1)
        field = message[at : at + length]
        text = field.decode("ascii", "ignore")
        if len(text) == length and text.isprintable():
            rest = message[at + length :]
            if not rest:
                return None
            if rest[0] != 0x10:
                return text, 0
            step, end = _varint(rest, 1)
            whole = end > 1 and not rest[end - 1] & 0x80
            return (text, step) if whole else None
        message = field
    return None


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while at < len(data):
        value |= (data[at] & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if not data[at - 1] & 0x80:
            break
    return value, at
