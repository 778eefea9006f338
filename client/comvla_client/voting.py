"""Votes beyond the paper: several for each query, spread over the picture, or over the cameras.

Hard voting names at most one token per query, and a budget is often larger; what fills the rest is
then a tie-break. Each selector here is one answer to that.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import numpy.typing as npt

from comvla_client.arrays import NumpyArray, to_numpy
from comvla_client.scoring import Importance, hard_importance
from comvla_client.selection import (
    HardVoting,
    ScoringContext,
    Selector,
    TieBreak,
    Voting,
    by_attention,
    select,
)

_SKETCH_SEED = 20_240_229


class MultiVoting(Voting):
    """Each query votes for its ``m`` best tokens: I_j = Σ_i 1[j ∈ top_m(h_iᵀ v)]; m = 1 is Eq. (3).

    Args:
        votes_per_query: m; at most N.
        tie_break: second key where votes are equal.
    """

    def __init__(self, votes_per_query: int = 3, tie_break: TieBreak = by_attention) -> None:
        super().__init__(tie_break)
        self.votes_per_query = votes_per_query

    def importance(self, context: ScoringContext) -> Importance:
        """Votes of the instruction's queries for the projected tokens."""
        votes_per_query = min(self.votes_per_query, context.tokens.shape[0])
        return hard_importance(context.queries, context.language_tokens, votes_per_query)


class DiverseVoting(MultiVoting):
    """Votes, then diversity: of what was voted for, next comes what is important and unlike what went before.

    Maximal marginal relevance (Carbonell and Goldstein, SIGIR 1998) over the voted tokens:
    next = argmax_j λ·r_j − (1 − λ)·max_{s sent} cos(z_j, z_s), with r the importance scaled to at most 1 and z
    a random projection of the token to few dimensions, less the candidates' mean, which all tokens share.
    What nobody voted for follows by attention.

    Args:
        votes_per_query: m of :class:`MultiVoting`.
        relevance: λ in [0, 1]; 1 is :class:`MultiVoting`.
        sketch_dim: dimensions of z.
        candidates: tokens that are compared at most, most voted first; the order takes under a millisecond then.

    Raises:
        ValueError: a relevance outside [0, 1].
    """

    def __init__(
        self,
        votes_per_query: int = 3,
        relevance: float = 0.7,
        sketch_dim: int = 32,
        candidates: int = 128,
    ) -> None:
        super().__init__(votes_per_query)
        if not 0.0 <= relevance <= 1.0:
            raise ValueError(f"expected a relevance in [0, 1], got {relevance}")
        self.relevance = relevance
        self.sketch_dim = sketch_dim
        self.candidates = candidates
        self._projection: npt.NDArray[np.float32] = np.zeros((0, sketch_dim), dtype=np.float32)

    def rank(self, context: ScoringContext) -> NumpyArray:
        """All positions: voted ones by marginal relevance, then the others by attention."""
        importance = self.importance(context)
        order = to_numpy(select(importance, context.tokens.shape[0], self.tie_break), np.int32)
        votes = to_numpy(importance.votes, np.float32)
        voted = min(int((votes > 0).sum()), self.candidates)
        candidates = order[:voted]
        attention = to_numpy(importance.attention, np.float32)[candidates]
        # Attention settles equal votes here as it does in the order: it stays below one vote.
        score = votes[candidates] + attention / (1.0 + attention.sum())
        sketch = self.sketch(to_numpy(context.language_tokens[candidates], np.float32))
        chosen = marginal_relevance(score / score.max(), sketch @ sketch.T, self.relevance)
        return np.concatenate([candidates[chosen], order[voted:]])

    def sketch(self, tokens: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Unit vectors (C, sketch_dim) whose products are about the cosines of the centred tokens (C, d)."""
        width = tokens.shape[1]
        if len(self._projection) != width:
            signs = np.random.default_rng(_SKETCH_SEED).integers(0, 2, (width, self.sketch_dim))
            self._projection = (2 * signs - 1).astype(np.float32)
        sketch: npt.NDArray[np.float32] = tokens @ self._projection
        sketch -= sketch.mean(axis=0)
        sketch /= np.maximum(np.linalg.norm(sketch, axis=1, keepdims=True), 1e-12)
        return sketch


def marginal_relevance(
    relevance: npt.NDArray[np.float32], likeness: npt.NDArray[np.float32], weight: float
) -> npt.NDArray[np.intp]:
    """The greedy order of maximal marginal relevance.

    Args:
        relevance: (C,) of each candidate.
        likeness: (C, C) of each two.
        weight: λ of relevance against likeness to what was chosen before.

    Returns:
        (C,) all candidates; equals by index.
    """
    order = np.empty(len(relevance), dtype=np.intp)
    gain, penalty = weight * relevance, (1.0 - weight) * likeness
    nearest = np.full(len(relevance), -np.inf, dtype=np.float32)
    marginal = gain.copy()
    for place in range(len(order)):
        order[place] = best = marginal.argmax()
        np.maximum(nearest, penalty[best], out=nearest)
        np.subtract(gain, nearest, out=marginal)
        gain[best] = -np.inf
        marginal[best] = -np.inf
    return order


class ViewQuotas:
    """A fixed share of every budget for each camera, whatever the votes say.

    Within a view the tokens keep the order of ``base``. Views take turns so that of the first K tokens, for every
    K, view v holds K · s_v but for rounding: the next token comes from the view furthest below its share.

    Args:
        base: who ranks within the views; hard voting by default.
        shares: s_v of each view, summing to 1; equal by default.

    Raises:
        ValueError: shares that are negative or do not sum to 1.
    """

    uses_language: ClassVar[bool] = True
    sends_all: ClassVar[bool] = False

    def __init__(
        self, base: Selector | None = None, shares: tuple[float, ...] | None = None
    ) -> None:
        if shares is not None and (min(shares) < 0 or abs(sum(shares) - 1) > 1e-6):
            raise ValueError(f"expected shares of at least 0 that sum to 1, got {shares}")
        self.base: Selector = HardVoting() if base is None else base
        self.shares = shares

    def rank(self, context: ScoringContext) -> NumpyArray:
        """All positions, the views taking turns."""
        views = context.grid[0]
        shares = self.shares or (1 / views,) * views
        if len(shares) != views:
            raise ValueError(f"expected one share per view ({views}), got {shares}")
        ranking = self.base.rank(context)
        per_view = context.grid[1] * context.grid[2]
        waiting = [ranking[ranking // per_view == view][::-1].tolist() for view in range(views)]
        owed = [0.0] * views
        order = []
        for _ in range(len(ranking)):
            owed = [debt + share for debt, share in zip(owed, shares, strict=True)]
            view = max((v for v in range(views) if waiting[v]), key=owed.__getitem__)
            owed[view] -= 1.0
            order.append(waiting[view].pop())
        return np.array(order, dtype=np.int32)

    def reset(self) -> None:
        """Begins a new episode, for a base with a memory."""
        forget = getattr(self.base, "reset", None)
        if forget is not None:
            forget()
