"""Which tokens go first: from importance to an order, and the paper's own rankings.

The tie-break is one function to swap. A new selector is one small class with a row in
:mod:`comvla_client.registry`, where all of them go by a name; docs/selectors.md walks through one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, TypeAlias, overload

import numpy as np

from comvla.errors import ObservationError
from comvla_client.arrays import Array, NumpyArray, is_torch, to_numpy
from comvla_client.scoring import Importance, hard_importance, soft_importance

if TYPE_CHECKING:
    import torch

TieBreak: TypeAlias = Callable[[Importance], Array]
"""Gives a second key (N,), larger first, for tokens with equal votes. What is still equal goes by index."""


def by_attention(importance: Importance) -> Array:
    """The default tie-break: the token that the queries looked at more goes first."""
    return importance.attention


def by_index(importance: Importance) -> Array:
    """No second key: tokens with equal votes stay in raster order."""
    return importance.votes


def by_chance(rng: np.random.Generator) -> TieBreak:
    """A tie-break that shuffles tokens with equal votes: the control for what votes alone are worth.

    Args:
        rng: source of the shuffles; the same seed gives the same orders.
    """

    def key(importance: Importance) -> Array:
        keys = rng.random(importance.votes.shape[0])
        if is_torch(importance.votes):
            return importance.attention.new_tensor(keys)  # type: ignore[union-attr]
        return keys

    return key


@overload
def select(importance: NumpyArray, k: int, tie_break: TieBreak | None = None) -> NumpyArray: ...
@overload
def select(importance: torch.Tensor, k: int, tie_break: TieBreak | None = None) -> torch.Tensor: ...
@overload
def select(importance: Importance, k: int, tie_break: TieBreak | None = None) -> Array: ...
def select(importance: Array | Importance, k: int, tie_break: TieBreak | None = None) -> Array:
    """The positions of the ``k`` most important tokens, most important first (Algorithm 1).

    Args:
        importance: (N,) scores, or an :class:`~comvla_client.scoring.Importance` whose ties are broken.
        k: how many; more than N selects all.
        tie_break: second key where votes are equal, :func:`by_attention` by default. A bare array
            carries no attention, so its ties go by index unless ``tie_break`` says otherwise.

    Returns:
        (min(k, N),) int64 positions, of the importance's own kind (NumPy or torch).

    Raises:
        ValueError: ``k`` is negative, or the importance is not one-dimensional.
    """
    if k < 0:
        raise ValueError(f"expected k >= 0, got {k}")
    if not isinstance(importance, Importance):
        importance = Importance(votes=importance, attention=importance)
    if importance.votes.ndim != 1:
        raise ValueError(f"expected importance (N,), got {tuple(importance.votes.shape)}")
    second = (tie_break or by_attention)(importance)
    votes = importance.votes
    if is_torch(votes) and is_torch(second):
        _refuse_nan(bool(votes.isnan().any() or second.isnan().any()))
        # Two stable sorts, the lesser key first: torch has no lexsort.
        order = second.argsort(descending=True, stable=True)
        return order[votes[order].argsort(descending=True, stable=True)][:k]
    keys = np.asarray(second, dtype=np.float64), np.asarray(votes, dtype=np.float64)
    _refuse_nan(bool(np.isnan(keys).any()))
    return np.lexsort((-keys[0], -keys[1]))[:k]


def _refuse_nan(found: bool) -> None:
    if found:
        raise ObservationError(
            "importance holds NaN, so no order exists: the tokens or the queries are not finite; "
            "check the edge model's weights and its input"
        )


@dataclass(frozen=True)
class ScoringContext:
    """What a selector may look at.

    Attributes:
        tokens: (N, D) visual tokens as they would cross the link.
        projected: (N, d) the same in the language's space; None for selectors that do not use it.
        queries: (Q, d) language queries of the instruction.
        grid: (views, rows, columns) of the tokens.
        rng: seeded anew for every step of every episode, so that a repeated run ranks alike.
        edge: the edge model, for pruners that use its weights.
        instruction: what the robot was told. proprio: (P,) raw proprioception.
    """

    tokens: Array
    projected: Array | None
    queries: Array
    grid: tuple[int, int, int]
    rng: np.random.Generator
    edge: Any = None
    instruction: str | None = None
    proprio: NumpyArray | None = None

    @property
    def language_tokens(self) -> Array:
        """``projected``, for selectors that cannot do without it.

        Raises:
            ValueError: nobody projected the tokens.
        """
        if self.projected is None:
            raise ValueError(
                "this selector scores projected tokens, got projected=None: pass edge.project(tokens), "
                "or set uses_language = True on the selector so that the client projects them"
            )
        return self.projected


class Selector(Protocol):
    """Ranks the tokens of one observation.

    Attributes:
        uses_language: whether the projector has to run; without it the edge saves that work.
        sends_all: whether everything ranked goes, whatever the link carries.

    One with a memory has a method ``reset()`` too, which the client calls when an episode begins. One that was made
    for servers that run the model in some way names that in ``wants_run_options``: where the handshake lacks it, the
    client warns.
    """

    uses_language: ClassVar[bool]
    sends_all: ClassVar[bool]

    def rank(self, context: ScoringContext) -> NumpyArray:
        """Positions to send, most important first: all N, or fewer where it prunes on its own."""
        ...


class Voting:
    """What all ways of voting share: score, then sort with a tie-break.

    Args:
        tie_break: second key where votes are equal.
    """

    uses_language: ClassVar[bool] = True
    sends_all: ClassVar[bool] = False

    def __init__(self, tie_break: TieBreak = by_attention) -> None:
        self.tie_break = tie_break

    def importance(self, context: ScoringContext) -> Importance:
        """Scores (N,) of the tokens, with what breaks their ties."""
        raise NotImplementedError

    def rank(self, context: ScoringContext) -> NumpyArray:
        """All positions by falling importance."""
        importance = self.importance(context)
        return to_numpy(select(importance, context.tokens.shape[0], self.tie_break), np.int32)


class HardVoting(Voting):
    """The paper's ranking, Eq. (3): votes, then summed attention, then index."""

    def importance(self, context: ScoringContext) -> Importance:
        """Votes of the instruction's queries for the projected tokens."""
        return hard_importance(context.queries, context.language_tokens)


