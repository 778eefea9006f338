"""Hostile bytes: mutated requests never crash the server and meet documented statuses only."""

from __future__ import annotations

import asyncio
import collections
import math
import random
import socket
from collections.abc import Sequence
from typing import Any

import grpc
import httpx
from server_stubs import PATIENCE_S, STUB_INFO, Robot, message

from comvla import codec
from comvla.model_info import ModelInfo
from comvla.v1 import policy_pb2
from comvla_server.background import BackgroundServer
from comvla_server.engine import Engine
from comvla_server.statuses import STATUS
from comvla_sim.fuzz.mutations import TOKEN_MUTATIONS, mutated_bytes
from comvla_vla import random_policy

REQUESTS = 10_500
CONCURRENCY = 32
DOCUMENTED = {grpc.StatusCode.OK, *STATUS.values()}
# A mutated request breaks neither the server nor the model, so it is never the server's fault.
EXPECTED = DOCUMENTED - {grpc.StatusCode.INTERNAL, grpc.StatusCode.UNAVAILABLE}


def mutated_message(rng: random.Random, info: ModelInfo, instructions: Sequence[str]) -> bytes:
    """A valid request in which one to three fields were replaced."""
    request = message(
        f"s{rng.randrange(3000)}",
        rng.randrange(4),
        k=rng.randrange(17),
        quantization=rng.choice(codec.QUANTIZATIONS),
        info=info,
        instruction=rng.choice(instructions),
    )
    for _ in range(rng.randint(1, 3)):
        rng.choice(TOKEN_MUTATIONS)(request, rng)
    return request.SerializeToString()


def hostile(rng: random.Random, info: ModelInfo, instructions: Sequence[str]) -> bytes:
    """Bytes for the Infer method."""
    kind = rng.random()
    if kind < 0.7:
        return mutated_message(rng, info, instructions)
    if kind < 0.95:
        return mutated_bytes(message(k=rng.randrange(5), info=info).SerializeToString(), rng)
    return rng.randbytes(rng.randrange(300))


async def attack(
    target: str,
    seed: int,
    requests: int,
    info: ModelInfo = STUB_INFO,
    instructions: Sequence[str] = ("open it",),
) -> tuple[collections.Counter[Any], list[str]]:
    """Statuses of all calls, and the messages of the refused ones."""
    rng = random.Random(seed)
    data_of_calls = iter([hostile(rng, info, instructions) for _ in range(requests)])
    statuses: collections.Counter[Any] = collections.Counter()
    messages: list[str] = []
    async with grpc.aio.insecure_channel(target) as channel:
        infer = channel.unary_unary("/comvla.v1.PolicyService/Infer")

        async def worker() -> None:
            for data in data_of_calls:
                try:
                    answer = policy_pb2.InferResponse.FromString(
                        await infer(data, timeout=PATIENCE_S)
                    )
                    assert all(math.isfinite(a) for a in answer.actions)
                    statuses[grpc.StatusCode.OK] += 1
                except grpc.aio.AioRpcError as error:
                    statuses[error.code()] += 1
                    messages.append(error.details() or "")

        await asyncio.gather(*(worker() for _ in range(CONCURRENCY)))
    return statuses, messages


def test_ten_thousand_mutated_requests_do_no_harm(server: BackgroundServer, robot: Robot) -> None:
    statuses, messages = asyncio.run(attack(server.target, seed=20, requests=REQUESTS))
    assert sum(statuses.values()) == REQUESTS
    assert set(statuses) <= EXPECTED, statuses
    # The mutations reach every layer, valid requests among them.
    assert statuses[grpc.StatusCode.OK] > REQUESTS / 100
    assert statuses[grpc.StatusCode.INVALID_ARGUMENT] > REQUESTS / 10
    assert statuses[grpc.StatusCode.FAILED_PRECONDITION] > REQUESTS / 100
    assert all(text and text.isprintable() and len(text) <= 1000 for text in messages)

    assert len(robot.infer(message("afterwards")).actions) == 6
    assert httpx.get(f"{server.admin_url}/healthz", timeout=PATIENCE_S).status_code == 200
    metrics = httpx.get(f"{server.admin_url}/metrics", timeout=PATIENCE_S).text
    assert "comvla_model_errors_total 0.0" in metrics
    sessions = httpx.get(f"{server.admin_url}/v1/sessions", timeout=PATIENCE_S).json()["sessions"]
    assert len(sessions) > 0


def test_random_bytes_to_the_ports_do_no_harm(server: BackgroundServer, robot: Robot) -> None:
    """Not even HTTP/2 on the one port, not even HTTP on the other."""
    rng = random.Random(7)
    for port in (server.server.port, server.server.admin_port):
        for _ in range(20):
            with socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S) as connection:
                connection.sendall(rng.randbytes(rng.randrange(1, 400)))
    assert robot.infer(message())
    assert httpx.get(f"{server.admin_url}/readyz", timeout=PATIENCE_S).status_code == 200


def test_mutated_requests_do_not_break_a_real_model() -> None:
    """Whatever passes validation, a real forward pass turns into finite actions."""
    _, cloud = random_policy(seed=0)
    known = ("pull the green drawer open", "press the yellow button firmly")
    with BackgroundServer(Engine(cloud)) as server:
        statuses, _ = asyncio.run(
            attack(server.target, seed=21, requests=1000, info=cloud.info, instructions=known)
        )
    assert set(statuses) <= EXPECTED, statuses
    assert statuses[grpc.StatusCode.OK] > 20
