"""The client and the real server, in one process and in two."""

from __future__ import annotations

import re
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from client_stubs import reserved_port, set_deadline

from comvla import codec
from comvla.errors import HandshakeError, InstructionError
from comvla_client import AsyncComVLAClient, ComVLAClient, LinkProfile
from comvla_server.background import BackgroundServer
from comvla_server.engine import Engine
from comvla_server.settings import ServerSettings
from comvla_vla import CloudModel, EdgeModel, PolicyRequest, random_policy

LINK = LinkProfile(bandwidth_hz=0.88e6)
WORDS = "pull the green drawer open"
Policy = tuple[EdgeModel, CloudModel]


def observation(seed: int = 0) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    images = [rng.integers(0, 256, (128, 128, 3), dtype=np.uint8) for _ in range(2)]
    return {"images": images, "proprio": rng.standard_normal(4)}


def client_of(target: str, policy: Policy, **options: Any) -> ComVLAClient:
    # A deadline that a busy machine can keep: these tests are about answers, not about time.
    options = {"edge": policy[0], "link": LINK, "deadline_s": 20.0, **options}
    return ComVLAClient(target, **options)


@pytest.mark.parametrize("quantization", codec.QUANTIZATIONS)
def test_the_answer_is_the_cloud_half_on_the_tokens_that_were_sent(
    policy: Policy, server: BackgroundServer, quantization: str
) -> None:
    edge, cloud = policy
    obs = observation()
    with client_of(server.target, policy, quantization=quantization) as client:
        chunk = client.step(obs, WORDS, 3.0)
    positions = chunk.report.positions
    tokens = edge.encode(obs["images"])[positions].numpy()
    arrived, _ = codec.decode(codec.encode(tokens, positions, quantization))
    proprio = np.asarray(obs["proprio"], np.float32)
    [expected] = cloud.predict([PolicyRequest(arrived, positions, WORDS, proprio)])
    assert chunk.report.tokens == chunk.report.tokens_used > 0
    np.testing.assert_allclose(chunk.actions, expected, atol=1e-5)


def test_the_counters_of_both_sides_agree(policy: Policy) -> None:
    with (
        BackgroundServer(Engine(policy[1])) as server,
        client_of(server.target, policy) as client,
    ):
        reports = [client.step(observation(i), WORDS, 2.0 * i).report for i in range(5)]
        with urllib.request.urlopen(f"{server.admin_url}/metrics", timeout=20.0) as page:
            metrics = page.read().decode()

    def counted(name: str) -> float:
        found = re.search(rf"^comvla_{name}_total (\S+)$", metrics, re.MULTILINE)
        assert found, metrics
        return float(found[1])

    assert counted("tx_framed_bytes") == sum(report.framed_bytes for report in reports)
    assert counted("tx_encoded_bytes") == sum(report.encoded_bytes for report in reports)
    assert counted("tx_payload_bytes") == sum(report.payload_bytes for report in reports)


async def test_both_forms_of_the_client_get_the_same_actions(
    policy: Policy, server: BackgroundServer
) -> None:
    with client_of(server.target, policy) as client:
        expected = [client.step(observation(i), WORDS, 5.0) for i in range(3)]
    async with AsyncComVLAClient(server.target, edge=policy[0], link=LINK, deadline_s=20.0) as aio:
        came = [await aio.step(observation(i), WORDS, 5.0) for i in range(3)]
    for one, other in zip(came, expected, strict=True):
        np.testing.assert_allclose(one.actions, other.actions, atol=1e-6)
        np.testing.assert_array_equal(one.report.positions, other.report.positions)


def test_words_that_the_model_never_saw_raise_before_anything_is_sent(
    policy: Policy, server: BackgroundServer
) -> None:
    with client_of(server.target, policy) as client:
        with pytest.raises(InstructionError, match="never saw"):
            client.step(observation(), "juggle the drawers", 5.0)
        assert client.step(observation(), WORDS, 5.0).report.step == 0


def test_edge_and_server_of_different_policies_never_meet(server: BackgroundServer) -> None:
    with pytest.raises(HandshakeError, match="same checkpoint"):
        client_of(server.target, random_policy(seed=1))


def test_a_drained_server_that_returns_is_found_again(policy: Policy) -> None:
    with reserved_port() as port:
        settings = ServerSettings(port=port)
        with BackgroundServer(Engine(policy[1]), settings) as first:
            client = client_of(first.target, policy, execute=5)
            assert client.step(observation(), WORDS, 5.0).source == "cloud"
        with client:
            set_deadline(client, 0.5)
            sources = [client.step(observation(), WORDS, 5.0).source for _ in range(3)]
            assert sources == ["rest", "hold", "hold"]
            set_deadline(client, 20.0)
            with BackgroundServer(Engine(policy[1]), settings):
                assert client.step(observation(), WORDS, 5.0).source == "cloud"


def test_a_server_that_returns_with_another_model_raises(policy: Policy) -> None:
    with reserved_port() as port:
        settings = ServerSettings(port=port)
        with BackgroundServer(Engine(policy[1]), settings) as first:
            client = client_of(first.target, policy)
        with (
            client,
            BackgroundServer(Engine(random_policy(seed=1)[1]), settings),
            pytest.raises(HandshakeError, match="same checkpoint"),
        ):
            client.step(observation(), WORDS, 5.0)


@contextmanager
def server_process(checkpoint: Path, port: int) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """``comvla-server serve`` as a process; gives it and its target when it is ready."""
    command = [sys.executable, "-m", "comvla_server", "serve", "--model", str(checkpoint)]
    process = subprocess.Popen(
        [*command, "--port", str(port), "--admin-port", "0", "--log-level", "error"],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout is not None
        ready = process.stdout.readline()
        found = re.search(r"grpc=(\S+)", ready)
        assert found, ready
        yield process, found[1]
    finally:
        process.kill()
        process.communicate()


@pytest.mark.alone
def test_a_server_killed_and_restarted_in_mid_episode(policy: Policy, checkpoint: Path) -> None:
    """No exception, the rest of the chunk, holding, and back with the first step after its return."""
    sources, reasons = [], []
    with reserved_port() as port:
        with server_process(checkpoint, port) as (process, target):
            client = client_of(target, policy, execute=5)
            for i in range(3):
                sources.append(client.step(observation(i), WORDS, 8.0).source)
            process.kill()
            process.wait()
            set_deadline(client, 0.4)
            for i in range(3, 8):
                chunk = client.step(observation(i), WORDS, 8.0)
                sources.append(chunk.source)
                reasons.append(chunk.report.fallback_reason)
                assert chunk.actions.shape == (8, 4)
                assert np.isfinite(chunk.actions).all()
        with client, server_process(checkpoint, port):
            set_deadline(client, 20.0)
            sources.append(client.step(observation(8), WORDS, 8.0).source)
    assert sources == ["cloud"] * 3 + ["rest", "hold", "hold", "hold", "hold"] + ["cloud"]
    # On a busy machine the edge half may have taken all of a step's time.
    assert "unavailable" in reasons
    assert set(reasons) <= {"unavailable", "deadline"}
