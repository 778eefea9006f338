"""Other published pruners, as far as they can run on the robot, behind the same interface as the vote.

Both decide for themselves how many tokens they keep, whatever the link carries; the order is most important first all
the same, so that a link which cuts a payload short loses the least. They need weights that only the edge half of a
split OpenVLA-OFT checkpoint carries. FastV ranks inside the backbone and is an option of the cloud half.
"""

from __future__ import annotations

from collections import deque
from typing import ClassVar, Protocol

import numpy as np

from comvla.errors import ObservationError
from comvla.handshake import COMPACT_POSITIONS
from comvla_client.arrays import Array, NumpyArray, to_numpy
from comvla_client.selection import ScoringContext


class PruningEdge(Protocol):
    """What these pruners ask of the edge model; ``comvla_vla.EdgeModel`` has it."""

    def lightvla_scores(self, projected: Array, instruction: str, proprio: NumpyArray) -> Array:
        """(N, N): row i is a visual token, which votes for its largest column."""
        ...

    def text_driven_scores(self, projected: Array, instruction: str) -> Array:
        """(N,): how well the instruction's words fit each visual token."""
        ...


class LightVLA:
    """LightVLA's pruning (LiAutoAD/LightVLA): every token that some token voted for stays.

    The number that stays follows from the picture.
    """

    uses_language: ClassVar[bool] = True
    sends_all: ClassVar[bool] = True

    def rank(self, context: ScoringContext) -> NumpyArray:
        """The kept positions, most votes first, then by index."""
        edge, instruction, proprio = _robot(context, "lightvla")
        scores = edge.lightvla_scores(context.language_tokens, instruction, proprio)
        winners = to_numpy(scores, np.float32).argmax(axis=1)
        votes = np.bincount(winners, minlength=context.tokens.shape[0])
        kept = np.flatnonzero(votes)
        return kept[np.argsort(-votes[kept], kind="stable")].astype(np.int32)


class VLAADP:
    """VLA-ADP's pruning (chen7086/VLA-ADP): the best tokens of each view, while the arm moves far.

    Args:
        ratio: share of all tokens that stays when it prunes.
        view_shares: how those are divided between the views.
        gate: decides from the arm's motion whether to prune; None prunes always.

    Raises:
        ValueError: a ratio outside (0, 1], or shares that do not sum to one.
    """

    uses_language: ClassVar[bool] = True
    sends_all: ClassVar[bool] = True
    wants_run_options: ClassVar[tuple[str, ...]] = (COMPACT_POSITIONS,)

    def __init__(
        self,
        ratio: float = 0.75,
        view_shares: tuple[float, ...] = (0.4, 0.6),
        gate: MotionGate | None = None,
    ) -> None:
        if not 0 < ratio <= 1 or abs(sum(view_shares) - 1) > 1e-6 or min(view_shares) < 0:
            raise ValueError(
                f"expected a ratio in (0, 1] and view_shares that sum to 1, got {ratio} and {view_shares}"
            )
        self._ratio = ratio
        self._view_shares = view_shares
        self._gate = gate

    def rank(self, context: ScoringContext) -> NumpyArray:
        """The kept positions, best score first; all positions in raster order when the gate is shut."""
        edge, instruction, proprio = _robot(context, "vla_adp")
        count = context.tokens.shape[0]
        if self._gate is not None and not self._gate.prunes(proprio[:3]):
            return np.arange(count, dtype=np.int32)
        scores = to_numpy(edge.text_driven_scores(context.language_tokens, instruction), np.float32)
        views = context.grid[0]
        if views != len(self._view_shares):
            raise ValueError(
                f"expected one view share per view ({views}), got {self._view_shares}: "
                "pass view_shares="
            )
        quotas = view_quotas(round(count * self._ratio), self._view_shares)
        per_view = scores.reshape(views, -1)
        size = per_view.shape[1]
        kept = [
            np.argsort(-row, kind="stable")[:quota] + view * size
            for view, (row, quota) in enumerate(zip(per_view, quotas, strict=True))
        ]
        positions = np.concatenate(kept)
        return positions[np.argsort(-scores[positions], kind="stable")].astype(np.int32)

    def reset(self) -> None:
        """Begins a new episode."""
        if self._gate is not None:
            self._gate.reset()


class MotionGate:
    """VLA-ADP's dynamic rule: prune while the arm travels, keep everything while it works on something.

    A window is the time between two steps. Its length d is how far the hand came from its start to its end. Until
    ``window`` of them are known nothing is pruned; afterwards a window that is shorter than both before it shuts the
    gate. After ``most_in_a_row`` pruned steps one keeps everything.

    Args:
        window: windows that are compared, the current one included.
        most_in_a_row: pruned steps before a full one.
    """

    def __init__(self, window: int = 3, most_in_a_row: int = 3) -> None:
        self._distances: deque[float] = deque(maxlen=window)
        self._most_in_a_row = most_in_a_row
        self.reset()

    def reset(self) -> None:
        """Forgets the episode."""
        self._distances.clear()
        self._last: NumpyArray | None = None
        self._in_a_row = 0

    def prunes(self, position: NumpyArray) -> bool:
        """Whether to prune this step.

        Args:
            position: (3,) of the hand now, in metres.
        """
        here = np.asarray(position, dtype=np.float64)
        if self._last is not None:
            self._distances.append(float(np.linalg.norm(here - self._last)))
        self._last = here
        prune = False
        if len(self._distances) == self._distances.maxlen:
            *before, now = self._distances
            prune = now >= min(before)
        if prune and self._in_a_row >= self._most_in_a_row:
            prune = False
        self._in_a_row = self._in_a_row + 1 if prune else 0
        return prune


def view_quotas(kept: int, shares: tuple[float, ...]) -> list[int]:
    """How many of ``kept`` tokens each view may keep: rounded shares; the largest takes what rounding left over."""
    quotas = [max(1, round(kept * share)) for share in shares]
    quotas[shares.index(max(shares))] += kept - sum(quotas)
    return quotas


def _robot(context: ScoringContext, name: str) -> tuple[PruningEdge, str, NumpyArray]:
    """The edge model, instruction and proprioception of a step."""
    if context.edge is None or context.instruction is None or context.proprio is None:
        raise ObservationError(
            f"{name} looks at the edge model, the instruction and proprioception, this context has not all "
            "of them: rank through the client, or set edge=, instruction= and proprio="
        )
    return context.edge, context.instruction, context.proprio
