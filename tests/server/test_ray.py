"""The service behind Ray Serve's gRPC proxy: answers, refusals, and the loss of a replica."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import grpc
import pytest
from server_stubs import PATIENCE_S, Robot, eventually, quiet_port

from comvla.errors import ComVLAError
from comvla_server import cli
from comvla_server.identity import Identity
from comvla_server.settings import SettingsError
from comvla_server.tokens import TokenLine
from comvla_vla import random_policy, save_policy
from comvla_vla.random import unit_statistics

TOKEN = "cvt_robot"
START_WITHIN_S = 240.0
STOP_WITHIN_S = 60.0
needs_ray = pytest.mark.skipif(
    importlib.util.find_spec("ray") is None,
    reason="Ray is not installed: pip install 'comvla[ray]'",
)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--port", "50051"), "give --insecure"),
        (("--port", "0", "--insecure"), "name one"),
        (("--insecure", "--admin-tokens-file", "x"), "admin_tokens_file cannot be kept"),
    ],
)
def test_what_rays_proxy_cannot_keep_is_refused(
    arguments: tuple[str, ...], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["ray", *arguments]) == 2
    assert words in capsys.readouterr().err
    assert issubclass(SettingsError, ComVLAError)


def test_without_ray_the_extra_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    assert cli.main(["ray", "--insecure"]) == 2
    assert "pip install 'comvla[ray]'" in capsys.readouterr().err


@pytest.fixture(scope="module")
def target(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Two replicas of a policy with random weights, with tokens, started by the real command."""
    folder: Path = tmp_path_factory.mktemp("ray")
    edge, cloud = random_policy(seed=0)
    statistics = unit_statistics(edge.config)
    save_policy(folder / "policy", edge.net, cloud.net, edge.prompt.tokenizer, statistics)
    tokens = folder / "tokens"
    tokens.write_text(f"{TokenLine.of(Identity('arm-7'), TOKEN)}\n")
    tokens.chmod(0o600)
    port = quiet_port()
    command = [sys.executable, "-m", "comvla_server", "ray", "--insecure", "--replicas", "2"]
    command += ["--model", str(folder / "policy"), "--port", str(port), "--threads", "1"]
    command += ["--tokens-file", str(tokens), "--default-deadline-s", "30"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, env=environment, start_new_session=True
    )
    # Ray waits long for its own processes on a busy machine; not longer than this.
    watchdog = threading.Timer(START_WITHIN_S, process.terminate)
    watchdog.start()
    try:
        assert process.stdout is not None
        line = next((x for x in process.stdout if x.startswith("comvla-server ready")), "")
        watchdog.cancel()
        assert f"grpc=127.0.0.1:{port} " in line, f"not ready within {START_WITHIN_S:g} s"
        assert line.endswith("replicas=2\n")
        # Whatever it says later must not fill the pipe, where it would wait for a reader.
        threading.Thread(target=process.stdout.read, daemon=True).start()
        yield f"127.0.0.1:{port}"
    finally:
        watchdog.cancel()
        process.terminate()
        try:
            assert process.wait(STOP_WITHIN_S) == 0
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)


@needs_ray
@pytest.mark.slow
@pytest.mark.timeout(600)  # START_WITHIN_S counts as well
def test_robots_are_answered_refused_and_carried_over_the_loss_of_a_replica(target: str) -> None:
    import numpy as np

    from comvla.v1 import policy_pb2
    from comvla_client import ComVLAClient
    from comvla_client.health import check_health
    from comvla_sim.bench.replicas import _kill_replica

    edge, _ = random_policy(seed=0)
    info = edge.info
    observation = {
        "images": [np.zeros((*info.image_size, 3), np.uint8)] * info.grid[0],
        "proprio": np.zeros(info.proprio_dim),
    }
    options: dict[str, Any] = {"edge": edge, "budget": 8, "deadline_s": 30.0, "token": TOKEN}
    with ComVLAClient(target, **options) as client:
        for _ in range(6):
            assert client.step(observation, "push the button").source == "cloud"
        _kill_replica(_starter(target))
        for _ in range(20):
            report = client.step(observation, "push the button").report
            assert report.source == "cloud", report.detail
        assert check_health(client._transport.access, PATIENCE_S) == "SERVING"  # type: ignore[attr-defined]
    with ComVLAClient(target, sending="progressive", snr=30.0, **options) as client:
        # The window is a twentieth of a second, and Ray's proxy takes its part: on a busy machine a
        # step may come too late.
        eventually(lambda: client.step(observation, "push the button").report.source == "cloud")
    with Robot(target) as robot:
        code, words = robot.refused(policy_pb2.InferRequest())
        assert code is grpc.StatusCode.UNAUTHENTICATED
        assert "comvla-server token new" in words
        call = robot.stub.Infer.future(
            policy_pb2.InferRequest(),
            timeout=PATIENCE_S,
            metadata=[("authorization", f"Bearer {TOKEN}")],
        )
        error = call.exception(timeout=PATIENCE_S)
        assert error.code() is grpc.StatusCode.FAILED_PRECONDITION
        assert "protocol version" in error.details()


def _starter(target: str) -> int:
    """The process that started the replicas: a child of this one."""
    port = target.rpartition(":")[2].encode()
    for name in os.listdir("/proc"):
        if name.isdigit():
            try:
                words = Path(f"/proc/{name}/cmdline").read_bytes().split(b"\0")
            except OSError:
                continue
            if b"ray" in words and port in words:
                return int(name)
    raise AssertionError("nobody started replicas")
