"""A TCP proxy on localhost that can stop forwarding, as a radio that vanished: nobody is told."""

from __future__ import annotations

import contextlib
import socket
import threading
from types import TracebackType


class FrozenProxy:
    """Forwards to ``port``; after :meth:`freeze` the connections of that moment stay silent for ever.

    New ones are forwarded after :meth:`thaw`, and accepted but silent before.

    Attributes:
        accepted: connections so far.
    """

    def __init__(self, port: int) -> None:
        self._port = port
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._frozen: set[int] = set()
        self._freezing = False
        self._ends: list[socket.socket] = []
        self._lock = threading.Lock()
        self.accepted = 0
        threading.Thread(target=self._accept, daemon=True).start()

    @property
    def target(self) -> str:
        return f"127.0.0.1:{self._listener.getsockname()[1]}"

    def freeze(self) -> None:
        with self._lock:
            self._freezing = True
            self._frozen.update(range(self.accepted))

    def thaw(self) -> None:
        with self._lock:
            self._freezing = False

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
                server = socket.create_connection(("127.0.0.1", self._port))
            except OSError:
                return
            with self._lock:
                number = self.accepted
                self.accepted += 1
                self._ends += [client, server]
                if self._freezing:
                    self._frozen.add(number)
            for source, sink in ((client, server), (server, client)):
                threading.Thread(
                    target=self._forward, args=(number, source, sink), daemon=True
                ).start()

    def _forward(self, number: int, source: socket.socket, sink: socket.socket) -> None:
        try:
            while chunk := source.recv(1 << 16):
                if number not in self._frozen:
                    sink.sendall(chunk)
            if number not in self._frozen:
                sink.shutdown(socket.SHUT_WR)
        except OSError:
            return

    def __enter__(self) -> FrozenProxy:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for end in (self._listener, *self._ends):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()
