"""What the client needs of an edge model. ``comvla_vla.load_edge`` gives one; any object that fits will do."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from comvla.model_info import ModelInfo
from comvla_client.arrays import Array


class EdgeModel(Protocol):
    """The robot's half of a split model. Arrays may be NumPy or torch."""

    @property
    def info(self) -> ModelInfo:
        """Description that the server's half must match."""
        ...

    def encode(self, images: Sequence[npt.NDArray[np.uint8]]) -> Array:
        """Visual tokens (N, D) of all views, each uint8 (H, W, 3)."""
        ...

    def project(self, tokens: Any) -> Array:
        """Tokens (N, D), of the kind that ``encode`` gives, in the language's space: (N, d)."""
        ...

    def text_queries(self, instruction: str) -> Array:
        """Language queries (Q, d) of an instruction; InstructionError where it has none."""
        ...

    def flops(self, num_queries: int = 0) -> float:
        """Operations of one step on the robot: vision, projection and votes of ``num_queries`` queries."""
        ...
