"""Whether two checkpoints see alike, so that a robot with the edge half of one can work with the other's cloud half."""

from __future__ import annotations

import hashlib
import json

from comvla_vla.checkpoints.accounting import half_shapes
from comvla_vla.checkpoints.opened import Checkpoint


def edge_identity(checkpoint: Checkpoint) -> str | None:
    """Hex digest over everything that the edge half consists of, by the digests that lie beside the weights.

    Two checkpoints of which it is the same differ in their cloud halves alone: after training that left the towers,
    the projector and the text embedding as they were, for example.

    Returns:
        None where the checkpoint does not say enough: no digests, or the cloud half of a split.
    """
    names = half_shapes("edge", checkpoint.config)
    digests = checkpoint.digests or {}
    if not all(name in digests for name in names):
        return None
    content = [
        checkpoint.config.to_dict(),
        checkpoint.tokenizer,
        sorted((name, digests[name]) for name in names),
    ]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
