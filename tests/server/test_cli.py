"""``comvla-server`` as a process: what an operator sees."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import grpc
import httpx
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc
from server_stubs import PATIENCE_S, Robot, StubCloud, eventually, message

from comvla_server import cli, serve_command
from comvla_server.engine import Engine
from comvla_server.server import Server
from comvla_vla import random_policy, save_policy
from comvla_vla.random import unit_statistics

HERE = Path(__file__).parent
FREE_PORTS = ("--port", "0", "--admin-port", "0")
# A drain that waits for the test.
PATIENT = (*FREE_PORTS, "--grace-s", str(PATIENCE_S))
SERVING = health_pb2.HealthCheckResponse.SERVING
NOT_SERVING = health_pb2.HealthCheckResponse.NOT_SERVING
READY = re.compile(r"comvla-server ready grpc=(\S+) admin=(http://\S+) model=(\S+)\n")


@contextlib.contextmanager
def process(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    """A Python process that does not outlive the block."""
    path = os.pathsep.join([str(HERE), *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"}
    with subprocess.Popen(
        [sys.executable, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    ) as running:
        try:
            yield running
        finally:
            running.kill()


def ready_line(running: subprocess.Popen[str]) -> tuple[str, str, str]:
    """gRPC target, admin URL and model of a server that says it is ready."""
    assert running.stdout is not None
    line = running.stdout.readline()
    found = READY.fullmatch(line)
    assert found, f"expected the ready line, got {line!r}; stderr: {running.communicate()[1]}"
    return found[1], found[2], found[3]


def end(running: subprocess.Popen[str]) -> tuple[int, str]:
    """Exit code and stderr of a process that is about to end."""
    _, stderr = running.communicate(timeout=PATIENCE_S)
    return running.returncode, stderr


def health_of(robot: Robot) -> int | None:
    """Serving status, None where nobody listens yet."""
    with contextlib.suppress(grpc.RpcError):
        stub = health_pb2_grpc.HealthStub(robot.channel)
        return int(stub.Check(health_pb2.HealthCheckRequest(), timeout=PATIENCE_S).status)
    return None


@contextlib.contextmanager
def model_at(gate: Path) -> Iterator[None]:
    """Holds the model at the gate, once it is there, while the block lasts."""

    def opened() -> int | None:
        try:
            return os.open(gate, os.O_WRONLY | os.O_NONBLOCK)
        except OSError:  # nobody reads yet
            return None

    descriptor = eventually(opened)
    try:
        yield
    finally:
        os.close(descriptor)


@pytest.fixture
def gate(tmp_path: Path) -> Path:
    """A named pipe at which the model of ``gated_server.py`` waits."""
    path = tmp_path / "gate"
    os.mkfifo(path)
    return path


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy with random weights on disk."""
    folder = tmp_path_factory.mktemp("policy")
    edge, cloud = random_policy(seed=0)
    save_policy(folder, edge.net, cloud.net, cloud.prompt.tokenizer, unit_statistics(cloud.config))
    return folder


def test_sigterm_completes_the_request_in_flight_and_exits_cleanly(gate: Path) -> None:
    with process(str(HERE / "gated_server.py"), str(gate), "serve", *PATIENT) as running:
        target, admin, model = ready_line(running)
        assert model == "stub"
        with Robot(target) as robot:
            call = robot.send(message("in-flight"))
            with model_at(gate):
                running.send_signal(signal.SIGTERM)
                health = health_pb2_grpc.HealthStub(robot.channel)
                asked = health_pb2.HealthCheckRequest()
                eventually(
                    lambda: health.Check(asked).status == health_pb2.HealthCheckResponse.NOT_SERVING
                )
                assert httpx.get(f"{admin}/readyz", timeout=PATIENCE_S).status_code == 503
                code, words = robot.refused(message("new"))
                assert code is grpc.StatusCode.UNAVAILABLE
                assert "draining" in words
                assert not call.done()
            assert call.result(timeout=PATIENCE_S).session_id == "in-flight"
        code, stderr = end(running)
    assert code == 0
    assert "Traceback" not in stderr


def test_a_second_signal_exits_at_once(gate: Path) -> None:
    with process(str(HERE / "gated_server.py"), str(gate), "serve", *PATIENT) as running:
        target, admin, _ = ready_line(running)
        with Robot(target) as robot:
            call = robot.send(message())
            with model_at(gate):
                running.send_signal(signal.SIGTERM)
                eventually(
                    lambda: httpx.get(f"{admin}/readyz", timeout=PATIENCE_S).status_code == 503
                )
                running.send_signal(signal.SIGTERM)
                code, _ = end(running)
            assert call.exception(PATIENCE_S).code() is grpc.StatusCode.UNAVAILABLE
    assert code == 128 + signal.SIGTERM


