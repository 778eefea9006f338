"""What strangers can hold on to, and for how long: handshakes, requests, headers, connections."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import socket
import ssl
import struct
import threading
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import grpc
import httpx
import pytest
from authorities import Authority
from server_stubs import PATIENCE_S, Robot, StubCloud, eventually, message, refusal_of

from comvla_server import admin_http
from comvla_server.background import BackgroundServer
from comvla_server.engine import Engine
from comvla_server.grpc_adapter import SERVICE_NAME
from comvla_server.grpc_port import start_watched
from comvla_server.identity import Identity
from comvla_server.settings import ServerSettings
from comvla_server.tokens import TokenLine, new_token

PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"
DATA, HEADERS, RST_STREAM, SETTINGS, PING, GOAWAY = 0, 1, 3, 4, 6, 7
END_STREAM, END_HEADERS, ACK = 1, 4, 1
INFER = f"/{SERVICE_NAME}/Infer"


def frame(kind: int, flags: int, stream: int, body: bytes) -> bytes:
    return struct.pack(">I", len(body))[1:] + struct.pack(">BBI", kind, flags, stream) + body


def header(name: str, value: str) -> bytes:
    """One header, in HPACK's simplest form."""
    assert max(len(name), len(value)) < 127
    return bytes([0, len(name)]) + name.encode() + bytes([len(value)]) + value.encode()


class RawRobot:
    """HTTP/2 by hand: begins a call, and sends of it as much as a test wants."""

    def __init__(self, port: int, token: str | None = None) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S)
        self._stream = self._socket.makefile("rb")
        headers = {
            ":method": "POST",
            ":scheme": "http",
            ":path": INFER,
            ":authority": "localhost",
            "te": "trailers",
            "content-type": "application/grpc",
        }
        if token is not None:
            headers["authorization"] = f"Bearer {token}"
        block = b"".join(header(name, value) for name, value in headers.items())
        self._socket.sendall(
            PREFACE + frame(SETTINGS, 0, 0, b"") + frame(HEADERS, END_HEADERS, 1, block)
        )

    def send(self, body: bytes) -> None:
        self._socket.sendall(frame(DATA, 0, 1, body))

    def end_of_call(self) -> bytes:
        """Waits until the server ends the call; the headers with which it does."""
        while True:
            head = self._stream.read(9)
            assert len(head) == 9, "the server closed the connection"
            body = self._stream.read(int.from_bytes(head[:3], "big"))
            kind, flags = head[3], head[4]
            assert kind != GOAWAY, body
            if kind == SETTINGS and not flags & ACK:
                self._socket.sendall(frame(SETTINGS, ACK, 0, b""))
            if kind == HEADERS and flags & END_STREAM:
                return body

    def close(self) -> None:
        self._stream.close()
        self._socket.close()


@pytest.fixture
def token() -> str:
    return new_token()


@pytest.fixture
def tokens(tmp_path: Path, token: str) -> Path:
    path = tmp_path / "tokens"
    path.touch(mode=0o600)
    path.write_text(str(TokenLine.of(Identity("arm-7"), token)))
    return path


@pytest.fixture
def tls_files(tmp_path: Path) -> dict[str, Path]:
    certificate, key = Authority().issue("server").write(tmp_path, "server")
    return {"tls_certificate": certificate, "tls_key": key}


@pytest.fixture
def served(cloud: StubCloud) -> Iterator[BackgroundServer]:
    """A server that is quickly out of patience with requests, and with nothing else."""
    settings = ServerSettings(request_timeout_s=0.3)
    with BackgroundServer(Engine(cloud), settings) as running:
        cloud.forget()
        yield running


def hangs_up(connection: socket.socket) -> bool:
    """Waits until the other side closes."""
    connection.settimeout(PATIENCE_S)
    try:
        while connection.recv(4096):
            pass
    except ConnectionResetError:
        pass
    return True


@pytest.mark.parametrize("words", [b"", PREFACE[:10], PREFACE])
def test_a_half_open_http2_handshake_is_ended(cloud: StubCloud, words: bytes) -> None:
    with (
        BackgroundServer(Engine(cloud), ServerSettings(handshake_timeout_s=0.3)) as server,
        socket.create_connection(("127.0.0.1", server.server.port)) as slow,
    ):
        slow.sendall(words)
        assert hangs_up(slow)


