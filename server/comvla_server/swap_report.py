"""What it means to replace a model: for the robots that use it, for memory, and for how long."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from comvla import handshake
from comvla_server.model_loading import Candidate
from comvla_server.models import Runtime


@dataclass(frozen=True)
class SwapReport:
    """What was replaced by what.

    Attributes:
        model: name under which robots ask for it; empty for one without a name.
        source: the new checkpoint.
        before: fingerprint of the old model.
        after: fingerprint of the new one.
        robots: what it means for them: ``same`` model, ``compatible`` (another cloud half for the
            same edge half), or ``new_edge`` (they have to load another edge half).
        needed_bytes: memory for the new model, beside the old one.
        available_bytes: memory there was; None where nobody tells.
        swapped: False where it was only checked.
        load_s: seconds that loading took, while the old model answered.
        warm_up_s: seconds of the first forward passes, likewise.
        drain_s: seconds until the old model had answered the last call that it had taken.
        freed: whether the old model's memory was given back by then; else that follows.
    """

    model: str
    source: str
    before: str
    after: str
    robots: Literal["same", "compatible", "new_edge"]
    needed_bytes: int
    available_bytes: int | None
    swapped: bool = False
    load_s: float = 0.0
    warm_up_s: float = 0.0
    drain_s: float = 0.0
    freed: bool = False


def compare(old: Runtime, candidate: Candidate) -> SwapReport:
    """What it would mean to replace a model by a checkpoint; nothing is loaded.

    Args:
        old: the model that answers.
        candidate: the checkpoint.
    """
    before, after = old.engine.info, candidate.info
    robots: Literal["same", "compatible", "new_edge"] = "new_edge"
    if handshake.mismatch(before, after) is None:
        robots = "same"
    elif handshake.mismatch(before, replace(after, fingerprint=before.fingerprint)) is None:
        identity = old.engine.edge_identity
        if identity is not None and identity == candidate.edge_identity:
            robots = "compatible"
    return SwapReport(
        model=old.name,
        source=candidate.source,
        before=before.fingerprint,
        after=after.fingerprint,
        robots=robots,
        needed_bytes=candidate.needed_bytes,
        available_bytes=candidate.available_bytes,
    )
