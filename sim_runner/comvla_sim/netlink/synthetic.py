"""The paper's sizes without its weights: 512 tokens of 2176 values, and a cloud that answers at once.

On a link, only bytes and moments count. The edge half has its tokens ready and the cloud half its
actions, so that what a run measures is the link, the client and the server, not a model.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from comvla.model_info import ModelInfo
from comvla_sim.bench.policy_server import NO_MODEL
from comvla_vla.request import PolicyRequest

OFT_SIZES: ModelInfo = replace(
    NO_MODEL,
    name="synthetic-oft",
    action_horizon=8,
    action_dim=7,
    proprio_dim=8,
    delta_actions=(True,) * 6 + (False,),
)
"""OpenVLA-OFT on LIBERO: N = 512, D = 1024 + 1152, chunks of 8 actions of 7 values."""

INSTRUCTION = "put the bowl on the plate"
_LANGUAGE_DIM = 64


class SyntheticEdge:
    """An edge half whose tokens are random and ready.

    Args:
        info: sizes.
        seed: of the tokens.
    """

    def __init__(self, info: ModelInfo = OFT_SIZES, seed: int = 0) -> None:
        self.info = info
        rng = np.random.default_rng(seed)
        self._tokens = rng.standard_normal((info.num_tokens, info.token_dim), np.float32)
        self._projected = rng.standard_normal((info.num_tokens, _LANGUAGE_DIM), np.float32)

    def encode(self, images: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
        """The same tokens (N, D), whatever the images."""
        return self._tokens

    def project(self, tokens: Any) -> NDArray[np.float32]:
        """Their places (N, 64) in a made-up language space."""
        return self._projected

    def text_queries(self, instruction: str) -> NDArray[np.float32]:
        """One query (Q, 64) for each word."""
        seeds = [zlib.crc32(word.encode()) for word in instruction.split()]
        rows = [np.random.default_rng(s).standard_normal(_LANGUAGE_DIM) for s in seeds]
        return np.array(rows, dtype=np.float32)

    def flops(self, num_queries: int = 0) -> float:
        """None."""
        return 0.0


class SyntheticCloud:
    """A cloud half that answers at once.

    Args:
        info: sizes.
    """

    def __init__(self, info: ModelInfo = OFT_SIZES) -> None:
        self.info = info
        self._calls = 0

    def predict(self, requests: list[PolicyRequest]) -> list[NDArray[np.float32]]:
        """Chunks (H, A), each with its number in column 0 and its row in column 1."""
        chunks = []
        for _ in requests:
            self._calls += 1
            chunk = np.zeros((self.info.action_horizon, self.info.action_dim), np.float32)
            chunk[:, 0] = self._calls
            chunk[:, 1] = np.arange(self.info.action_horizon)
            chunks.append(chunk)
        return chunks

    def flops(self, num_tokens: int, instruction: object) -> float:
        """None."""
        return 0.0

    def check_instruction(self, instruction: str) -> None:
        """Accepts every instruction."""


def observation(info: ModelInfo, seed: int = 0) -> Mapping[str, Any]:
    """An observation that fits, of noise."""
    rng = np.random.default_rng(seed)
    height, width = info.image_size
    views = info.grid[0]
    images = [rng.integers(0, 256, (height, width, 3), dtype=np.uint8) for _ in range(views)]
    return {"images": images, "proprio": rng.standard_normal(info.proprio_dim).astype(np.float32)}