class SoftVoting(Voting):
    """The comparison of Table III: summed attention as the score."""

    def importance(self, context: ScoringContext) -> Importance:
        """Attention of the instruction's queries on the projected tokens."""
        return soft_importance(context.queries, context.language_tokens)


class HardVotingRandomTies:
    """Hard votes with ties drawn by lot: what the votes alone are worth without their tie-break."""

    uses_language: ClassVar[bool] = True
    sends_all: ClassVar[bool] = False

    def rank(self, context: ScoringContext) -> NumpyArray:
        """All positions by falling votes, equal ones shuffled."""
        return HardVoting(by_chance(context.rng)).rank(context)


class TokenNorm:
    """Tokens of the largest Euclidean norm first: importance without language."""

    uses_language: ClassVar[bool] = False
    sends_all: ClassVar[bool] = False

    def rank(self, context: ScoringContext) -> NumpyArray:
        """All positions by falling norm of the token as it crosses the link; ties by index."""
        norms = np.linalg.norm(to_numpy(context.tokens, np.float64), axis=1)
        return np.argsort(-norms, kind="stable").astype(np.int32)


class RandomSelection:
    """Uniformly random tokens, the paper's baseline "Random Prune"."""

    uses_language: ClassVar[bool] = False
    sends_all: ClassVar[bool] = False

    def rank(self, context: ScoringContext) -> NumpyArray:
        """A permutation drawn from the context's generator."""
        return context.rng.permutation(context.tokens.shape[0]).astype(np.int32)


class FullTransmission:
    """All N tokens in raster order, however many the link carries: the unpruned reference."""

    uses_language: ClassVar[bool] = False
    sends_all: ClassVar[bool] = True

    def rank(self, context: ScoringContext) -> NumpyArray:
        """0 to N − 1."""
        return np.arange(context.tokens.shape[0], dtype=np.int32)