@pytest.mark.parametrize("port", ["port", "admin_port"])
@pytest.mark.parametrize("words", [b"", b"\x16\x03\x01\x02\x00\x01"])
def test_a_half_open_tls_handshake_is_ended(
    cloud: StubCloud, tls_files: dict[str, Path], port: str, words: bytes
) -> None:
    settings = ServerSettings(**tls_files, handshake_timeout_s=0.3)
    with (
        BackgroundServer(Engine(cloud), settings) as server,
        socket.create_connection(("127.0.0.1", getattr(server.server, port))) as slow,
    ):
        slow.sendall(words)
        assert hangs_up(slow)


@pytest.mark.parametrize("sent", [b"", b"\0\0\0\1\0" + b"\x0a" * 5])
def test_a_request_that_trickles_is_ended(served: BackgroundServer, sent: bytes) -> None:
    robot = RawRobot(served.server.port)
    try:
        robot.send(sent)
        robot.end_of_call()
    finally:
        robot.close()
    registry = served.server.metrics.registry
    assert registry.get_sample_value("comvla_calls_refused_total", {"reason": "slow"}) == 1


def test_a_request_that_never_comes_is_deadline_exceeded(served: BackgroundServer) -> None:
    never = threading.Event()

    def requests() -> Iterator[bytes]:
        never.wait(PATIENCE_S)
        yield b""

    with Robot(served.target) as robot:
        call = robot.channel.stream_unary(INFER).future(requests())  # and without a deadline
        code, words = refusal_of(call)
        never.set()
    assert code is grpc.StatusCode.DEADLINE_EXCEEDED
    assert "the whole request within 0.3 s" in words
    assert "--request-timeout-s" in words


def test_without_a_token_not_a_byte_of_the_request_is_waited_for(
    cloud: StubCloud, tokens: Path
) -> None:
    # With this patience the test would run into its own time limit if the server waited.
    settings = ServerSettings(tokens_file=tokens, request_timeout_s=10_000)
    with BackgroundServer(Engine(cloud), settings) as server:
        robot = RawRobot(server.server.port)
        try:
            robot.send(b"\0\0\x10\0\0")
            robot.end_of_call()
        finally:
            robot.close()
        registry = server.server.metrics.registry
        labels = {"reason": "no_identity"}
        assert registry.get_sample_value("comvla_calls_refused_total", labels) == 1


def test_a_thousand_idle_connections_are_bounded_and_robots_are_served(cloud: StubCloud) -> None:
    settings = ServerSettings(max_connections=100, handshake_timeout_s=2.0)
    idle: list[socket.socket] = []
    with BackgroundServer(Engine(cloud), settings) as server, Robot(server.target) as robot:
        assert robot.infer(message(step=0))
        try:
            for _ in range(1000):
                idle.append(socket.create_connection(("127.0.0.1", server.server.port), PATIENCE_S))
            assert robot.infer(message(step=1)), "a robot that is connected is served on"
            # Beyond the limit they are closed at once, below it when no handshake has come.
            assert all(hangs_up(connection) for connection in idle)
            with Robot(server.target) as late:
                # This side sees them closed before the server has counted them off.
                eventually(lambda: late.send(message("late")).exception(PATIENCE_S) is None)
        finally:
            for connection in idle:
                connection.close()


def test_one_connection_too_many_is_closed_at_once(cloud: StubCloud) -> None:
    # With this patience for handshakes, only the limit can close the third connection.
    settings = ServerSettings(max_connections=2, handshake_timeout_s=10_000)
    with BackgroundServer(Engine(cloud), settings) as server:
        first, second = (
            socket.create_connection(("127.0.0.1", server.server.port)) for _ in range(2)
        )
        with socket.create_connection(("127.0.0.1", server.server.port)) as third:
            assert hangs_up(third)
        first.close()
        with Robot(server.target) as robot:
            eventually(lambda: robot.send(message()).exception(PATIENCE_S) is None)
        second.close()


