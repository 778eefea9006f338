"""LightVLA's and VLA-ADP's rules, on scores given by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from client_stubs import StubEdge, model_response
from hypothesis import given
from hypothesis import strategies as st

from comvla.errors import ObservationError
from comvla_client.core import ClientCore
from comvla_client.pruners import VLAADP, LightVLA, MotionGate, view_quotas
from comvla_client.registry import make_selector
from comvla_client.selection import ScoringContext


def context(**edge: Any) -> ScoringContext:
    """Two views of 2 x 2 tokens."""
    return ScoringContext(
        tokens=np.zeros((8, 3), np.float32),
        projected=np.zeros((8, 5), np.float32),
        queries=np.zeros((2, 5), np.float32),
        grid=(2, 2, 2),
        rng=np.random.default_rng(0),
        edge=SimpleNamespace(**edge),
        instruction="push the plate",
        proprio=np.zeros(8, np.float32),
    )


def test_lightvla_keeps_what_got_a_vote_most_votes_first() -> None:
    scores = np.zeros((8, 8), np.float32)
    for voter, winner in enumerate((5, 1, 5, 7, 1, 5, 0, 7)):
        scores[voter, winner] = 1
    kept = LightVLA().rank(context(lightvla_scores=lambda *_: scores))
    assert kept.tolist() == [5, 1, 7, 0]


def test_vla_adp_keeps_a_quota_of_each_view_best_first() -> None:
    scores = np.array([9, 1, 2, 3, 4, 8, 5, 7], np.float32)
    kept = VLAADP(ratio=0.625).rank(context(text_driven_scores=lambda *_: scores))
    assert kept.tolist() == [0, 5, 7, 6, 3]


def test_a_shut_gate_keeps_everything() -> None:
    pruner = VLAADP(gate=MotionGate())
    assert pruner.rank(context()).tolist() == list(range(8))


def test_the_gate_opens_after_three_windows_and_shuts_for_a_short_one() -> None:
    gate = MotionGate()
    places = np.cumsum([0.0, 0.2, 0.1, 0.15, 0.05, 0.3])
    decisions = [gate.prunes(np.array([x, 0, 0])) for x in places]
    # windows 0.2, 0.1, 0.15: between the two before it, prune; 0.05: shorter than both; 0.3: longer.
    assert decisions == [False, False, False, True, False, True]


def test_a_full_step_follows_three_pruned_ones() -> None:
    gate = MotionGate()
    decisions = [gate.prunes(np.array([x, 0, 0])) for x in 0.1 * np.arange(12) ** 2]
    assert decisions == [False] * 3 + [True, True, True, False] * 2 + [True]


def test_a_new_episode_forgets_the_old_one() -> None:
    pruner = VLAADP(gate=MotionGate(window=2))
    scores = np.arange(8, dtype=np.float32)

    def episode() -> list[int]:
        pruner.reset()
        lengths = []
        for x in (0.0, 0.1, 0.3, 0.6):
            step = context(text_driven_scores=lambda *_: scores)
            step.proprio[0] = x  # type: ignore[index]
            lengths.append(len(pruner.rank(step)))
        return lengths

    assert episode() == episode() == [8, 8, 6, 6]


@given(kept=st.integers(2, 512), share=st.floats(0.01, 0.99))
def test_quotas_add_up(kept: int, share: float) -> None:
    quotas = view_quotas(kept, (share, 1 - share))
    assert sum(quotas) == kept
    assert min(quotas) >= 1


def test_published_quotas() -> None:
    assert view_quotas(384, (0.4, 0.6)) == [154, 230]
    assert view_quotas(154, (0.4, 0.6)) == [62, 92]


@pytest.mark.parametrize("name", ["lightvla", "vla_adp"])
def test_they_go_by_name_and_send_all_that_they_rank(name: str) -> None:
    selector = make_selector(name)
    assert selector.sends_all
    assert selector.uses_language
    bare = ScoringContext(
        np.zeros((8, 3)), np.zeros((8, 5)), np.zeros((2, 5)), (2, 2, 2), np.random.default_rng(0)
    )
    with pytest.raises(ObservationError, match=f"{name} looks at the edge model"):
        selector.rank(bare)


def test_ratios_that_make_no_sense_are_refused() -> None:
    for arguments in ({"ratio": 0.0}, {"ratio": 1.5}, {"view_shares": (0.5, 0.6)}):
        with pytest.raises(ValueError, match="expected a ratio"):
            VLAADP(**arguments)  # type: ignore[arg-type]
    pruner = VLAADP(view_shares=(1.0,))
    with pytest.raises(ValueError, match="one view share per view"):
        pruner.rank(context(text_driven_scores=lambda *_: np.zeros(8)))


def test_vla_adp_warns_where_the_server_does_not_run_as_it_wants(
    caplog: pytest.LogCaptureFixture,
) -> None:
    response = model_response()
    ClientCore(StubEdge(), selector="hard_voting").accept_server(response)
    assert not caplog.messages
    ClientCore(StubEdge(), selector="vla_adp").accept_server(response)
    (warning,) = caplog.messages
    assert "compact_positions, this one runs with no options" in warning
    assert "comvla-server serve --compact-positions" in warning
    caplog.clear()
    response.run_options.extend(["dtype=bfloat16", "compact_positions"])
    ClientCore(StubEdge(), selector="vla_adp").accept_server(response)
    assert not caplog.messages
