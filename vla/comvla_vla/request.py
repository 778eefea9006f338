"""What the cloud half needs to finish one forward pass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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
