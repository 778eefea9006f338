"""Keepalive on the wire: raw HTTP/2 pings, as a gRPC client sends them."""

from __future__ import annotations

import socket
import struct
import time

from server_stubs import PATIENCE_S, StubCloud

from comvla_client.channel import CHANNEL_OPTIONS
from comvla_server.background import BackgroundServer
from comvla_server.engine import Engine
from comvla_server.grpc_adapter import server_options
from comvla_server.settings import ServerSettings

PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"
SETTINGS, PING, GOAWAY = 4, 6, 7
ACK = 1


def frame(kind: int, flags: int, body: bytes) -> bytes:
    return struct.pack(">I", len(body))[1:] + struct.pack(">BBI", kind, flags, 0) + body


class Http2:
    """As much of a client as pings need."""

    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S)
        self._stream = self._socket.makefile("rb")
        self._socket.sendall(PREFACE + frame(SETTINGS, 0, b""))

    def ping(self, number: int) -> bytes | None:
        """None when the ping was answered, else the debug text with which the server hung up."""
        self._socket.sendall(frame(PING, 0, number.to_bytes(8, "big")))
        while True:
            kind, flags, body = self._read()
            if kind == GOAWAY:
                return body[8:]
            if kind == SETTINGS and not flags & ACK:
                self._socket.sendall(frame(SETTINGS, ACK, b""))
            if kind == PING and flags & ACK and body == number.to_bytes(8, "big"):
                return None

    def close(self) -> None:
        self._stream.close()
        self._socket.close()

    def _read(self) -> tuple[int, int, bytes]:
        head = self._stream.read(9)
        assert len(head) == 9, "the server closed the connection without a word"
        length = int.from_bytes(head[:3], "big")
        return head[3], head[4], self._stream.read(length)


def goodbye_after(pings: int, pause_s: float, settings: ServerSettings) -> bytes | None:
    """What the server says when it hangs up on a client without calls, None when it does not."""
    with BackgroundServer(Engine(StubCloud()), settings) as server:
        client = Http2(server.server.port)
        try:
            for number in range(pings):
                goodbye = client.ping(number)
                if goodbye is not None:
                    return goodbye
                time.sleep(pause_s)  # the interval between two pings is what this test is about
        finally:
            client.close()
    return None


def test_pings_at_the_agreed_pace_are_answered_without_any_call() -> None:
    """The agreement, a hundred times faster: clients ping at twice the shortest interval."""
    settings = ServerSettings(min_ping_interval_s=0.05)
    assert goodbye_after(pings=6, pause_s=0.1, settings=settings) is None


def test_a_flood_of_pings_ends_the_connection() -> None:
    assert goodbye_after(pings=20, pause_s=0.0, settings=ServerSettings()) == b"too_many_pings"


def test_clients_ping_at_half_the_pace_at_which_the_server_hangs_up() -> None:
    server = dict(server_options(ServerSettings()))
    client = dict(CHANNEL_OPTIONS)
    shortest_ms = server["grpc.http2.min_ping_interval_without_data_ms"]
    assert client["grpc.keepalive_time_ms"] >= 2 * shortest_ms
    assert client["grpc.keepalive_permit_without_calls"] == 1
    assert server["grpc.keepalive_permit_without_calls"] == 1
