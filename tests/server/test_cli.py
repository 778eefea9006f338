"""``comvla-server`` as a process: what an operator sees."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import grpc
import httpx
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc
from server_stubs import PATIENCE_S, Robot, eventually, message

from comvla_server import cli
from comvla_vla import random_policy, save_policy
from comvla_vla.random import unit_statistics

HERE = Path(__file__).parent
FREE_PORTS = ("--port", "0", "--admin-port", "0")
READY = re.compile(r"comvla-server ready grpc=(\S+) admin=(http://\S+) model=(\S+)\n")


@contextlib.contextmanager
def process(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    """A Python process that does not outlive the block."""
    environment = {**os.environ, "PYTHONPATH": str(HERE), "OMP_NUM_THREADS": "1"}
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


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT], ids=["SIGTERM", "Ctrl-C"])
def test_a_signal_completes_the_request_in_flight_and_exits_cleanly(
    gate: Path, number: signal.Signals
) -> None:
    with process(str(HERE / "gated_server.py"), str(gate), "serve", *FREE_PORTS) as running:
        target, admin, model = ready_line(running)
        assert model == "stub"
        with Robot(target) as robot:
            call = robot.send(message("in-flight"))
            with model_at(gate):
                running.send_signal(number)
                health = health_pb2_grpc.HealthStub(robot.channel)
                asked = health_pb2.HealthCheckRequest()
                eventually(
                    lambda: health.Check(asked).status == health_pb2.HealthCheckResponse.NOT_SERVING
                )
                assert httpx.get(f"{admin}/readyz").status_code == 503
                code, words = robot.refused(message("new"))
                assert code is grpc.StatusCode.UNAVAILABLE
                assert "draining" in words
                assert not call.done()
            assert call.result(timeout=PATIENCE_S).session_id == "in-flight"
        code, stderr = end(running)
    assert code == 0
    assert "Traceback" not in stderr


def test_a_second_signal_exits_at_once(gate: Path) -> None:
    with process(str(HERE / "gated_server.py"), str(gate), "serve", *FREE_PORTS) as running:
        target, admin, _ = ready_line(running)
        with Robot(target) as robot:
            call = robot.send(message())
            with model_at(gate):
                running.send_signal(signal.SIGTERM)
                eventually(lambda: httpx.get(f"{admin}/readyz").status_code == 503)
                running.send_signal(signal.SIGTERM)
                code, _ = end(running)
            assert call.exception(PATIENCE_S).code() is grpc.StatusCode.UNAVAILABLE
    assert code == 128 + signal.SIGTERM


def test_calls_that_outlast_the_grace_are_an_exit_code(gate: Path) -> None:
    arguments = ("serve", *FREE_PORTS, "--grace-s", "0.05", "--log-format", "json")
    with process(str(HERE / "gated_server.py"), str(gate), *arguments) as running:
        target, _, _ = ready_line(running)
        with Robot(target) as robot:
            call = robot.send(message())
            with model_at(gate):
                running.send_signal(signal.SIGTERM)
                code, stderr = end(running)
            assert call.exception(PATIENCE_S).code() is grpc.StatusCode.UNAVAILABLE
    assert code == 1
    events = [json.loads(line) for line in stderr.splitlines() if line.startswith("{")]
    assert any("cut off" in event["message"] for event in events)


def test_a_signal_while_the_model_loads_ends_the_process(tmp_path: Path) -> None:
    """The warm-up of the second batch size waits at the gate for ever."""
    gate = tmp_path / "gate"
    os.mkfifo(gate)
    script = (
        "import sys, server_stubs, gated_server as g\n"
        "from comvla_server import cli, serve_command\n"
        f"cloud = g.GatedCloud({str(gate)!r})\n"
        "serve_command.load_engine = lambda *_: g.Engine(cloud)\n"
        "sys.exit(cli.main(['serve', '--port', '0', '--admin-port', '0']))\n"
    )
    with process("-c", script) as running, model_at(gate):
        running.send_signal(signal.SIGTERM)
        code, stderr = end(running)
    assert code == 0
    assert "Traceback" not in stderr


def test_the_real_command_serves_a_checkpoint(checkpoint: Path) -> None:
    _, cloud = random_policy(seed=0)
    arguments = ("-m", "comvla_server", "serve", "--model", str(checkpoint), *FREE_PORTS)
    with process(*arguments, "--threads", "1", "--log-format", "json") as running:
        target, admin, model = ready_line(running)
        assert target.startswith("127.0.0.1:")
        assert model == cloud.info.name
        request = message(info=cloud.info, instruction="pull the green drawer open")
        with Robot(target) as robot:
            assert len(robot.infer(request).actions) == 8 * 4
        assert httpx.get(f"{admin}/v1/model").json()["fingerprint"] == cloud.info.fingerprint
        running.send_signal(signal.SIGTERM)
        code, stderr = end(running)
    assert code == 0
    assert all(json.loads(line)["level"] for line in stderr.splitlines())


def test_a_taken_port_is_exit_code_two_and_one_clear_line() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        arguments = ("-m", "comvla_server", "serve", "--port", port, "--admin-port", "0")
        with process(*arguments) as running:
            code, stderr = end(running)
    assert code == 2
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
