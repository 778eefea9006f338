"""What the cloud half needs to finish one forward pass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from torch import Tensor


@dataclass(frozen=True)
class PolicyRequest:
    """One observation as it arrives in the cloud.

    Attributes:
        tokens: (K, D) float32 pre-projector tokens, any K from 1 to N, in any order.
        positions: (K,) integer positions in the unpruned sequence, 0 .. N-1, no repeats.
        instruction: the spoken-language instruction, or its prompt's token ids.
        proprio: (P,) raw proprioception in the world's units, or None where the model takes none.
    """

    tokens: NDArray[np.float32] | Tensor
    positions: NDArray[np.integer] | Tensor
    instruction: str | Sequence[int]
    proprio: NDArray[np.float32] | None = None


@dataclass(frozen=True)
class ImageRequest:
    """One observation of a robot that lets the cloud see.

    Attributes:
        images: uint8 (H, W, 3) RGB, one per view in the model's order.
        instruction: as in :class:`PolicyRequest`.
        proprio: as in :class:`PolicyRequest`.
    """

    images: Sequence[NDArray[np.uint8]]
    instruction: str | Sequence[int]
    proprio: NDArray[np.float32] | None = None


AnyRequest: TypeAlias = PolicyRequest | ImageRequest
"""What a server may be asked: to finish a forward pass, or to do it all."""
