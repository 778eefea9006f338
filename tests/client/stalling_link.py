"""A TCP proxy whose uplink stops after so many bytes, until it is told to go on."""

from __future__ import annotations

import contextlib
import socket
import threading
from types import TracebackType


class StallingLink:
    """Stands before a server on localhost. The downlink always works.

    Attributes:
        carried: bytes that went up so far.
    """

    def __init__(self, server_port: int) -> None:
        self._server_port = server_port
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._ends: list[socket.socket] = []
        self._room: float = float("inf")
        self._changed = threading.Condition()
        self._closed = False
        self.carried = 0
        self._threads: list[threading.Thread] = []
        self._start(self._accept)

    @property
    def target(self) -> str:
        return f"127.0.0.1:{self._listener.getsockname()[1]}"

    def stall_after(self, room: int) -> None:
        """Lets so many bytes more go up, then none."""
        with self._changed:
            self._room = room

    def go_on(self) -> None:
        """No limit any more."""
        with self._changed:
            self._room = float("inf")
            self._changed.notify_all()

    def _start(self, function: object, *args: object) -> None:
        thread = threading.Thread(target=function, args=args, daemon=True)  # type: ignore[arg-type]
        self._threads.append(thread)
        thread.start()

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
                server = socket.create_connection(("127.0.0.1", self._server_port))
            except OSError:
                return
            self._ends += [client, server]
            self._start(self._up, client, server)
            self._start(self._down, server, client)

    def _up(self, source: socket.socket, sink: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while chunk := source.recv(1 << 16):
                while chunk:
                    with self._changed:
                        self._changed.wait_for(lambda: self._room > 0 or self._closed)
                        if self._closed:
                            return
                        passing = chunk[: int(min(self._room, len(chunk)))]
                        self._room -= len(passing)
                        self.carried += len(passing)
                    sink.sendall(passing)
                    chunk = chunk[len(passing) :]
            sink.shutdown(socket.SHUT_WR)

    def _down(self, source: socket.socket, sink: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while chunk := source.recv(1 << 16):
                sink.sendall(chunk)
            sink.shutdown(socket.SHUT_WR)

    def __enter__(self) -> StallingLink:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        for end in (self._listener, *self._ends):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()
        for thread in self._threads:
            thread.join(timeout=5)
