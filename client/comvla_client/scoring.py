"""How much each visual token matters to the instruction: Eq. (3) and Table III of the paper.

Every function takes language queries ``(Q, d)`` and projected visual tokens ``(N, d)``, either both
NumPy arrays or both torch tensors, and answers in kind. Half precision and integers are computed in
float32; float32 and float64 stay what they are.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from comvla_client.arrays import AnyArray, Array, NumpyArray, is_torch

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True)
class Importance:
    """Importance of N tokens, with what breaks ties between them.

    Attributes:
        votes: (N,) the score I_j that ranks.
        attention: (N,) attention that the token received, summed over queries.
    """

    votes: Array
    attention: Array


def attention(queries: AnyArray, tokens: AnyArray) -> AnyArray:
    """Attention of each query over all tokens: α_{i,j} = softmax(q_iᵀ V / √d)_j.

    Args:
        queries: (Q, d) language queries.
        tokens: (N, d) visual tokens in the queries' space.

    Returns:
        (Q, N) rows that sum to one.

    Raises:
        ValueError: shapes that do not fit each other, or no tokens.
        TypeError: one NumPy array and one torch tensor.
    """
    _check(queries, tokens)
    if is_torch(queries) and is_torch(tokens):
        return _attention_torch(_float_torch(queries), _float_torch(tokens))
    return _attention_numpy(_float_numpy(queries), _float_numpy(tokens))


def hard_votes(queries: AnyArray, tokens: AnyArray) -> AnyArray:
    """Hard voting, Eq. (3): each query's task token h_i votes for the token most similar to it.

    Args:
        queries: (Q, d) language queries.
        tokens: (N, d) visual tokens in the queries' space.

    Returns:
        (N,) int64 votes that sum to Q. Of equally similar tokens the one of lowest index gets the vote.

    Raises:
        ValueError, TypeError: as in :func:`attention`.
    """
    return hard_importance(queries, tokens).votes  # type: ignore[return-value]


def soft_votes(queries: AnyArray, tokens: AnyArray) -> AnyArray:
    """Soft voting (Table III): I_j = Σ_i α_{i,j}, the attention itself as the score.

    Args:
        queries: (Q, d) language queries.
        tokens: (N, d) visual tokens in the queries' space.

    Returns:
        (N,) floating point, sums to Q.

    Raises:
        ValueError, TypeError: as in :func:`attention`.
    """
    votes: AnyArray = attention(queries, tokens).sum(0)
    return votes


def hard_importance(queries: Array, tokens: Array, votes_per_query: int = 1) -> Importance:
    """Hard votes together with the summed attention that breaks their ties, in one pass.

    A prompt of 20 to 40 words names at most that many of 512 tokens, so most of a ranking is tie-break.

    Args:
        queries: (Q, d) language queries.
        tokens: (N, d) visual tokens in the queries' space.
        votes_per_query: how many different tokens each query votes for, best first; the paper's is 1.

    Raises:
        ValueError, TypeError: as in :func:`attention`; or votes for fewer than 1 or more than N tokens.
    """
    _check(queries, tokens)
    if not 1 <= votes_per_query <= tokens.shape[0]:
        raise ValueError(
            f"expected 1 to {tokens.shape[0]} votes per query, one for each token, got {votes_per_query}"
        )
    if is_torch(queries) and is_torch(tokens):
        return _hard_torch(_float_torch(queries), _float_torch(tokens), votes_per_query)
    return _hard_numpy(_float_numpy(queries), _float_numpy(tokens), votes_per_query)


def soft_importance(queries: Array, tokens: Array) -> Importance:
    """Soft votes as an :class:`Importance`; their ties are broken by index alone."""
    votes = soft_votes(queries, tokens)  # type: ignore[type-var]
    return Importance(votes=votes, attention=votes)


def _attention_numpy(queries: NumpyArray, tokens: NumpyArray) -> NumpyArray:
    # In place throughout: at Q = 20, N = 512 the temporaries cost as much as the exponentials.
    weights: NumpyArray = queries @ tokens.T
    weights *= weights.dtype.type(1.0 / math.sqrt(queries.shape[1]))
    weights -= weights.max(axis=1, keepdims=True)
    np.exp(weights, out=weights)
    weights /= weights.sum(axis=1, keepdims=True)
    return weights


def _hard_numpy(queries: NumpyArray, tokens: NumpyArray, votes_per_query: int) -> Importance:
    weights = _attention_numpy(queries, tokens)
    likeness = weights @ tokens @ tokens.T
    votes = np.zeros(len(tokens), dtype=np.int64)
    # Best, second best, …: unlike a partition, argmax gives equals by index.
    for more in reversed(range(votes_per_query)):
        winners = likeness.argmax(axis=1)
        votes += np.bincount(winners, minlength=len(tokens))
        if more:
            likeness[np.arange(len(winners)), winners] = -np.inf
    return Importance(votes=votes, attention=weights.sum(axis=0))


def _attention_torch(queries: torch.Tensor, tokens: torch.Tensor) -> torch.Tensor:
    return (queries @ tokens.T).mul(1.0 / math.sqrt(queries.shape[1])).softmax(dim=1)


def _hard_torch(queries: torch.Tensor, tokens: torch.Tensor, votes_per_query: int) -> Importance:
    weights = _attention_torch(queries, tokens)
    likeness = weights @ tokens @ tokens.T
    votes = None
    for more in reversed(range(votes_per_query)):
        winners = likeness.argmax(dim=1)
        cast = winners.bincount(minlength=len(tokens))
        votes = cast if votes is None else votes + cast
        if more:
            likeness.scatter_(1, winners[:, None], -math.inf)
    assert votes is not None
    return Importance(votes=votes, attention=weights.sum(dim=0))


def _float_numpy(values: Array) -> NumpyArray:
    array = np.asarray(values)
    return array if array.dtype in (np.float32, np.float64) else array.astype(np.float32)


def _float_torch(values: torch.Tensor) -> torch.Tensor:
    # Votes and their ties carry no gradient, and a robot never trains.
    torch = sys.modules["torch"]
    values = values.detach()
    wide: bool = values.dtype in (torch.float32, torch.float64)
    return values if wide else values.float()


def _check(queries: Array, tokens: Array) -> None:
    if is_torch(queries) != is_torch(tokens):
        raise TypeError(
            f"queries are {type(queries).__name__}, tokens are {type(tokens).__name__}: "
            "pass two NumPy arrays or two torch tensors"
        )
    if queries.ndim != 2 or tokens.ndim != 2 or queries.shape[1] != tokens.shape[1]:
        raise ValueError(
            f"expected queries (Q, d) and tokens (N, d) of one width, got {tuple(queries.shape)} "
            f"and {tuple(tokens.shape)}: project the tokens into the queries' space first"
        )
    if tokens.shape[0] == 0:
        raise ValueError("there are no tokens to vote for: N = 0")
