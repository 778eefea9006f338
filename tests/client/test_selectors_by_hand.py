"""Every selector against its equation, written out once more in plain loops."""

from __future__ import annotations

import itertools
import math
import random
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from comvla_client.pruners import VLAADP, MotionGate
from comvla_client.registry import SELECTORS, make_selector
from comvla_client.selection import ScoringContext
from comvla_client.voting import DiverseVoting, MultiVoting, ViewQuotas

GRID = (2, 3, 4)
Vector = list[float]


def context(seed: int, kind: Any = np.asarray, **changes: Any) -> ScoringContext:
    rng = np.random.default_rng(seed)
    n, dim, hidden, queries = math.prod(GRID), 6, 8, 5
    fields: dict[str, Any] = {
        "tokens": kind(rng.standard_normal((n, dim)).astype(np.float32)),
        "projected": kind(rng.standard_normal((n, hidden)).astype(np.float32)),
        "queries": kind(2 * rng.standard_normal((queries, hidden)).astype(np.float32)),
        "grid": GRID,
        "rng": np.random.default_rng(seed),
    }
    return ScoringContext(**{**fields, **changes})


def rows(array: Any) -> list[Vector]:
    return [[float(x) for x in row] for row in array]


def dot(a: Vector, b: Vector) -> float:
    return sum(x * y for x, y in zip(a, b, strict=True))


def attention_of(query: Vector, tokens: list[Vector]) -> Vector:
    raw = [math.exp(dot(query, token) / math.sqrt(len(query))) for token in tokens]
    return [value / sum(raw) for value in raw]


def ballots(seen: ScoringContext, votes_per_query: int) -> tuple[list[int], Vector]:
    """Votes and summed attention of every token, Eq. (3) with m votes for each query."""
    tokens, queries = rows(seen.projected), rows(seen.queries)
    votes, looked = [0] * len(tokens), [0.0] * len(tokens)
    for query in queries:
        weights = attention_of(query, tokens)
        for j, weight in enumerate(weights):
            looked[j] += weight
        task = [
            sum(w * token[d] for w, token in zip(weights, tokens, strict=True))
            for d in range(len(query))
        ]
        liked = sorted(range(len(tokens)), key=lambda j: (-dot(task, tokens[j]), j))
        for j in liked[:votes_per_query]:
            votes[j] += 1
    return votes, looked


def by_votes(votes: list[int], looked: Vector) -> list[int]:
    return sorted(range(len(votes)), key=lambda j: (-votes[j], -looked[j], j))


SEEDS = range(5)
KINDS = [np.asarray, torch.from_numpy]


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", KINDS)
def test_hard_voting(seed: int, kind: Any) -> None:
    seen = context(seed, kind)
    assert make_selector("hard_voting").rank(seen).tolist() == by_votes(*ballots(seen, 1))


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", KINDS)
def test_soft_voting(seed: int, kind: Any) -> None:
    seen = context(seed, kind)
    _, looked = ballots(seen, 1)
    expected = sorted(range(len(looked)), key=lambda j: -looked[j])
    assert make_selector("soft_voting").rank(seen).tolist() == expected


@pytest.mark.parametrize("votes_per_query", [1, 2, 3, 24, 99])
@pytest.mark.parametrize("kind", KINDS)
def test_multi_voting(votes_per_query: int, kind: Any) -> None:
    seen = context(votes_per_query, kind)
    expected = by_votes(*ballots(seen, votes_per_query))
    assert MultiVoting(votes_per_query).rank(seen).tolist() == expected


def test_multi_voting_with_one_vote_is_the_papers() -> None:
    seen = context(3)
    assert MultiVoting(1).rank(seen).tolist() == make_selector("hard_voting").rank(seen).tolist()


def test_equal_tokens_get_their_votes_by_index() -> None:
    same = np.ones((math.prod(GRID), 8), np.float32)
    assert MultiVoting(2).rank(context(0, projected=same)).tolist()[:2] == [0, 1]


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("relevance", [0.0, 0.4, 0.7, 1.0])
def test_diverse_voting(seed: int, kind: Any, relevance: float) -> None:
    seen = context(seed, kind)
    selector = DiverseVoting(3, relevance, sketch_dim=4)
    votes, looked = ballots(seen, 3)
    order = by_votes(votes, looked)
    voted = [j for j in order if votes[j] > 0]
    share = {j: looked[j] / (1 + sum(looked[i] for i in voted)) for j in voted}
    score = {j: votes[j] + share[j] for j in voted}
    best = max(score.values())
    sketches = selector.sketch(np.array([rows(seen.projected)[j] for j in voted], np.float32))
    sketch = dict(zip(voted, rows(sketches), strict=True))
    sent: list[int] = []
    while len(sent) < len(voted):
        worth = {}
        for j in voted:
            if j not in sent:
                near = max((dot(sketch[j], sketch[s]) for s in sent), default=0.0)
                worth[j] = relevance * score[j] / best - (1 - relevance) * near
        sent.append(max(worth, key=lambda j: (round(worth[j], 5), -voted.index(j))))
    ranked = selector.rank(seen).tolist()
    assert ranked[: len(voted)] == sent
    assert ranked[len(voted) :] == [j for j in order if votes[j] == 0]


