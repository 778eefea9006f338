"""A cloud half whose timing a test commands, and requests for it."""

from __future__ import annotations

import contextlib
import random
import socket
import threading
import time
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import grpc
import numpy as np
from numpy.typing import NDArray

from comvla import codec
from comvla.errors import InstructionError
from comvla.model_info import PROTOCOL_VERSION, ModelInfo
from comvla.v1 import policy_pb2, policy_pb2_grpc
from comvla_vla.request import PolicyRequest

PATIENCE_S = 60.0

STUB_INFO = ModelInfo(
    name="stub",
    fingerprint="f00d",
    num_tokens=16,
    token_dim=8,
    tower_dims=(4, 4),
    grid=(1, 4, 4),
    image_size=(8, 8),
    action_horizon=3,
    action_dim=2,
    proprio_dim=2,
    max_prompt_tokens=32,
    delta_actions=(True, False),
)


class StubCloud:
    """Deterministic actions; ``hold`` makes forward passes wait until ``release``.

    Attributes:
        batches: for each forward pass, the proprio[0] of its requests: tests use it as a name.
    """

    def __init__(self, info: ModelInfo = STUB_INFO) -> None:
        self.info = info
        self.batches: list[list[float]] = []
        self.breaks_on: Callable[[PolicyRequest], BaseException | None] = lambda _: None
        self.answer: Callable[[list[PolicyRequest]], list[NDArray[np.float32]]] = self._actions
        self._gate = threading.Condition()
        self._passes = float("inf")
        self._entered = threading.Semaphore(0)

    def hold(self) -> None:
        """From now on, forward passes wait."""
        with self._gate:
            self._passes = 0

    def release(self, passes: float = float("inf")) -> None:
        """Lets so many go on, by default all."""
        with self._gate:
            self._passes = passes
            self._gate.notify_all()

    def wait_until_running(self) -> None:
        """Returns when one more forward pass has begun."""
        assert self._entered.acquire(timeout=PATIENCE_S), "the model was never called"

    def forget(self) -> None:
        """Starts counting anew, after a warm-up."""
        self.batches.clear()
        while self._entered.acquire(blocking=False):
            pass

    def predict(self, requests: list[PolicyRequest]) -> list[NDArray[np.float32]]:
        self.batches.append([0.0 if r.proprio is None else float(r.proprio[0]) for r in requests])
        self._entered.release()
        with self._gate:
            assert self._gate.wait_for(lambda: self._passes > 0, PATIENCE_S), "never released"
            self._passes -= 1
        for request in requests:
            error = self.breaks_on(request)
            if error is not None:
                raise error
        return self.answer(requests)

    def _actions(self, requests: list[PolicyRequest]) -> list[NDArray[np.float32]]:
        return [stub_actions(r, self.info) for r in requests]

    def flops(self, num_tokens: int, instruction: str | Sequence[int]) -> float:
        return 1000.0 * num_tokens

    def check_instruction(self, instruction: str) -> None:
        if not instruction.strip():
            raise InstructionError("the instruction is empty: say what the robot should do")
        if "zebra" in instruction:
            raise InstructionError(f"the model never saw {instruction}")


def stub_actions(request: PolicyRequest, info: ModelInfo = STUB_INFO) -> NDArray[np.float32]:
    """What the stub answers: depends on every token, every position and the proprioception."""
    weights = np.asarray(request.positions, np.float32) + 1
    value = float(weights @ np.asarray(request.tokens, np.float32).sum(axis=1))
    if request.proprio is not None:
        value += float(request.proprio.sum())
    shape = (info.action_horizon, info.action_dim)
    return value + np.arange(np.prod(shape), dtype=np.float32).reshape(shape)


def policy_request(name: float = 0.0, k: int = 3) -> PolicyRequest:
    """A request for the stub, known by its first proprioceptive value."""
    rng = np.random.default_rng(k)
    return PolicyRequest(
        tokens=rng.normal(size=(k, STUB_INFO.token_dim)).astype(np.float32),
        positions=np.arange(k, dtype=np.int32),
        instruction="open it",
        proprio=np.array([name, 0.0], np.float32),
    )


@lru_cache
def payload(k: int, quantization: str, info: ModelInfo) -> bytes:
    """K random tokens at random positions."""
    rng = np.random.default_rng(k)
    tokens = rng.normal(size=(k, info.token_dim)).astype(np.float32)
    positions = rng.permutation(info.num_tokens)[:k]
    return codec.encode(tokens, positions, quantization, tower_dims=info.tower_dims)


def message(
    session: str = "robot",
    step: int = 0,
    *,
    k: int = 3,
    name: float = 0.0,
    quantization: str = "float32",
    info: ModelInfo = STUB_INFO,
    **changes: Any,
) -> policy_pb2.InferRequest:
    """A valid InferRequest, with some fields changed."""
    fields: dict[str, Any] = {
        "session_id": session,
        "step": step,
        "instruction": "open it",
        "proprio": [name] + [0.0] * (info.proprio_dim - 1),
        "payload": payload(k, quantization, info),
        "model_fingerprint": info.fingerprint,
        "snr_db": 12.5,
        "snr_age_s": 0.01,
        "protocol_version": PROTOCOL_VERSION,
    }
    return policy_pb2.InferRequest(**{**fields, **changes})


class Robot:
    """A plain gRPC client."""

    def __init__(self, target: str, **options: int) -> None:
        named = [(f"grpc.{name}", value) for name, value in options.items()]
        self.channel = grpc.insecure_channel(target, options=[*codec.GRPC_OPTIONS, *named])
        self.stub = policy_pb2_grpc.PolicyServiceStub(self.channel)

    def infer(
        self, request: policy_pb2.InferRequest, timeout_s: float | None = PATIENCE_S
    ) -> policy_pb2.InferResponse:
        return self.stub.Infer(request, timeout=timeout_s)

    def send(self, request: policy_pb2.InferRequest, timeout_s: float = PATIENCE_S) -> Any:
        """A call that is in flight when this returns."""
        return self.stub.Infer.future(request, timeout=timeout_s)

    def refused(
        self, request: policy_pb2.InferRequest, timeout_s: float | None = PATIENCE_S
    ) -> tuple[grpc.StatusCode, str]:
        """Code and message of a call that must not succeed."""
        return refusal_of(self.send(request, timeout_s))

    def __enter__(self) -> Robot:
        return self

    def __exit__(self, *_: object) -> None:
        self.channel.close()


def refusal_of(call: Any) -> tuple[grpc.StatusCode, str]:
    """Code and message of a call that must not succeed."""
    error = call.exception(timeout=PATIENCE_S)
    assert error is not None, "expected a refusal, the call was answered"
    return error.code(), error.details()


def quiet_port() -> int:
    """A port that is free, and stays it until a test takes it: outside the range from which systems
    give ports to whoever asks for any, and to connections."""
    while True:
        port = random.SystemRandom().randrange(20_000, 30_000)
        with contextlib.suppress(OSError), socket.create_server(("127.0.0.1", port)):
            return port


def eventually(claim: Callable[[], Any], timeout_s: float = PATIENCE_S) -> Any:
    """The first true value of ``claim``, asked again and again until a deadline."""
    deadline_s = time.monotonic() + timeout_s
    while not (value := claim()):
        assert time.monotonic() < deadline_s, "it never came true"
        time.sleep(0.005)
    return value
