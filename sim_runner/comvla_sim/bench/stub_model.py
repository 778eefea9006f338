"""A model whose forward pass takes a fixed time and no processor: shows the scheduler and nothing else."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from comvla.model_info import ModelInfo
from comvla_vla.request import PolicyRequest

STUB_INFO = ModelInfo(
    name="stub-of-fixed-time",
    fingerprint="57" * 16,
    num_tokens=512,
    token_dim=96,
    tower_dims=(96,),
    grid=(2, 16, 16),
    image_size=(128, 128),
    action_horizon=8,
    action_dim=4,
    proprio_dim=4,
    max_prompt_tokens=32,
    delta_actions=(True, True, True, False),
)
"""comvla-mini's shapes."""


@dataclass(frozen=True)
class StubTimes:
    """Seconds of a pass: ``fixed_s + request_s · requests + token_s · tokens``."""

    fixed_s: float = 0.020
    request_s: float = 0.004
    token_s: float = 0.0001


class StubModel:
    """Sleeps, then answers zeros.

    Args:
        times: how long.
    """

    def __init__(self, times: StubTimes | None = None) -> None:
        self.info = replace(STUB_INFO)
        self._times = times or StubTimes()
        self._actions = np.zeros((STUB_INFO.action_horizon, STUB_INFO.action_dim), np.float32)

    def predict(self, requests: list[PolicyRequest]) -> list[NDArray[np.float32]]:
        """Zeros (H, A) for each request, when their time is over."""
        tokens, times = sum(len(r.positions) for r in requests), self._times
        time.sleep(times.fixed_s + times.request_s * len(requests) + times.token_s * tokens)
        return [self._actions] * len(requests)

    def flops(self, num_tokens: int, instruction: object) -> float:
        """None."""
        return 0.0

    def check_instruction(self, instruction: str) -> None:
        """Accepts every instruction."""
