"""Every way of selecting that can be evaluated: the client's, and controls that only science needs."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from comvla_client.selection import (
    SELECTORS,
    HardVoting,
    ScoringContext,
    Selector,
    by_chance,
)

NumpyArray = npt.NDArray[Any]


class TokenNorm:
    """Tokens of the largest Euclidean norm first: importance without language."""

    uses_language: ClassVar[bool] = False
    sends_all: ClassVar[bool] = False

    def rank(self, context: ScoringContext) -> NumpyArray:
        """All positions by falling norm of the token as it crosses the link; ties by index."""
        norms = np.linalg.norm(np.asarray(context.tokens, dtype=np.float64), axis=1)
        return np.argsort(-norms, kind="stable").astype(np.int32)


class HardVotingRandomTies:
    """Hard votes with ties drawn by lot: what the votes alone are worth without their tie-break."""

    uses_language: ClassVar[bool] = True
    sends_all: ClassVar[bool] = False

    def rank(self, context: ScoringContext) -> NumpyArray:
        """All positions by falling votes, equal ones shuffled."""
        return HardVoting(by_chance(context.rng)).rank(context)


METHODS: dict[str, type[Selector]] = {
    **SELECTORS,
    "token_norm": TokenNorm,
    "hard_voting_random_ties": HardVotingRandomTies,
}
