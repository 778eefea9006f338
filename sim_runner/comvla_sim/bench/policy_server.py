"""The real server in a process of its own: with a model, or with one that costs nothing."""

from __future__ import annotations

from collections.abc import Mapping
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from comvla.model_info import ModelInfo
from comvla_server.background import BackgroundServer
from comvla_server.engine import CloudHalf, Engine
from comvla_server.process import settle, take_turns
from comvla_server.settings import ServerSettings
from comvla_sim.bench.processes import announce, wait_for_end
from comvla_sim.bench.stub_model import StubModel
from comvla_vla.request import PolicyRequest

NO_MODEL = ModelInfo(
    name="no-model",
    fingerprint="0" * 64,
    num_tokens=512,
    token_dim=2176,
    tower_dims=(1024, 1152),
    grid=(2, 16, 16),
    image_size=(224, 224),
    action_horizon=32,
    action_dim=8,
    proprio_dim=8,
    max_prompt_tokens=64,
    delta_actions=(True,) * 7 + (False,),
)
"""Full-size tokens, and a chunk of 32 x 8 float32: one KiB."""


class NoModel:
    """Answers zeros at once, so that only the transport is measured."""

    info = NO_MODEL

    def __init__(self) -> None:
        self._actions = np.zeros((NO_MODEL.action_horizon, NO_MODEL.action_dim), dtype=np.float32)

    def predict(self, requests: list[PolicyRequest]) -> list[NDArray[np.float32]]:
        """Zeros (H, A) for each request."""
        return [self._actions] * len(requests)

    def flops(self, num_tokens: int, instruction: object) -> float:
        """None."""
        return 0.0

    def check_instruction(self, instruction: str) -> None:
        """Accepts every instruction."""


def serve(
    lifeline: Connection,
    model: str,
    max_batch: int,
    threads: int,
    settings: Mapping[str, Any] | None = None,
) -> None:
    """Serves until the benchmark ends; announces the gRPC address and the admin address.

    Args:
        lifeline: to the benchmark.
        model: ``"none"``, ``"stub"``, ``"random"``, or what ``comvla_vla.load_cloud`` takes.
        max_batch: most requests in one forward pass.
        threads: of torch, 0 for its own choice.
        settings: of the server, where they differ from its defaults.
    """
    chosen = ServerSettings(max_batch=max_batch, **(settings or {}))
    take_turns()
    with BackgroundServer(Engine(_cloud_half(model, threads)), chosen) as server:
        settle()
        announce(lifeline, f"{server.target} {server.admin_url}")
        wait_for_end(lifeline)


def _cloud_half(model: str, threads: int) -> CloudHalf:
    if model == "none":
        return NoModel()
    if model == "stub":
        return StubModel()
    import torch

    import comvla_vla

    if threads:
        torch.set_num_threads(threads)
    if model == "random":
        return comvla_vla.random_policy()[1]
    return comvla_vla.load_cloud(model)