def test_connections_without_calls_are_closed_and_robots_come_back(cloud: StubCloud) -> None:
    settings = ServerSettings(connection_idle_s=1.0)
    with BackgroundServer(Engine(cloud), settings) as server, Robot(server.target) as robot:
        states: list[grpc.ChannelConnectivity] = []
        gone = threading.Event()

        def watch(state: grpc.ChannelConnectivity) -> None:
            states.append(state)
            if grpc.ChannelConnectivity.READY in states and state is grpc.ChannelConnectivity.IDLE:
                gone.set()

        robot.channel.subscribe(watch)
        assert robot.infer(message(step=0))
        assert gone.wait(PATIENCE_S)
        assert robot.infer(message(step=1))


def test_old_connections_are_renewed_without_a_failed_call(cloud: StubCloud) -> None:
    settings = ServerSettings(connection_age_s=0.2)
    with BackgroundServer(Engine(cloud), settings) as server, Robot(server.target) as robot:
        states: list[grpc.ChannelConnectivity] = []
        robot.channel.subscribe(states.append)
        steps = itertools.count()

        def renewed() -> bool:
            assert robot.infer(message(step=next(steps)))
            return states.count(grpc.ChannelConnectivity.READY) > 2

        eventually(renewed)


def test_one_connection_cannot_hold_more_calls_than_its_share(cloud: StubCloud) -> None:
    settings = ServerSettings(max_calls_per_connection=2)
    with BackgroundServer(Engine(cloud), settings) as server:
        with Robot(server.target) as greedy, Robot(server.target, use_local_subchannel_pool=1) as b:
            assert greedy.infer(message())  # and with the answer it knows the server's limit
            cloud.forget()
            cloud.hold()
            calls = [greedy.send(message("s0", name=0.0))]
            cloud.wait_until_running()  # else two of them may share its pass
            calls += [greedy.send(message(f"s{i}", name=float(i))) for i in range(1, 20)]
            other = b.send(message("b", name=9.0))
            eventually(lambda: waiting_in(server) == 2)  # one of the greedy, one of the other
            cloud.release()
            assert other.exception(PATIENCE_S) is None
            ends = [call.exception(PATIENCE_S) for call in calls]
        # A stream that is opened as another ends may be refused, which is safe to try again.
        assert {end.code() for end in ends if end is not None} <= {grpc.StatusCode.UNAVAILABLE}
        assert max(len(batch) for batch in cloud.batches) <= 3


def waiting_in(server: BackgroundServer) -> float:
    return server.server.metrics.registry.get_sample_value("comvla_queue_depth") or 0.0


