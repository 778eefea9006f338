"""Hard voting is Eq. (3) as a plain loop has it, in NumPy and in torch."""

from __future__ import annotations

import math
from collections.abc import Callable

import hypothesis.extra.numpy as hnp
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from comvla_client import scoring


def plain_attention(queries: np.ndarray, tokens: np.ndarray) -> list[list[float]]:
    rows = []
    for q in queries.tolist():
        logits = [sum(a * b for a, b in zip(q, v, strict=True)) for v in tokens.tolist()]
        logits = [logit / math.sqrt(len(q)) for logit in logits]
        top = max(logits)
        weights = [math.exp(logit - top) for logit in logits]
        rows.append([w / sum(weights) for w in weights])
    return rows


def plain_similarities(queries: np.ndarray, tokens: np.ndarray) -> list[list[float]]:
    """h_i . v_k for all i and k, h_i = sum_j alpha_ij v_j, in double precision, one by one."""
    similarities = []
    listed = tokens.tolist()
    for weights in plain_attention(queries, tokens):
        h = [
            sum(w * v[c] for w, v in zip(weights, listed, strict=True))
            for c in range(len(listed[0]))
        ]
        similarities.append([sum(a * b for a, b in zip(h, v, strict=True)) for v in listed])
    return similarities


def plain_votes(queries: np.ndarray, tokens: np.ndarray) -> list[int]:
    votes = [0] * len(tokens)
    for similarity in plain_similarities(queries, tokens):
        best = 0
        for k, value in enumerate(similarity):
            if value > similarity[best]:
                best = k
        votes[best] += 1
    return votes


def random_case(seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    count, tokens, width = rng.integers(1, 7), rng.integers(1, 21), rng.integers(1, 13)
    scale = 10.0 ** rng.uniform(-1.5, 1.5)
    queries = scale * rng.standard_normal((count, width))
    return queries, scale * rng.standard_normal((tokens, width))


numpy_votes: Callable[..., np.ndarray] = scoring.hard_votes


def torch_votes(queries: np.ndarray, tokens: np.ndarray) -> np.ndarray:
    votes = scoring.hard_votes(torch.from_numpy(queries), torch.from_numpy(tokens))
    assert isinstance(votes, torch.Tensor)
    return votes.numpy()


@pytest.mark.parametrize("votes_of", [numpy_votes, torch_votes])
@settings(max_examples=300, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_hard_votes_equal_a_plain_loop(votes_of: Callable[..., np.ndarray], seed: int) -> None:
    queries, tokens = random_case(seed)
    assert votes_of(queries, tokens).tolist() == plain_votes(queries, tokens)


@pytest.mark.parametrize("votes_of", [numpy_votes, torch_votes])
@settings(max_examples=200, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_float32_votes_go_to_a_token_that_is_best_up_to_rounding(
    votes_of: Callable[..., np.ndarray], seed: int
) -> None:
    queries, tokens = (x.astype(np.float32) for x in random_case(seed))
    votes = votes_of(queries, tokens)
    similarities = np.array(plain_similarities(queries, tokens))
    slack = 1e-4 * (1.0 + np.abs(similarities).max(axis=1, keepdims=True))
    candidates = similarities >= similarities.max(axis=1, keepdims=True) - slack
    assert votes.sum() == len(queries)
    assert (votes <= candidates.sum(axis=0)).all()
    certain = candidates & (candidates.sum(axis=1, keepdims=True) == 1)
    assert (votes >= certain.sum(axis=0)).all()


@settings(max_examples=100, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_soft_votes_are_the_summed_attention(seed: int) -> None:
    queries, tokens = random_case(seed)
    expected = np.array(plain_attention(queries, tokens))
    np.testing.assert_allclose(scoring.attention(queries, tokens), expected, rtol=1e-9, atol=1e-300)
    np.testing.assert_allclose(scoring.soft_votes(queries, tokens), expected.sum(0), rtol=1e-9)
    soft = scoring.soft_votes(torch.from_numpy(queries), torch.from_numpy(tokens))
    np.testing.assert_allclose(soft.numpy(), expected.sum(0), rtol=1e-9)


def test_of_equally_similar_tokens_the_first_gets_the_vote() -> None:
    queries, tokens = np.ones((3, 4), np.float32), np.ones((5, 4), np.float32)
    assert scoring.hard_votes(queries, tokens).tolist() == [3, 0, 0, 0, 0]
    assert torch_votes(queries, tokens).tolist() == [3, 0, 0, 0, 0]


@given(
    hnp.arrays(np.float32, (3, 4), elements=st.floats(-(2.0**60), 2.0**60, width=32)),
    hnp.arrays(np.float32, (6, 4), elements=st.floats(-(2.0**60), 2.0**60, width=32)),
)
def test_attention_stays_finite_where_a_naive_softmax_overflows(
    queries: np.ndarray, tokens: np.ndarray
) -> None:
    for rows in (
        scoring.attention(queries, tokens),
        scoring.attention(torch.from_numpy(queries), torch.from_numpy(tokens)).numpy(),
    ):
        assert np.isfinite(rows).all()
        np.testing.assert_allclose(rows.sum(axis=1), 1.0, rtol=1e-5)


@pytest.mark.parametrize(
    ("given_dtype", "expected"),
    [
        (np.float32, np.float32),
        (np.float64, np.float64),
        (np.float16, np.float32),
        (int, np.float32),
    ],
)
def test_float32_stays_float32(given_dtype: type, expected: type) -> None:
    queries, tokens = np.ones((2, 3), given_dtype), np.eye(3, dtype=given_dtype)
    assert scoring.attention(queries, tokens).dtype == expected
    assert scoring.soft_votes(queries, tokens).dtype == expected
    assert scoring.hard_votes(queries, tokens).dtype == np.int64


def test_torch_stays_torch_and_half_precision_is_computed_in_float32() -> None:
    queries, tokens = torch.ones(2, 3, dtype=torch.bfloat16), torch.eye(3, dtype=torch.bfloat16)
    tokens.requires_grad_()
    importance = scoring.hard_importance(queries, tokens)
    assert importance.votes.dtype == torch.int64
    assert importance.attention.dtype == torch.float32
    assert not importance.attention.requires_grad


def test_inputs_are_left_as_they_were() -> None:
    queries, tokens = random_case(3)
    before = queries.copy(), tokens.copy()
    scoring.hard_votes(queries, tokens)
    np.testing.assert_array_equal(queries, before[0])
    np.testing.assert_array_equal(tokens, before[1])


@pytest.mark.parametrize(
    ("queries", "tokens"),
    [
        (np.ones((2, 3)), np.ones((4, 5))),
        (np.ones(3), np.ones((4, 3))),
        (np.ones((2, 3)), np.ones((0, 3))),
    ],
)
def test_shapes_that_do_not_fit_are_named(queries: np.ndarray, tokens: np.ndarray) -> None:
    with pytest.raises(ValueError, match=r"project the tokens|no tokens"):
        scoring.hard_votes(queries, tokens)


def test_numpy_and_torch_do_not_mix() -> None:
    with pytest.raises(TypeError, match="two NumPy arrays or two torch tensors"):
        scoring.attention(np.ones((2, 3)), torch.ones(4, 3))  # type: ignore[type-var]
