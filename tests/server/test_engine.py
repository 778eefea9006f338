"""The engine: plain calls around the cloud half of a real model."""

from __future__ import annotations

import numpy as np
import pytest
from server_stubs import STUB_INFO, StubCloud

from comvla_server.engine import Engine
from comvla_vla import CloudModel, PolicyRequest, random_policy

INSTRUCTIONS = ("pull the green drawer open", "press the yellow button firmly")


@pytest.fixture(scope="module")
def real() -> CloudModel:
    return random_policy(seed=0)[1]


def observation(engine: Engine, k: int, seed: int) -> PolicyRequest:
    rng = np.random.default_rng(seed)
    info = engine.info
    return PolicyRequest(
        tokens=rng.normal(size=(k, info.token_dim)).astype(np.float32),
        positions=rng.permutation(info.num_tokens)[:k].astype(np.int32),
        instruction=INSTRUCTIONS[seed % 2],
        proprio=rng.uniform(-1, 1, info.proprio_dim).astype(np.float32),
    )


def test_an_answer_does_not_depend_on_who_shared_the_batch(real: CloudModel) -> None:
    engine = Engine(real)
    requests = [observation(engine, k, i) for i, k in enumerate((512, 4, 32, 1, 16, 64))]
    together = engine.predict(requests)
    for i, request in enumerate(requests):
        alone = engine.predict([request])[0]
        np.testing.assert_allclose(together[i], alone, atol=1e-5, rtol=1e-5)
        in_other_company = engine.predict([requests[i - 1], request])[1]
        np.testing.assert_allclose(in_other_company, alone, atol=1e-5, rtol=1e-5)


def test_requests_of_one_batch_keep_their_own_answers(real: CloudModel) -> None:
    engine = Engine(real)
    requests = [observation(engine, 16, seed) for seed in range(4)]
    forward = engine.predict(requests)
    backward = engine.predict(requests[::-1])[::-1]
    np.testing.assert_allclose(forward, backward, atol=1e-5, rtol=1e-5)
    assert np.ptp(np.stack(forward), axis=0).max() > 1e-4


def test_flops_grow_with_the_tokens(real: CloudModel) -> None:
    engine = Engine(real)
    costs = [engine.flops(observation(engine, k, 0)) for k in (4, 32, 512)]
    assert 0 < costs[0] < costs[1] < costs[2]


def test_a_real_model_warms_up(real: CloudModel) -> None:
    Engine(real).warm_up(max_batch=2)


def test_warm_up_runs_alone_and_at_the_largest_batch_without_pruning() -> None:
    cloud = StubCloud()
    sizes: list[tuple[int, int]] = []
    usual = cloud.predict

    def predict(requests: list[PolicyRequest]) -> list[np.ndarray]:
        sizes.append((len(requests), len(requests[0].positions)))
        return usual(requests)

    cloud.predict = predict  # type: ignore[method-assign]
    n, engine = STUB_INFO.num_tokens, Engine(cloud)
    engine.warm_up(max_batch=8)
    assert sizes[:2] == [(1, n), (8, n)]
    assert {requests for requests, _ in sizes} == {1, 8}  # what follows teaches it its costs
    assert engine.costs.known
    sizes.clear()
    Engine(cloud).warm_up(max_batch=1)
    assert sizes[0] == (1, n)
    assert {requests for requests, _ in sizes} == {1}