@contextlib.contextmanager
def serve_here(
    monkeypatch: pytest.MonkeyPatch,
    cloud: StubCloud,
    operator: Callable[[Robot], None],
    *arguments: str,
) -> Iterator[int]:
    """Runs ``serve`` in this process until ``operator`` has returned; the exit code, with the
    operator's robot still connected."""
    monkeypatch.setattr(serve_command, "load_engine", lambda *_: Engine(cloud))
    bound: Future[tuple[str, asyncio.AbstractEventLoop]] = Future()

    class Told(Server):
        async def bind(self) -> None:
            await super().bind()
            bound.set_result((self.target, asyncio.get_running_loop()))

    monkeypatch.setattr("comvla_server.server.Server", Told)

    def operate() -> None:
        target, loop = bound.result(PATIENCE_S)
        try:
            operator(held.enter_context(Robot(target)))
        finally:
            # From the loop that handles it: once that is gone, the signal would end the tests.
            loop.call_soon_threadsafe(os.kill, os.getpid(), signal.SIGTERM)

    with contextlib.ExitStack() as held:
        with ThreadPoolExecutor(1) as pool:
            operating = pool.submit(operate)
            try:
                code = cli.main(["serve", *FREE_PORTS, *arguments])
            finally:
                bound.cancel()  # where it never came to that
            operating.result()
        yield code


def test_calls_that_outlast_the_grace_are_an_exit_code(
    monkeypatch: pytest.MonkeyPatch, cloud: StubCloud, capsys: pytest.CaptureFixture[str]
) -> None:
    calls = []

    def operator(robot: Robot) -> None:
        eventually(lambda: health_of(robot) == SERVING)
        cloud.forget()
        cloud.hold()
        calls.append(robot.send(message()))
        cloud.wait_until_running()

    arguments = ("--grace-s", "0.05", "--log-format", "json")
    with serve_here(monkeypatch, cloud, operator, *arguments) as code:
        assert code == 1
        assert calls[0].exception(PATIENCE_S).code() is grpc.StatusCode.UNAVAILABLE
    events = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    assert any("cut off" in event["message"] for event in events)


def test_a_signal_while_the_model_loads_ends_the_process(
    monkeypatch: pytest.MonkeyPatch, cloud: StubCloud, capsys: pytest.CaptureFixture[str]
) -> None:
    cloud.hold()
    with serve_here(monkeypatch, cloud, lambda _: cloud.wait_until_running()) as code:
        assert code == 0
    stdout, stderr = capsys.readouterr()
    assert "ready" not in stdout
    assert "Traceback" not in stderr


def test_a_server_that_grpc_has_left_ends_with_code_1(
    monkeypatch: pytest.MonkeyPatch, cloud: StubCloud
) -> None:
    """Whoever watches over it, compose or Kubernetes, starts it again then."""
    servers: list[Server] = []
    loops: list[asyncio.AbstractEventLoop] = []

    class Remembered(Server):
        async def bind(self) -> None:
            servers.append(self)
            loops.append(asyncio.get_running_loop())
            await super().bind()

    monkeypatch.setattr("comvla_server.server.Server", Remembered)
    monkeypatch.setattr(serve_command, "load_engine", lambda *_: Engine(cloud))

    def lose() -> None:
        eventually(lambda: bool(servers) and servers[0].lifecycle.ready)
        loops[0].call_soon_threadsafe(servers[0]._lose_port, RuntimeError("no more calls"))

    with ThreadPoolExecutor(1) as pool:
        losing = pool.submit(lose)
        assert cli.main(["serve", *FREE_PORTS]) == 1
        losing.result()


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="there is no SIGHUP here")
def test_a_hangup_while_the_model_loads_looks_at_tokens_only(
    monkeypatch: pytest.MonkeyPatch, cloud: StubCloud, capsys: pytest.CaptureFixture[str]
) -> None:
    looked, lived = threading.Event(), signal.signal(signal.SIGHUP, signal.SIG_IGN)
    monkeypatch.setattr("comvla_server.access.Access.look", lambda _: looked.set())
    cloud.hold()

    def operator(robot: Robot) -> None:
        cloud.wait_until_running()
        os.kill(os.getpid(), signal.SIGHUP)
        assert looked.wait(PATIENCE_S)
        cloud.release()
        eventually(lambda: health_of(robot) == SERVING)

    try:
        with serve_here(monkeypatch, cloud, operator) as code:
            assert code == 0
    finally:
        signal.signal(signal.SIGHUP, lived)
    stdout, stderr = capsys.readouterr()
    assert "ready" in stdout
    assert "Traceback" not in stderr
    assert "never retrieved" not in stderr


