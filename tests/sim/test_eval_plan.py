"""Which episodes an evaluation runs, and on which tables."""

from __future__ import annotations

from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from comvla_sim.experiments.errors import EvaluationError
from comvla_sim.experiments.layouts import (
    MAX_EPISODES,
    evaluation_layout,
    foreign_layout,
)
from comvla_sim.experiments.plan import Grid
from comvla_sim.training.command import FIRST_VALIDATION_LAYOUT, MOST_VALIDATION_LAYOUTS


def grid(**changes: object) -> Grid:
    values: dict[str, object] = {
        "conditions": ("normal",),
        "methods": ("full", "hard_voting", "random"),
        "ks": (32, 16),
        "tasks": ("drawer-open", "lever-down"),
        "episodes": 3,
    }
    return Grid(**{**values, **changes})  # type: ignore[arg-type]


def test_full_runs_once_and_the_others_once_for_each_k() -> None:
    specs = list(grid().specs(num_tokens=512))
    assert len(specs) == len(set(specs)) == 3 * 2 * (1 + 2 * 2)
    counts = Counter((spec.method, spec.k) for spec in specs)
    assert set(counts) == {
        ("full", 512),
        *((method, k) for method in ("hard_voting", "random") for k in (32, 16)),
    }
    assert set(counts.values()) == {6}


def test_every_method_meets_the_same_tables() -> None:
    episodes = Counter((spec.task, spec.episode) for spec in grid().specs(512))
    assert set(episodes.values()) == {5}


def test_only_methods_that_listen_can_be_misled() -> None:
    specs = grid(conditions=("wrong_selection",)).specs(512)
    assert {spec.method for spec in specs} == {"hard_voting"}


@given(seed=st.integers(0, 400_000), episode=st.integers(0, MAX_EPISODES - 1))
def test_layouts_are_those_of_no_training_and_of_no_other_seed(seed: int, episode: int) -> None:
    layout, foreign = evaluation_layout(seed, episode), foreign_layout(seed, episode)
    assert layout == 1_000_000 + 10_000 * seed + episode
    assert 1_000_000 + 10_000 * seed <= layout < foreign < 1_000_000 + 10_000 * (seed + 1)
    assert foreign < 2**32


def test_no_layout_that_training_may_use_is_evaluated_on() -> None:
    assert evaluation_layout(0, 0) >= FIRST_VALIDATION_LAYOUT + MOST_VALIDATION_LAYOUTS


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"methods": ("telepathy",)}, "telepathy.*hard_voting"),
        ({"methods": ()}, "--method is empty"),
        ({"conditions": ("asleep",)}, "asleep.*blind"),
        ({"ks": (513,)}, "512, got 513"),
        ({"ks": (0,)}, "got 0"),
        ({"ks": ()}, "--k is empty"),
        ({"episodes": 0}, "--episodes"),
        ({"episodes": MAX_EPISODES + 1}, "fewer --episodes"),
        ({"conditions": ("wrong_selection",), "methods": ("full", "random")}, "add hard_voting"),
    ],
)
def test_what_cannot_be_run_is_refused_with_a_remedy(
    changes: dict[str, object], message: str
) -> None:
    with pytest.raises(EvaluationError, match=message):
        grid(**changes).check(num_tokens=512, seed=0)


@pytest.mark.parametrize("seed", [-1, 430_000])
def test_a_seed_without_tables_is_refused(seed: int) -> None:
    with pytest.raises(EvaluationError, match="--seed"):
        grid().check(num_tokens=512, seed=seed)


def test_full_alone_needs_no_k() -> None:
    grid(methods=("full",), ks=()).check(num_tokens=512, seed=0)
