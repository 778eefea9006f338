"""The limit of any transport over TCP: a length, the bytes, an answer of fixed size."""

from __future__ import annotations

import socket
import struct
import threading
from multiprocessing.connection import Connection

from comvla_sim.bench.processes import announce, wait_for_end

_LENGTH = struct.Struct("<I")


def serve(lifeline: Connection, response_bytes: int) -> None:
    """Answers every length-prefixed message with ``response_bytes`` bytes."""
    listener = socket.create_server(("127.0.0.1", 0))
    threading.Thread(target=_accept, args=(listener, bytes(response_bytes)), daemon=True).start()
    announce(lifeline, str(listener.getsockname()[1]))
    wait_for_end(lifeline)
    listener.close()


def _accept(listener: socket.socket, response: bytes) -> None:
    while True:
        try:
            connection, _ = listener.accept()
        except OSError:  # closed: the benchmark is over
            return
        threading.Thread(target=_answer, args=(connection, response), daemon=True).start()


def _answer(connection: socket.socket, response: bytes) -> None:
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    with connection:
        while header := _receive(connection, _LENGTH.size):
            _receive(connection, _LENGTH.unpack(header)[0])
            connection.sendall(response)


def _receive(connection: socket.socket, size: int) -> bytes:
    """Exactly ``size`` bytes, or none at the end of the stream."""
    buffer = bytearray(size)
    view = memoryview(buffer)
    while view:
        received = connection.recv_into(view)
        if not received:
            return b""
        view = view[received:]
    return bytes(buffer)


class TcpCaller:
    """One robot's connection."""

    def __init__(self, port: int, payload: bytes, response_bytes: int) -> None:
        self._message = _LENGTH.pack(len(payload)) + payload
        self._response_bytes = response_bytes
        self._connection = socket.create_connection(("127.0.0.1", port), timeout=30.0)
        self._connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def call(self) -> int:
        """Sends the payload and returns the size of the answer in bytes."""
        self._connection.sendall(self._message)
        return len(_receive(self._connection, self._response_bytes))

    def close(self) -> None:
        """Ends the connection."""
        self._connection.close()
