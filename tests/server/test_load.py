"""Sixteen robots on one server with a real model."""

from __future__ import annotations

import asyncio
import itertools
import time
from typing import Any

import grpc
import numpy as np
import pytest
from server_stubs import PATIENCE_S, message

from comvla import codec
from comvla.v1 import policy_pb2, policy_pb2_grpc
from comvla_server.background import BackgroundServer
from comvla_server.engine import Engine
from comvla_server.settings import ServerSettings
from comvla_server.validation import Validator
from comvla_vla import random_policy

ROBOTS = 16
STEPS = 6
MIXED_K = (512, 64, 32, 32, 16, 16, 8, 4)
INSTRUCTIONS = ("pull the green drawer open", "lower the black lever gently")


@pytest.fixture(scope="module")
def engine() -> Engine:
    return Engine(random_policy(seed=0)[1])


def requests_of(engine: Engine, robot: int) -> list[policy_pb2.InferRequest]:
    """Steps of one robot; K differs between robots and from step to step."""
    sizes = itertools.islice(itertools.cycle(MIXED_K), robot, robot + STEPS)
    return [
        message(
            f"robot-{robot}",
            step,
            k=k,
            name=robot / ROBOTS,
            quantization="float32",
            info=engine.info,
            instruction=INSTRUCTIONS[robot % 2],
        )
        for step, k in enumerate(sizes)
    ]


async def drive(target: str, engine: Engine) -> list[tuple[Any, Any]]:
    """Every robot asks its next step when it has the answer to the last."""
    answered: list[tuple[Any, Any]] = []
    async with grpc.aio.insecure_channel(target, options=codec.GRPC_OPTIONS) as channel:
        stub = policy_pb2_grpc.PolicyServiceStub(channel)

        async def robot(number: int) -> None:
            for request in requests_of(engine, number):
                answered.append((request, await stub.Infer(request, timeout=PATIENCE_S)))

        await asyncio.gather(*(robot(number) for number in range(ROBOTS)))
    return answered


def rush(engine: Engine, max_batch: int) -> tuple[list[tuple[Any, Any]], float, float]:
    """Answers, mean batch and answers per second of one rush."""
    with BackgroundServer(engine, ServerSettings(max_batch=max_batch)) as server:
        started_s = time.perf_counter()
        answered = asyncio.run(drive(server.target, engine))
        rate = len(answered) / (time.perf_counter() - started_s)
        registry = server.server.metrics.registry
        requests = registry.get_sample_value("comvla_batch_size_sum")
        passes = registry.get_sample_value("comvla_batch_size_count")
    assert requests is not None
    assert passes
    return answered, requests / passes, rate


def test_under_load_requests_share_passes_and_every_answer_is_as_if_alone(
    engine: Engine, record_property: Any
) -> None:
    answered, mean_batch, batched_rate = rush(engine, max_batch=8)
    assert len(answered) == ROBOTS * STEPS
    assert mean_batch > 1
    validator = Validator(engine, 2**20)
    for request, response in answered:
        alone = engine.predict([validator.read(request)])[0]
        np.testing.assert_allclose(
            np.float32(response.actions), alone.ravel(), atol=1e-5, rtol=1e-5
        )

    single, mean_single, single_rate = rush(engine, max_batch=1)
    assert len(single) == ROBOTS * STEPS
    assert mean_single == 1
    # A measurement, not a claim: it depends on the machine and on what else runs there.
    record_property("mean_batch", mean_batch)
    record_property("throughput_ratio_to_batch_1", batched_rate / single_rate)
