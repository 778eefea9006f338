"""Robots that ask one query after another, so that a server always has work."""

from __future__ import annotations

import threading
import time
import uuid
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from comvla import codec, handshake
from comvla.model_info import PROTOCOL_VERSION, ModelInfo
from comvla.v1 import policy_pb2
from comvla_client.reaching import make_transport

_TIMEOUT_S = 60.0
_INSTRUCTION = "press the yellow button firmly"


@dataclass(frozen=True)
class Answered:
    """One call.

    Attributes:
        began: on ``time.monotonic``.
        took_s: until its answer, or until it failed.
        value: first action of the answer; None where it failed.
        failure: why, empty where it was answered.
    """

    began: float
    took_s: float
    value: float | None
    failure: str = ""


class Load:
    """Robots that ask one query after another, each from a thread of its own.

    Args:
        target: one server, or several.
        clients, token_budget, deadline_s, seed: as in :class:`comvla_sim.bench.swaps.SwapParameters`.
    """

    def __init__(
        self, target: str, *, clients: int, token_budget: int, deadline_s: float, seed: int
    ) -> None:
        self._deadline_s = deadline_s
        self._stop = threading.Event()
        self._calls: list[list[Answered]] = [[] for _ in range(clients)]
        self._transports = [make_transport(target) for _ in range(clients)]
        info = handshake.from_response(self._transports[0].get_model(_TIMEOUT_S))
        self._requests = [
            make_request(info, number, token_budget, seed) for number in range(clients)
        ]
        self._threads = [
            threading.Thread(target=self._drive, args=(number,), daemon=True)
            for number in range(clients)
        ]

    def start(self) -> None:
        """Begins to ask."""
        for thread in self._threads:
            thread.start()

    @property
    def answered(self) -> int:
        """Calls so far."""
        return sum(map(len, self._calls))

    @property
    def distinct_answers(self) -> int:
        """Answers that one robot got to its one observation: as many as there were models."""
        return max(
            len({round(call.value, 4) for call in calls if call.value is not None})
            for calls in self._calls
        )

    def stop(self) -> list[Answered]:
        """Ends the load; all calls in the order of their beginning."""
        self._stop.set()
        for thread in self._threads:
            thread.join(_TIMEOUT_S)
        return sorted((call for calls in self._calls for call in calls), key=lambda c: c.began)

    def close(self) -> None:
        """Ends the connections."""
        self._stop.set()
        for transport in self._transports:
            transport.close()

    def _drive(self, number: int) -> None:
        transport, request = self._transports[number], self._requests[number]
        while not self._stop.is_set():
            began = time.monotonic()
            value, failure = None, ""
            try:
                value = float(transport.infer(request, self._deadline_s).actions[0])
            except Exception as error:  # whatever it is, it is a call that failed
                failure = f"{type(error).__name__}: {error}"
            self._calls[number].append(Answered(began, time.monotonic() - began, value, failure))
            request.step += 1


@contextmanager
def under_load(target: str, **options: Any) -> Iterator[Load]:
    """:class:`Load` while the block lasts."""
    with closing(Load(target, **options)) as load:
        load.start()
        yield load


def make_request(
    info: ModelInfo, number: int, token_budget: int, seed: int
) -> policy_pb2.InferRequest:
    """Random tokens of one robot, which nobody was before: steps of a session only count up."""
    rng = np.random.default_rng((seed, number))
    k = min(token_budget, info.num_tokens)
    tokens = rng.standard_normal((k, info.token_dim), np.float32)
    positions = rng.permutation(info.num_tokens)[:k]
    return policy_pb2.InferRequest(
        session_id=f"robot-{number}-{uuid.uuid4().hex[:8]}",
        step=0,
        instruction=_INSTRUCTION,
        proprio=[0.0] * info.proprio_dim,
        payload=codec.encode(tokens, positions, "int8", tower_dims=info.tower_dims),
        model_fingerprint=info.fingerprint,
        protocol_version=PROTOCOL_VERSION,
    )


def call_figures(calls: list[Answered]) -> dict[str, Any]:
    """How many, how many failed, and how long the others took."""
    took = [call.took_s for call in calls if not call.failure]
    median, p99 = np.percentile(took, [50, 99]) if took else (float("nan"), float("nan"))
    return {
        "answered": len(took),
        "failed": len(calls) - len(took),
        "median_s": float(median),
        "p99_s": float(p99),
        "worst_s": max(took, default=float("nan")),
    }