@pytest.mark.parametrize("count", [1, 100])
def test_a_flood_of_headers_is_refused(robot: Robot, count: int) -> None:
    flood = [(f"x-flood-{i}", "x" * (40_000 // count)) for i in range(count)]
    call = robot.stub.Infer.future(message(), timeout=PATIENCE_S, metadata=flood)
    assert refusal_of(call)[0] is grpc.StatusCode.RESOURCE_EXHAUSTED
    assert robot.infer(message()), "the robot's connection goes on"


def test_an_oversize_message_is_refused_unread(cloud: StubCloud) -> None:
    settings = ServerSettings(max_request_bytes=64 * 1024)
    with BackgroundServer(Engine(cloud), settings) as server, Robot(server.target) as robot:
        cloud.forget()
        for size, words in ((66_000, "a request of at most"), (10**7, "larger than max")):
            code, details = robot.refused(message(payload=bytes(size)))
            assert code is grpc.StatusCode.RESOURCE_EXHAUSTED
            assert words in details
        assert cloud.batches == []


@pytest.mark.parametrize(
    "words", [b"", b"GET /healthz HT", b"GET /healthz HTTP/1.1\r\nHost: x\r\n"]
)
def test_a_slow_request_to_the_admin_surface_is_ended(
    served: BackgroundServer, words: bytes
) -> None:
    with socket.create_connection(("127.0.0.1", served.server.admin_port)) as slow:
        slow.sendall(words)
        assert hangs_up(slow)
    # Whoever is slow by accident asks again.
    eventually(lambda: healthy(served))


def status_of(server: BackgroundServer, path: str) -> int:
    return httpx.get(f"{server.admin_url}/{path}", timeout=PATIENCE_S).status_code


def healthy(server: BackgroundServer) -> bool:
    try:
        return status_of(server, "healthz") == 200
    except httpx.TransportError:
        return False


def test_connections_to_the_admin_surface_are_bounded(
    cloud: StubCloud, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(admin_http, "MOST_CONNECTIONS", 5)
    settings = ServerSettings(request_timeout_s=10_000)
    with BackgroundServer(Engine(cloud), settings) as server:
        address = ("127.0.0.1", server.server.admin_port)
        held = [socket.create_connection(address) for _ in range(5)]
        with socket.create_connection(address) as excess:
            assert hangs_up(excess)
        for connection in held:
            connection.close()
        eventually(lambda: healthy(server))


def test_old_tls_is_refused(cloud: StubCloud, tls_files: dict[str, Path]) -> None:
    with BackgroundServer(Engine(cloud), ServerSettings(**tls_files)) as server:
        for port in (server.server.port, server.server.admin_port):
            context = ssl.create_default_context()
            context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
            context.set_ciphers("DEFAULT@SECLEVEL=0")
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DeprecationWarning)
                context.minimum_version = ssl.TLSVersion.TLSv1
                context.maximum_version = ssl.TLSVersion.TLSv1_1
            with (
                socket.create_connection(("127.0.0.1", port)) as plain,
                pytest.raises((ssl.SSLError, ConnectionResetError)),
            ):
                context.wrap_socket(plain)


# Outside what pyproject.toml asks for, from here on; see SECURITY.md.
LOOP_ENDS = tuple(map(int, grpc.__version__.split(".")[:2])) >= (1, 84)


@contextlib.contextmanager
def path_that_is_no_text(port: int) -> Iterator[socket.socket]:
    """A stranger's connection that has asked for a path which is no UTF-8."""
    names = (":method", "POST"), (":scheme", "http"), ("te", "trailers"), (":authority", "x")
    block = b"".join(itertools.starmap(header, names)) + b"\x00\x05:path\x03/a\xf4"
    with socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S) as stranger:
        stranger.sendall(PREFACE + frame(SETTINGS, 0, 0, b""))
        stranger.sendall(frame(HEADERS, END_HEADERS | END_STREAM, 1, block))
        yield stranger


@pytest.mark.skipif(LOOP_ENDS, reason="this grpcio is later than those the project asks for")
def test_a_path_that_is_no_text_is_refused_and_nothing_else(server: BackgroundServer) -> None:
    with Robot(server.target) as robot:
        for _ in range(3):
            with path_that_is_no_text(server.server.port) as stranger:
                answer = b""
                while b"grpc-status" not in answer:
                    part = stranger.recv(4096)
                    assert part, f"closed after {answer!r}"
                    answer += part
            robot.infer(message())
    assert healthy(server)


@pytest.mark.skipif(not LOOP_ENDS, reason="nothing is known that ends the loop of this grpcio")
def test_a_server_whose_port_a_stranger_closed_asks_to_be_restarted(
    server: BackgroundServer,
) -> None:
    with path_that_is_no_text(server.server.port):
        eventually(lambda: status_of(server, "healthz") == 503)
    assert status_of(server, "readyz") == 503
    assert server.server.port_lost.is_set()
    assert isinstance(server.server.port_lost_by, UnicodeDecodeError)


def test_whatever_ends_the_loop_of_grpc_is_told() -> None:
    told: list[BaseException] = []
    error = RuntimeError("no more calls")

    class Ending:
        """Leaves a task behind, as grpc.aio does."""

        async def start(self) -> None:
            self.loop = asyncio.create_task(self.take_calls())

        async def take_calls(self) -> None:
            await asyncio.sleep(0)
            raise error

    async def watch() -> None:
        server: Any = Ending()
        await start_watched(server, told.append)
        await asyncio.wait([server.loop])
        await asyncio.sleep(0)

    asyncio.run(watch())
    assert told == [error]
