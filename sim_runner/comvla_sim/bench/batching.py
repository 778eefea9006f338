"""Many robots on one server: how much a shared forward pass buys.

Closed loop: each robot sends its next observation when it has its answer, so the server always has work.
The robots differ in K, as robots on different links do.
"""

from __future__ import annotations

import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from comvla import codec, handshake
from comvla.model_info import PROTOCOL_VERSION, ModelInfo
from comvla.v1 import policy_pb2
from comvla_client.transport import GrpcTransport
from comvla_sim.bench import environment, policy_server
from comvla_sim.bench.processes import serving
from comvla_sim.bench.timing import Timing

_TIMEOUT_S = 60.0
_INSTRUCTION = "press the yellow button firmly"
# Requests of each robot before it is the other server's turn: a busy moment of the machine then falls
# on both.
_BLOCK = 10


@dataclass(frozen=True)
class BatchingParameters:
    """The robots and the server.

    Attributes:
        clients: robots.
        token_budgets: K of robot i is entry i, counted round.
        max_batch: of the batching server; the other one has 1.
        model: ``"mini"``, ``"random"`` (mini's architecture) or a checkpoint.
        threads: of torch in the server, 0 for its own choice.
        repetitions: timed requests of each robot.
        warm_up: requests of each robot before them.
        seed: of the tokens.
    """

    clients: int = 16
    token_budgets: tuple[int, ...] = (8, 16, 24, 32, 48, 64)
    max_batch: int = 8
    model: str = "mini"
    threads: int = 1
    repetitions: int = 40
    warm_up: int = 4
    seed: int = 0

    def budget_of(self, client: int) -> int:
        """K of one robot."""
        return self.token_budgets[client % len(self.token_budgets)]


def run(parameters: BatchingParameters) -> dict[str, Any]:
    """Measures the same load on a server with batches of one and on one that batches, in turns.

    Returns:
        An object with ``environment``, ``parameters``, ``rows`` and ``throughput_ratio``, JSON-able.

    Raises:
        RuntimeError: a request was not answered.
    """
    with ExitStack() as stack:
        fleets = [
            stack.enter_context(_fleet(parameters, max_batch))
            for max_batch in (1, parameters.max_batch)
        ]
        for fleet in fleets:
            fleet.warm_up(parameters.warm_up)
        for start in range(0, parameters.repetitions, _BLOCK):
            for fleet in fleets:
                fleet.run(min(_BLOCK, parameters.repetitions - start))
        rows = [fleet.row() for fleet in fleets]
    return {
        "bench": "batching",
        "environment": environment.describe(),
        "parameters": {
            **asdict(parameters),
            "budgets": [parameters.budget_of(i) for i in range(parameters.clients)],
        },
        "rows": rows,
        "throughput_ratio": rows[1]["requests_per_s"] / rows[0]["requests_per_s"],
    }


class _Fleet:
    """All robots of one server, and what they measured."""

    def __init__(self, robots: list[_Robot], admin_url: str, max_batch: int) -> None:
        self._robots = robots
        self._admin_url = admin_url
        self._max_batch = max_batch
        self._durations_s: list[float] = []
        self._elapsed_s = 0.0
        self._warm_counts = (0.0, 0.0)

    def warm_up(self, count: int) -> None:
        """``count`` requests of each robot that are not counted."""
        _all_at_once(self._robots, count)
        self._warm_counts = _batch_counts(self._admin_url)

    def run(self, count: int) -> None:
        """``count`` requests of each robot, one after another, all robots at once."""
        began = time.perf_counter()
        self._durations_s += _all_at_once(self._robots, count)
        self._elapsed_s += time.perf_counter() - began

    def row(self) -> dict[str, Any]:
        """What came out, JSON-able."""
        counts = _batch_counts(self._admin_url)
        passes, requests = (a - b for a, b in zip(counts, self._warm_counts, strict=True))
        return {
            "name": f"max_batch {self._max_batch}",
            "max_batch": self._max_batch,
            "answered": len(self._durations_s),
            "requests_per_s": len(self._durations_s) / self._elapsed_s,
            "mean_batch": requests / passes,
            **asdict(Timing.of(self._durations_s)),
        }


