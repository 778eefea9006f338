"""Stand-ins for what surrounds a client: an edge model of NumPy, transports, and a small server."""

from __future__ import annotations

import socket
import threading
import zlib
from collections.abc import Callable, Iterator, Sequence
from concurrent import futures
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import grpc
import numpy as np

from comvla import codec, handshake
from comvla.errors import InstructionError
from comvla.load_hints import LoadHints
from comvla.model_info import ModelInfo
from comvla.v1 import policy_pb2_grpc
from comvla.v1.policy_pb2 import (
    GetModelRequest,
    GetModelResponse,
    InferRequest,
    InferResponse,
    LoadHint,
    ServerTimings,
)
from comvla_client import AsyncComVLAClient, ComVLAClient, LinkProfile, TransportError

INFO = ModelInfo(
    name="stub",
    fingerprint="5eed",
    num_tokens=32,
    token_dim=12,
    tower_dims=(8, 4),
    grid=(2, 4, 4),
    image_size=(16, 16),
    action_horizon=8,
    action_dim=4,
    proprio_dim=3,
    max_prompt_tokens=8,
    delta_actions=(True, True, True, False),
)
WORDS = "push the drawer shut"
# 96 bits a token at INT8: about 18 tokens at 10 dB.
NARROW = LinkProfile(bandwidth_hz=10e3, period_s=0.05, efficiency=1.0)


class StubEdge:
    """An edge model in NumPy, as quick as it is blind."""

    def __init__(self, info: ModelInfo = INFO) -> None:
        self.info = info
        rng = np.random.default_rng(7)
        self._pixels = rng.standard_normal((48, info.token_dim)).astype(np.float32)
        self._space = rng.standard_normal((info.token_dim, 16)).astype(np.float32)
        self.calls: list[str] = []

    def encode(self, images: Sequence[np.ndarray]) -> np.ndarray:
        self.calls.append("encode")
        stack = np.stack(images).astype(np.float32) / 255.0
        views, side = len(images), 4
        cells = stack.reshape(views, side, 4, side, 4, 3).transpose(0, 1, 3, 2, 4, 5)
        return cells.reshape(views * side * side, 48) @ self._pixels

    def project(self, tokens: np.ndarray) -> np.ndarray:
        self.calls.append("project")
        return tokens @ self._space

    def text_queries(self, instruction: str) -> np.ndarray:
        self.calls.append("text_queries")
        words = instruction.split()
        if len(words) > self.info.max_prompt_tokens:
            raise InstructionError(f"at most {self.info.max_prompt_tokens} words, got {len(words)}")
        seeds = [zlib.crc32(word.encode()) for word in words]
        rows = [np.random.default_rng(seed).standard_normal(16) for seed in seeds]
        return np.array(rows, dtype=np.float32)

    def flops(self, num_queries: int = 0) -> float:
        return 1000.0 + num_queries


def observation(seed: int = 0) -> dict[str, Any]:
    """An observation that fits :data:`INFO`."""
    rng = np.random.default_rng(seed)
    images = [rng.integers(0, 256, (16, 16, 3), dtype=np.uint8) for _ in range(2)]
    return {"images": images, "proprio": rng.standard_normal(3)}


def model_response(info: ModelInfo = INFO, **changes: Any) -> GetModelResponse:
    """What a server of ``info`` says in the handshake."""
    response = handshake.to_response(
        info,
        quantizations=codec.QUANTIZATIONS,
        max_request_bytes=changes.pop("max_request_bytes", 8 << 20),
        server_version="test",
    )
    for name, value in changes.items():
        setattr(response, name, value)
    return response


def chunk_of(request: InferRequest, info: ModelInfo = INFO) -> np.ndarray:
    """The stub policy: every action tells its step, its row, and how many tokens came."""
    tokens, positions = codec.decode(request.payload)
    actions = np.zeros((info.action_horizon, info.action_dim), dtype=np.float32)
    actions[:, 0] = request.step + 1
    actions[:, 1] = np.arange(info.action_horizon)
    actions[:, 2] = len(positions)
    actions[:, 3] = float(tokens.sum())
    return actions


def answer(
    request: InferRequest, info: ModelInfo = INFO, suggested_tokens: int = 0
) -> InferResponse:
    """A well-formed response to ``request``."""
    _, positions = codec.decode(request.payload)
    return InferResponse(
        session_id=request.session_id,
        step=request.step,
        actions=chunk_of(request, info).ravel().tolist(),
        action_horizon=info.action_horizon,
        action_dim=info.action_dim,
        tokens_used=len(positions),
        batch_size=3,
        cloud_flops=5e9,
        timings=ServerTimings(decode_s=0.001, queue_s=0.002, predict_s=0.003, total_s=0.006),
        load=LoadHint(queue_depth=1, utilization=0.5, suggested_tokens=suggested_tokens),
        model_fingerprint=info.fingerprint,
    )


