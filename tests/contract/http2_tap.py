"""A TCP proxy between a gRPC client and server that keeps every byte of both directions.

What a socket carried is read off the socket itself, not off gRPC's own statistics: the proxy
forwards the bytes and splits them into HTTP/2 frames (RFC 9113, section 4.1).
"""

from __future__ import annotations

import contextlib
import socket
import threading
from collections import defaultdict
from dataclasses import dataclass
from types import TracebackType

DATA, HEADERS, WINDOW_UPDATE = 0x0, 0x1, 0x8

_PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"
_FRAME_HEADER_BYTES = 9


@dataclass(frozen=True)
class Frame:
    """One HTTP/2 frame: its type, its stream, and its size on the wire with its own header."""

    kind: int
    stream: int
    wire_bytes: int


def split_frames(captured: bytes) -> list[Frame]:
    """The whole frames of what one side sent; one still on its way is left out."""
    at = len(_PREFACE) if captured.startswith(_PREFACE) else 0
    frames = []
    while at + _FRAME_HEADER_BYTES <= len(captured):
        size = _FRAME_HEADER_BYTES + int.from_bytes(captured[at : at + 3], "big")
        if at + size > len(captured):
            break
        stream = int.from_bytes(captured[at + 5 : at + 9], "big") & 0x7FFF_FFFF
        frames.append(Frame(captured[at + 3], stream, size))
        at += size
    return frames


class Tap:
    """Listens on a free port of localhost and forwards one connection to ``server_port``."""

    def __init__(self, server_port: int) -> None:
        self._server_port = server_port
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._ends: list[socket.socket] = []
        self._captured = {"up": bytearray(), "down": bytearray()}
        self._threads = [threading.Thread(target=self._accept, daemon=True)]
        self._threads[0].start()

    @property
    def target(self) -> str:
        return f"127.0.0.1:{self._listener.getsockname()[1]}"

    def calls(self, direction: str) -> list[list[Frame]]:
        """Frames sent ``"up"`` or ``"down"`` so far, for each call in the order made.

        A byte is kept before it is forwarded, so that a call that was answered is here in full.
        """
        by_stream: dict[int, list[Frame]] = defaultdict(list)
        for frame in split_frames(bytes(self._captured[direction])):
            if frame.stream:
                by_stream[frame.stream].append(frame)
        return [by_stream[stream] for stream in sorted(by_stream)]

    def _accept(self) -> None:
        try:
            client, _ = self._listener.accept()
            server = socket.create_connection(("127.0.0.1", self._server_port))
        except OSError:
            return  # closed before anyone called
        self._ends += [client, server]
        for source, sink, direction in ((client, server, "up"), (server, client, "down")):
            ends = (source, sink, self._captured[direction])
            thread = threading.Thread(target=self._forward, args=ends, daemon=True)
            self._threads.append(thread)
            thread.start()

    @staticmethod
    def _forward(source: socket.socket, sink: socket.socket, captured: bytearray) -> None:
        try:
            while chunk := source.recv(1 << 16):
                captured += chunk
                sink.sendall(chunk)
            sink.shutdown(socket.SHUT_WR)
        except OSError:
            return  # the other end closed first

    def __enter__(self) -> Tap:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for end in (self._listener, *self._ends):
            with contextlib.suppress(OSError):  # already closed by its peer
                end.shutdown(socket.SHUT_RDWR)  # wakes the thread that waits on it
            end.close()
        for thread in list(self._threads):
            thread.join(timeout=5)
