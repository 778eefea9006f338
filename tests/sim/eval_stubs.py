"""Stand-ins for evaluations: a policy that is the expert, a transport that listens, made-up rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from comvla import codec
from comvla.model_info import ModelInfo
from comvla.v1.policy_pb2 import GetModelResponse, InferRequest, InferResponse
from comvla_client.transport import Transport
from comvla_sim.training.recording import clean_chunk
from comvla_sim.worlds import World
from comvla_vla import PolicyRequest


class ExpertCloud:
    """A cloud half that ignores its tokens and does what the expert would do for the instruction."""

    def __init__(self, info: ModelInfo, world: World) -> None:
        self.info = info
        self._world = world

    def predict(self, requests: Sequence[PolicyRequest]) -> list[npt.NDArray[np.float32]]:
        tasks = {task.instruction: task for task in self._world.tasks}
        horizon = self.info.action_horizon
        return [
            clean_chunk(self._world, tasks[str(request.instruction)], horizon).astype(np.float32)
            for request in requests
        ]

    def flops(self, num_tokens: int, instruction: str | Sequence[int]) -> float:
        return 1000.0 * num_tokens

    def check_instruction(self, instruction: str) -> None:
        """Understands everything."""


class ListeningTransport:
    """Keeps a copy of every request that passes."""

    def __init__(self, transport: Transport) -> None:
        self._transport = transport
        self.requests: list[InferRequest] = []

    def positions(self, index: int) -> list[int]:
        return codec.decode(self.requests[index].payload)[1].tolist()

    def get_model(self, timeout_s: float) -> GetModelResponse:
        return self._transport.get_model(timeout_s)

    def infer(self, request: InferRequest, timeout_s: float) -> InferResponse:
        copy = InferRequest()
        copy.CopyFrom(request)
        self.requests.append(copy)
        return self._transport.infer(request, timeout_s)

    def close(self) -> None:
        self._transport.close()


SETTINGS: dict[str, Any] = {
    "world": "tabletop",
    "seed": 3,
    "model": "comvla-mini",
    "model_fingerprint": "0123456789abcdef",
    "quantization": "int8",
    "link": "ideal",
    "versions": {"comvla": "0.1.0"},
}


def made_up_row(
    *,
    condition: str = "normal",
    method: str = "hard_voting",
    k: int = 16,
    task: str = "drawer-open",
    episode: int = 0,
    success: bool = True,
    other_success: bool = False,
    **settings: Any,
) -> dict[str, Any]:
    """A row as ``comvla-sim eval`` writes it, with chosen outcome."""
    seed = {**SETTINGS, **settings}["seed"]
    return {
        "format": 1,
        "condition": condition,
        "method": method,
        "k": k,
        "task": task,
        "episode": episode,
        "layout_seed": 1_000_000 + 10_000 * seed + episode,
        "instruction": f"please {task}",
        "spoken": f"please {task}",
        "heard": f"please {task}",
        "other_task": "lever-down",
        "success": success,
        "other_success": other_success,
        "steps": 80 if success else 160,
        "queries": 10,
        "fallbacks": 0,
        "payload_bytes": 960 * k,
        "encoded_bytes": 1020 * k,
        "framed_bytes": 1020 * k + 1000,
        "edge_flops": 1e9,
        "cloud_flops": 1e7 * k,
        "selection": {
            "frames": 10,
            "distinct_votes": 90,
            "overlap": 2.5,
            "object_frames": 10,
            "object_hits": 9,
            "object_frames_by_view": [10, 8],
            "object_hits_by_view": [9, 6],
        },
        "wall_s": 0.5,
        "settings": {**SETTINGS, **settings},
        "environment": {"command": "comvla-sim eval", "versions": {"torch": "2.13.0"}},
    }