class StubTransport:
    """Answers in this process. ``script`` decides each call; what it holds too little of succeeds.

    Script entries: an exception to raise, or a function of the request that gives the response.
    """

    def __init__(self, *script: Any, info: ModelInfo = INFO, model: Any = None) -> None:
        self.script = list(script)
        self.info = info
        self.model = model if model is not None else model_response(info)
        self.requests: list[InferRequest] = []
        self.timeouts_s: list[float] = []
        self.closed = False

    def get_model(self, timeout_s: float) -> GetModelResponse:
        if isinstance(self.model, Exception):
            raise self.model
        return self.model

    def infer(self, request: InferRequest, timeout_s: float) -> InferResponse:
        self.requests.append(request)
        self.timeouts_s.append(timeout_s)
        action = self.script.pop(0) if self.script else None
        if isinstance(action, Exception):
            raise action
        return answer(request, self.info) if action is None else action(request)

    def close(self) -> None:
        self.closed = True


class AsyncStubTransport:
    """:class:`StubTransport` with awaitable calls."""

    def __init__(self, *script: Any, info: ModelInfo = INFO, model: Any = None) -> None:
        self.inner = StubTransport(*script, info=info, model=model)

    async def get_model(self, timeout_s: float) -> GetModelResponse:
        return self.inner.get_model(timeout_s)

    async def infer(self, request: InferRequest, timeout_s: float) -> InferResponse:
        return self.inner.infer(request, timeout_s)

    async def close(self) -> None:
        self.inner.close()


def fault(
    code: str, message: str = "as scripted", hints: LoadHints | None = None
) -> TransportError:
    """A failed call."""
    return TransportError(code, message, hints)


class StubService(policy_pb2_grpc.PolicyServiceServicer):
    """A policy server in a few lines.

    Attributes:
        model: what GetModel answers.
        before: called before each Infer with (request, context); may block or abort.
        requests: what Infer received.
    """

    def __init__(self, info: ModelInfo = INFO) -> None:
        self.info = info
        self.model = model_response(info)
        self.before: Callable[[InferRequest, grpc.ServicerContext], None] | None = None
        self.requests: list[InferRequest] = []

    def GetModel(self, request: GetModelRequest, context: Any) -> GetModelResponse:
        return self.model

    def Infer(self, request: InferRequest, context: Any) -> InferResponse:
        self.requests.append(request)
        if self.before is not None:
            self.before(request, context)
        if request.model_fingerprint != self.info.fingerprint:
            context.abort(grpc.StatusCode.FAILED_PRECONDITION, "another model")
        return answer(request, self.info)


@contextmanager
def serving(service: StubService | None = None, port: int = 0) -> Iterator[tuple[str, Any]]:
    """Runs ``service`` on a real socket; gives its target and itself."""
    service = service or StubService()
    pool = futures.ThreadPoolExecutor(max_workers=64)
    server = grpc.server(pool, options=[*codec.GRPC_OPTIONS, ("grpc.so_reuseport", 0)])
    policy_pb2_grpc.add_PolicyServiceServicer_to_server(service, server)
    bound = server.add_insecure_port(f"127.0.0.1:{port}")
    server.start()
    try:
        yield f"127.0.0.1:{bound}", service
    finally:
        server.stop(grace=None).wait()
        pool.shutdown(wait=True)


@contextmanager
def reserved_port() -> Iterator[int]:
    """A port that one server after another may take, and nothing else on this machine.

    Who only closes a port and binds it again later may find it taken meanwhile, by a listener or an
    outgoing connection. A socket that is bound and does not listen keeps those away; calls are refused.
    """
    with socket.socket() as keeper:
        keeper.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        keeper.bind(("127.0.0.1", 0))
        yield int(keeper.getsockname()[1])


def set_deadline(client: ComVLAClient | AsyncComVLAClient, deadline_s: float) -> None:
    """What the steps to come have: much where an answer is meant to come, little where none can."""
    client._core.deadline_s = deadline_s


def never_answer(request: InferRequest, context: grpc.ServicerContext) -> None:
    """For :attr:`StubService.before`: the call is accepted, and ends only when it is given up."""
    given_up = threading.Event()
    if context.add_callback(given_up.set):
        given_up.wait()


def other_model(**changes: Any) -> ModelInfo:
    """:data:`INFO` with some fields changed."""
    return replace(INFO, **changes)
