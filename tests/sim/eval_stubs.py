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
from comvla_sim.experiments.link_case import LinkCase
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
    "versions": {"comvla": "0.1.0"},
}


def made_up_link_use(overruns: Sequence[float]) -> dict[str, Any]:
    """What became of an episode's queries: two more of them sent nothing."""
    lost = sum(ratio > 1 for ratio in overruns)
    return {
        "sent": len(overruns),
        "answered": len(overruns) - lost,
        "lost": lost,
        "no_link": 2,
        "waited_periods": 0,
        "held_periods": lost + 2,
        "offered_bytes": 1000 * len(overruns),
        "delivered_bytes": 800 * len(overruns),
        "offered_tokens": 10 * len(overruns),
        "delivered_tokens": 8 * len(overruns),
        "overruns": list(overruns),
        "payload_overruns": [ratio / 2 for ratio in overruns],
    }


def made_up_row(
    *,
    condition: str = "normal",
    method: str = "hard_voting",
    k: int | None = 16,
    task: str = "drawer-open",
    episode: int = 0,
    success: bool = True,
    other_success: bool = False,
    link: LinkCase | None = None,
    overruns: Sequence[float] = (0.5, 0.9, 1.5, 4.0),
    **settings: Any,
) -> dict[str, Any]:
    """A row as ``comvla-sim eval`` writes it, with chosen outcome."""
    seed = {**SETTINGS, **settings}["seed"]
    return {
        "format": 2,
        "condition": condition,
        "method": method,
        "k": k,
        "task": task,
        "episode": episode,
        "link": None if link is None else link.to_dict(),
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
        "payload_bytes": 960 * (k or 10),
        "encoded_bytes": 1020 * (k or 10),
        "framed_bytes": 1020 * (k or 10) + 1000,
        "edge_flops": 1e9,
        "cloud_flops": 1e7 * (k or 10),
        "selection": {
            "frames": 10,
            "distinct_votes": 90,
            "overlap": 2.5,
            "object_frames": 10,
            "object_hits": 9,
            "object_frames_by_view": [10, 8],
            "object_hits_by_view": [9, 6],
        },
        "channel_seed": None if link is None else 17,
        "link_use": None if link is None else made_up_link_use(overruns),
        "wall_s": 0.5,
        "settings": {**SETTINGS, **settings},
        "environment": {"command": "comvla-sim eval", "versions": {"torch": "2.13.0"}},
    }
