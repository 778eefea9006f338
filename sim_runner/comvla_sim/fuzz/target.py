"""The model behind the fuzzed server: costs nothing, and its answers tell what it was asked."""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from multiprocessing.connection import Connection

import numpy as np
from numpy.typing import NDArray

from comvla import codec
from comvla.errors import DependencyError, InstructionError
from comvla.model_info import PROTOCOL_VERSION, ModelInfo
from comvla.v1 import policy_pb2
from comvla_server.background import BackgroundServer
from comvla_server.engine import Engine
from comvla_server.image_decoders import DECODERS, ImageDecoder
from comvla_server.settings import ServerSettings
from comvla_sim.bench.processes import announce
from comvla_vla.request import ImageRequest, PolicyRequest

INFO = ModelInfo(
    name="fuzzed",
    fingerprint="f0229ed",
    num_tokens=128,
    token_dim=24,
    tower_dims=(8, 16),
    grid=(2, 8, 8),
    image_size=(16, 16),
    action_horizon=3,
    action_dim=2,
    proprio_dim=4,
    max_prompt_tokens=32,
    delta_actions=(True, False),
)
CODINGS = ("jpeg", "webp", "avif", "h264")
_LOOKS_EVERY_S = 0.05
SETTINGS = ServerSettings(max_request_bytes=64 * 1024, max_sessions=256, request_timeout_s=2.0)


class FuzzedCloud:
    """Answers with a number that depends on every token, every position and the proprioception."""

    info = INFO

    def predict(self, requests: list[PolicyRequest]) -> list[NDArray[np.float32]]:
        """(H, A) for each request."""
        return [actions_for(request) for request in requests]

    def flops(self, num_tokens: int, instruction: object) -> float:
        """Made up."""
        return 1000.0 * num_tokens

    def check_instruction(self, instruction: str) -> None:
        """As a real model does, refuses what has no words."""
        if not instruction.strip():
            raise InstructionError("the instruction is empty: say what the robot should do")


class FuzzedVision:
    """Turns decoded pictures into tokens without a model."""

    info = INFO
    any_image_size = False

    def __init__(self) -> None:
        self.decoders = _decoders()

    def encode(
        self, images: Sequence[NDArray[np.uint8]], instruction: str | Sequence[int]
    ) -> NDArray[np.float32]:
        """(N, D): each token is the mean of its picture."""
        means = np.array([image.mean() for image in images], np.float32) / 255.0
        per_view = INFO.num_tokens // INFO.grid[0]
        return np.repeat(np.repeat(means, per_view)[:, None], INFO.token_dim, axis=1)

    def flops(self, request: ImageRequest) -> float:
        """Made up."""
        return 1e6


def _decoders() -> dict[str, ImageDecoder]:
    found: dict[str, ImageDecoder] = {}
    for coding in CODINGS:
        try:
            found[coding] = DECODERS[coding]()
        except DependencyError:
            continue
    return found


def engine() -> Engine:
    """What the fuzzed server runs."""
    return Engine(FuzzedCloud(), FuzzedVision())


def actions_for(request: PolicyRequest) -> NDArray[np.float32]:
    """The answer to a request, (H, A); bounded, so that no valid request overflows it."""
    weights = np.asarray(request.positions, np.float64) + 1.0
    value = float(np.tanh(weights @ np.asarray(request.tokens, np.float64).mean(axis=1) / 1e3))
    if request.proprio is not None:
        value += float(np.tanh(np.asarray(request.proprio, np.float64).sum()))
    shape = (INFO.action_horizon, INFO.action_dim)
    return (value + np.arange(np.prod(shape)).reshape(shape)).astype(np.float32)


def expected_actions(request: policy_pb2.InferRequest) -> NDArray[np.float32]:
    """What a valid request with tokens has to be answered."""
    tokens, positions = codec.decode(request.payload)
    proprio = np.asarray(request.proprio, np.float32)
    return actions_for(PolicyRequest(tokens, positions, request.instruction, proprio))


def valid_request(session: str, step: int, payload: bytes) -> policy_pb2.InferRequest:
    """A request that has to be answered."""
    return policy_pb2.InferRequest(
        session_id=session,
        step=step,
        instruction="open the green drawer",
        proprio=[0.1, -0.2, 0.3, 0.0],
        payload=payload,
        model_fingerprint=INFO.fingerprint,
        snr_db=12.5,
        snr_age_s=0.01,
        protocol_version=PROTOCOL_VERSION,
    )


def serve(lifeline: Connection) -> None:
    """The real server in this process, until the lifeline is cut; announces where it listens.

    Where gRPC stops taking calls before, announces what it raised, and ends.
    """
    logging.disable(logging.CRITICAL)  # a hundred thousand refusals
    with BackgroundServer(engine(), SETTINGS) as server:
        announce(lifeline, f"{server.target} {server.admin_url} {os.getpid()}")
        while not lifeline.poll(_LOOKS_EVERY_S):
            if server.server.port_lost.is_set():
                server.stop(0.0)
                announce(lifeline, type(server.server.port_lost_by).__name__)
                return