@contextmanager
def _fleet(parameters: BatchingParameters, max_batch: int) -> Iterator[_Fleet]:
    # What batches are worth is measured here, not whom a server turns away that cannot keep up.
    arguments = (parameters.model, max_batch, parameters.threads, {"admission": False})
    with ExitStack() as stack:
        addresses = stack.enter_context(serving(policy_server.serve, *arguments))
        target, admin_url = addresses.split()
        robots = [
            stack.enter_context(closing(_Robot(target, parameters, client)))
            for client in range(parameters.clients)
        ]
        yield _Fleet(robots, admin_url, max_batch)


class _Robot:
    """One session with tokens of its own; sends observations one after another."""

    def __init__(self, target: str, parameters: BatchingParameters, client: int) -> None:
        self._transport = GrpcTransport(target)
        info = handshake.from_response(self._transport.get_model(_TIMEOUT_S))
        self._request = _request(info, parameters, client)
        self._horizon = info.action_horizon

    def send(self, count: int) -> list[float]:
        """Durations of ``count`` calls in seconds."""
        durations_s = []
        for _ in range(count):
            began = time.perf_counter()
            response = self._transport.infer(self._request, _TIMEOUT_S)
            durations_s.append(time.perf_counter() - began)
            if response.step != self._request.step or response.action_horizon != self._horizon:
                raise RuntimeError(f"step {self._request.step} got the answer of {response.step}")
            self._request.step += 1
        return durations_s

    def close(self) -> None:
        """Ends the connection."""
        self._transport.close()


def _request(
    info: ModelInfo, parameters: BatchingParameters, client: int
) -> policy_pb2.InferRequest:
    rng = np.random.default_rng((parameters.seed, client))
    k = min(parameters.budget_of(client), info.num_tokens)
    tokens = rng.standard_normal((k, info.token_dim), np.float32)
    positions = rng.permutation(info.num_tokens)[:k]
    return policy_pb2.InferRequest(
        session_id=f"robot-{client}",
        step=0,
        instruction=_INSTRUCTION,
        proprio=[0.0] * info.proprio_dim,
        payload=codec.encode(tokens, positions, "int8", tower_dims=info.tower_dims),
        model_fingerprint=info.fingerprint,
        protocol_version=PROTOCOL_VERSION,
    )


def _all_at_once(robots: list[_Robot], count: int) -> list[float]:
    """Every robot sends ``count`` requests from a thread of its own; durations of all, in seconds."""
    durations_s: list[list[float]] = [[] for _ in robots]
    failures: list[BaseException] = []
    start = threading.Barrier(len(robots))

    def work(index: int) -> None:
        try:
            start.wait()
            durations_s[index] = robots[index].send(count)
        except BaseException as error:  # told below, in the thread that asked
            failures.append(error)

    threads = [threading.Thread(target=work, args=(i,)) for i in range(len(robots))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if failures:
        raise RuntimeError(f"{len(failures)} robots got no answer: {failures[0]}") from failures[0]
    return [duration for each in durations_s for duration in each]


def _batch_counts(admin_url: str) -> tuple[float, float]:
    """Forward passes and requests in them, as the server's own metrics have them."""
    with urllib.request.urlopen(f"{admin_url}/metrics", timeout=_TIMEOUT_S) as page:
        lines = page.read().decode().splitlines()
    found = {
        name: float(value)
        for name, _, value in (line.partition(" ") for line in lines)
        if name in ("comvla_batch_size_count", "comvla_batch_size_sum")
    }
    return found["comvla_batch_size_count"], found["comvla_batch_size_sum"]