def test_a_sketch_keeps_what_is_alike_together() -> None:
    """Cosines of 32 dimensions are about those of 512, less what all tokens have in common."""
    rng = np.random.default_rng(0)
    tokens = rng.standard_normal((40, 512)).astype(np.float32)
    tokens[1] = tokens[0] + 0.1 * rng.standard_normal(512)
    sketch = DiverseVoting().sketch(tokens + 50.0)
    cosines = sketch @ sketch.T
    assert cosines[0, 1] > 0.9
    centred = tokens - tokens.mean(axis=0)
    centred /= np.linalg.norm(centred, axis=1, keepdims=True)
    assert np.abs(cosines - centred @ centred.T).mean() < 0.2


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("shares", [None, (0.5, 0.5), (0.3, 0.7), (0.0, 1.0)])
def test_view_quotas(seed: int, shares: tuple[float, ...] | None) -> None:
    seen = context(seed)
    base = by_votes(*ballots(seen, 1))
    per_view = GRID[1] * GRID[2]
    ranked = ViewQuotas(shares=shares).rank(seen).tolist()
    assert sorted(ranked) == list(range(math.prod(GRID)))
    for view in range(2):
        mine = [j for j in ranked if j // per_view == view]
        assert mine == [j for j in base if j // per_view == view]
    wanted = shares or (0.5, 0.5)
    for k in range(len(ranked) + 1):
        for view in range(2):
            held = sum(j // per_view == view for j in ranked[:k])
            left_out = [
                k - per_view,  # what the other view cannot fill any more
                k * wanted[view],
            ]
            expected = min(per_view, max(left_out))
            assert abs(held - expected) <= 1, (k, view)


def test_view_quotas_want_one_share_for_each_view() -> None:
    with pytest.raises(ValueError, match="one share per view"):
        ViewQuotas(shares=(0.2, 0.3, 0.5)).rank(context(0))
    with pytest.raises(ValueError, match="sum to 1"):
        ViewQuotas(shares=(0.2, 0.3))


@pytest.mark.parametrize("kind", KINDS)
def test_token_norm(kind: Any) -> None:
    seen = context(1, kind)
    norms = [math.sqrt(dot(token, token)) for token in rows(seen.tokens)]
    expected = sorted(range(len(norms)), key=lambda j: -norms[j])
    assert make_selector("token_norm").rank(seen).tolist() == expected


def test_random_is_a_permutation_that_the_seed_decides() -> None:
    orders = [make_selector("random").rank(context(seed)).tolist() for seed in (1, 1, 2)]
    assert orders[0] == orders[1] != orders[2]
    assert sorted(orders[0]) == sorted(orders[2]) == list(range(24))
    # Every token comes first about as often as any other.
    firsts = {make_selector("random").rank(context(seed))[0] for seed in range(300)}
    assert len(firsts) == 24


def test_full_is_the_picture_as_it_is() -> None:
    assert make_selector("full").rank(context(0)).tolist() == list(range(24))


def test_random_ties_keep_the_votes() -> None:
    seen = context(4)
    votes, _ = ballots(seen, 1)
    ranked = make_selector("hard_voting_random_ties").rank(seen).tolist()
    assert [votes[j] for j in ranked] == sorted(votes, reverse=True)
    assert ranked != by_votes(*ballots(seen, 1))


def robot(seed: int, **scores: Any) -> ScoringContext:
    edge = SimpleNamespace(**{name: lambda *_, s=s: s for name, s in scores.items()})
    proprio = np.zeros(4, np.float32)
    return context(seed, edge=edge, instruction="push", proprio=proprio)


@pytest.mark.parametrize("seed", SEEDS)
def test_lightvla(seed: int) -> None:
    scores = np.random.default_rng(seed).standard_normal((24, 24)).astype(np.float32)
    counts: dict[int, int] = {}
    for row in rows(scores):
        winner = max(range(24), key=lambda j, row=row: (row[j], -j))
        counts[winner] = counts.get(winner, 0) + 1
    expected = sorted(counts, key=lambda j: (-counts[j], j))
    kept = make_selector("lightvla").rank(robot(seed, lightvla_scores=scores)).tolist()
    assert kept == expected


@pytest.mark.parametrize("ratio", [0.25, 0.5, 0.75, 1.0])
def test_vla_adp(ratio: float) -> None:
    values = np.random.default_rng(9).standard_normal(24).astype(np.float32)
    kept = VLAADP(ratio=ratio).rank(robot(0, text_driven_scores=values)).tolist()
    total = round(24 * ratio)
    main = round(total * 0.4)
    chosen: list[int] = []
    for first, quota in ((0, main), (12, total - main)):
        pool = list(range(first, first + 12))
        for _ in range(min(quota, 12)):
            pick = pool[0]
            for j in pool:
                if values[j] > values[pick]:
                    pick = j
            pool.remove(pick)
            chosen.append(pick)
    assert sorted(kept) == sorted(chosen)
    assert kept == sorted(chosen, key=lambda j: -values[j])


def test_the_gate_of_vla_adp() -> None:
    """Written out once more as a list of windows, over a long random walk."""
    walk = random.Random(5)
    places, x = [], 0.0
    for _ in range(200):
        x += walk.choice([0.0, 0.01, 0.05, 0.2])
        places.append(x)
    gate, pruned = MotionGate(), []
    for x in places:
        pruned.append(gate.prunes(np.array([x, 0.0, 0.0])))
    windows = [abs(b - a) for a, b in itertools.pairwise(places)]
    in_a_row = 0
    for step, came in enumerate(pruned):
        known = windows[max(0, step - 3) : step]
        expected = len(known) == 3 and not (known[2] < known[0] and known[2] < known[1])
        if expected and in_a_row == 3:
            expected = False
        in_a_row = in_a_row + 1 if expected else 0
        assert came == expected, step


def test_all_selectors_of_the_table_are_tested_here() -> None:
    """Whoever adds one reads this file, and writes its loop."""
    assert set(SELECTORS) == {
        "hard_voting",
        "soft_voting",
        "random",
        "full",
        "token_norm",
        "hard_voting_random_ties",
        "multi_voting",
        "diverse_voting",
        "view_quotas",
        "lightvla",
        "vla_adp",
    }