def findings(target: str) -> list[dict[str, Any]]:
    """What ``comvla doctor`` says of a server."""
    command = [sys.executable, "-m", "comvla_client", "doctor", target, "--json"]
    done = subprocess.run(command, capture_output=True, text=True)
    found: list[dict[str, Any]] = json.loads(done.stdout)["findings"]
    return found


def test_the_real_command_serves_a_checkpoint_until_ctrl_c(checkpoint: Path) -> None:
    _, cloud = random_policy(seed=0)
    arguments = ("-m", "comvla_server", "serve", "--model", str(checkpoint), *FREE_PORTS)
    arguments += ("--compact-positions", "--fastv", "1,0.5", "--dtype", "bfloat16")
    with process(*arguments, "--threads", "1", "--log-format", "json") as running:
        target, admin, model = ready_line(running)
        assert target.startswith("127.0.0.1:")
        assert model == cloud.info.name
        request = message(info=cloud.info, instruction="pull the green drawer open")
        with Robot(target) as robot:
            assert len(robot.infer(request).actions) == 8 * 4
        described = httpx.get(f"{admin}/v1/model", timeout=PATIENCE_S).json()
        assert described["fingerprint"] == cloud.info.fingerprint
        how = ["dtype=bfloat16", "compact_positions", "fastv=1,0.5"]
        assert described["run_options"] == how
        (handshake,) = [f for f in findings(target) if f["check"] == "handshake"]
        assert handshake["values"]["run_options"] == how
        assert "run with dtype=bfloat16 compact_positions" in handshake["found"]
        running.send_signal(signal.SIGINT)
        code, stderr = end(running)
    assert code == 0
    assert all(json.loads(line)["level"] for line in stderr.splitlines())


def test_a_taken_port_is_exit_code_two_and_one_clear_line(
    capfd: pytest.CaptureFixture[str],
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        assert cli.main(["serve", "--port", port, "--admin-port", "0"]) == 2
    stdout, stderr = capfd.readouterr()
    assert stdout == ""
    assert f"cannot listen on 127.0.0.1:{port}" in stderr
    assert "choose another --port" in stderr
    assert len(stderr.splitlines()) == 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("serve", "--max-batch", "0", *FREE_PORTS), "max_batch must be a whole number"),
        (("serve", "--model", "/nowhere/at/all", *FREE_PORTS), "/nowhere/at/all"),
        (("inspect", "/nowhere/at/all"), "/nowhere/at/all"),
    ],
)
def test_a_wrong_option_is_exit_code_two(
    capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], words: str
) -> None:
    assert cli.main(arguments) == 2
    assert words in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--help",), ("examples:", "comvla-server serve --model mini", "exit codes")),
        (("serve", "--help"), ("comvla-server ready grpc=", "SIGTERM", "--max-queue", "0 for a")),
        (("inspect", "--help"), ("--json", "checkpoint")),
        (("--version",), ("comvla ",)),
    ],
)
def test_help_teaches(
    capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], words: tuple[str, ...]
) -> None:
    with pytest.raises(SystemExit) as caught:
        cli.main(arguments)
    assert caught.value.code == 0
    shown = capsys.readouterr().out
    for word in words:
        assert word in shown


def test_inspect_describes_a_checkpoint_and_its_cost(
    checkpoint: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["inspect", str(checkpoint), "--json"]) == 0
    described = json.loads(capsys.readouterr().out)
    assert described["model"]["num_tokens"] == 512
    assert [row["tokens"] for row in described["steps"]] == [512, 256, 128, 64, 32, 16, 8, 4]
    costs = [row["cloud_flops"] for row in described["steps"]]
    assert costs == sorted(costs, reverse=True)
    assert cli.main(["inspect", str(checkpoint)]) == 0
    table = capsys.readouterr().out
    assert described["model"]["fingerprint"] in table
    assert "cloud GFLOPs" in table
