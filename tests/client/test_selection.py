"""Selection orders by votes, then attention, then index; selectors go by name."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from client_stubs import NARROW, WORDS, StubEdge, StubTransport, observation
from hypothesis import given
from hypothesis import strategies as st

from comvla_client import ComVLAClient
from comvla_client.registry import SELECTORS, make_selector
from comvla_client.scoring import Importance, hard_votes, soft_votes
from comvla_client.selection import (
    HardVoting,
    ScoringContext,
    by_chance,
    by_index,
    select,
)

importances = st.integers(1, 40).flatmap(
    lambda n: st.tuples(
        st.lists(st.integers(0, 4), min_size=n, max_size=n),
        st.lists(st.sampled_from([0.0, 0.25, 0.5, 1.5]), min_size=n, max_size=n),
        st.integers(0, n + 2),
    )
)


@given(importances)
def test_order_is_votes_then_attention_then_index(case: tuple[list[int], list[float], int]) -> None:
    votes, attention, k = case
    expected = sorted(range(len(votes)), key=lambda j: (-votes[j], -attention[j], j))[:k]
    in_numpy = select(Importance(np.array(votes), np.array(attention, np.float32)), k)
    in_torch = select(Importance(torch.tensor(votes), torch.tensor(attention)), k)
    assert isinstance(in_torch, torch.Tensor)
    assert in_numpy.tolist() == expected
    assert in_torch.tolist() == expected


@given(importances)
def test_a_bare_array_breaks_ties_by_index(case: tuple[list[int], list[float], int]) -> None:
    votes, _, k = case
    expected = sorted(range(len(votes)), key=lambda j: (-votes[j], j))[:k]
    assert select(np.array(votes), k).tolist() == expected
    assert select(np.array(votes, np.uint8), k).tolist() == expected
    assert select(torch.tensor(votes), k).tolist() == expected


def test_the_tie_break_is_one_function_to_swap() -> None:
    importance = Importance(np.array([1, 0, 0, 1]), np.array([0.1, 0.2, 0.3, 0.4]))
    assert select(importance, 4).tolist() == [3, 0, 2, 1]
    assert select(importance, 4, by_index).tolist() == [0, 3, 1, 2]
    assert select(importance, 4, lambda i: -i.attention).tolist() == [0, 3, 1, 2]


@pytest.mark.parametrize("kind", [np.array, torch.tensor])
def test_ties_by_chance_keep_votes_first_and_repeat_with_the_seed(kind: Any) -> None:
    importance = Importance(kind([1] * 20 + [2] * 20), kind([0.0] * 40))
    orders = [
        select(importance, 40, by_chance(np.random.default_rng(s))).tolist() for s in (1, 1, 2)
    ]
    assert orders[0] == orders[1] != orders[2]
    assert set(orders[0][:20]) == set(range(20, 40))


@pytest.mark.parametrize("kind", [np.array, torch.tensor])
def test_nan_has_no_order(kind: Any) -> None:
    with pytest.raises(ValueError, match="not finite"):
        select(kind([1.0, float("nan")]), 1)


def test_what_cannot_be_selected_is_named() -> None:
    with pytest.raises(ValueError, match="k >= 0"):
        select(np.ones(3), -1)
    with pytest.raises(ValueError, match=r"\(N,\)"):
        select(np.ones((3, 3)), 1)


def context(seed: int = 0, kind: Any = np.asarray) -> ScoringContext:
    edge, rng = StubEdge(), np.random.default_rng(seed)
    tokens = edge.encode(observation(seed)["images"])
    return ScoringContext(
        kind(tokens), kind(edge.project(tokens)), kind(edge.text_queries(WORDS)), (2, 4, 4), rng
    )


@pytest.mark.parametrize("name", sorted({*SELECTORS} - {"lightvla", "vla_adp"}))
@pytest.mark.parametrize("kind", [np.asarray, torch.from_numpy])
def test_every_selector_ranks_every_token_once(name: str, kind: Any) -> None:
    ranking = make_selector(name).rank(context(kind=kind))
    assert isinstance(ranking, np.ndarray)
    assert sorted(ranking.tolist()) == list(range(32))


def test_voting_selectors_put_the_most_voted_first() -> None:
    seen = context()
    hard = hard_votes(seen.queries, seen.language_tokens)
    soft = soft_votes(seen.queries, seen.language_tokens)
    assert (np.diff(hard[make_selector("hard_voting").rank(seen)]) <= 0).all()
    assert (np.diff(soft[make_selector("soft_voting").rank(seen)]) <= 0).all()


def test_full_is_in_raster_order_and_random_is_not() -> None:
    assert make_selector("full").rank(context()).tolist() == list(range(32))
    assert make_selector("random").rank(context()).tolist() != list(range(32))
    assert (
        make_selector("random").rank(context(1)).tolist()
        == make_selector("random").rank(context(1)).tolist()
    )


def test_a_selector_that_scores_needs_projected_tokens() -> None:
    blind = ScoringContext(
        np.ones((2, 3)), None, np.ones((1, 4)), (1, 1, 2), np.random.default_rng()
    )
    with pytest.raises(ValueError, match="uses_language"):
        HardVoting().rank(blind)


def test_an_unknown_selector_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ValueError, match="hard_voting"):
        make_selector("best")


class Backwards:
    """A new selector is one small class."""

    uses_language: ClassVar[bool] = False
    sends_all: ClassVar[bool] = False

    def rank(self, context: ScoringContext) -> np.ndarray:
        return np.arange(len(context.tokens))[::-1]


def test_a_selector_of_ones_own_drives_the_client() -> None:
    edge, transport = StubEdge(), StubTransport()
    options: dict[str, Any] = {"selector": Backwards(), "budget": 3, "deadline_s": 20.0}
    with ComVLAClient(transport, edge=edge, link=NARROW, **options) as client:
        report = client.step(observation(), WORDS).report
    assert report.positions.tolist() == [31, 30, 29]
    assert "project" not in edge.calls
    assert report.timings_s["score"] > 0.0
