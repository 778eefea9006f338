"""What passes cost, learned from those that ran: no clock is involved."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from server_stubs import StubCloud

from comvla_server.calibration import calibrate
from comvla_server.cost_model import CostModel, Work
from comvla_server.engine import Engine

FIXED_S, REQUEST_S, TOKEN_S = 0.010, 0.002, 0.0001
SHAPES = [(b, k) for b in (1, 2, 5, 8) for k in (4, 32, 128)]


def true_s(work: Work) -> float:
    """A machine that is exactly as the model thinks."""
    return FIXED_S + REQUEST_S * work.requests + TOKEN_S * work.tokens


def taught(passes: int = 48, slower: float = 1.0) -> CostModel:
    costs = CostModel()
    for b, k in itertools.islice(itertools.cycle(SHAPES), passes):
        costs.observe(Work(b, b * k), slower * true_s(Work(b, b * k)))
    return costs


def test_before_the_first_pass_nothing_is_known_and_nothing_is_feared() -> None:
    costs = CostModel()
    assert not costs.known
    assert costs.predict(Work(8, 4096)) == 0.0


def test_the_parts_of_a_pass_are_told_apart_and_predict_what_was_never_seen() -> None:
    costs = taught()
    assert costs.fixed_s == pytest.approx(FIXED_S, rel=0.05)
    assert costs.request_s == pytest.approx(REQUEST_S, rel=0.05)
    assert costs.token_s == pytest.approx(TOKEN_S, rel=0.05)
    unseen = Work(6, 6 * 256)
    assert costs.predict(unseen) == pytest.approx(true_s(unseen), rel=0.05)
    assert costs.spread_s < 0.05 * true_s(Work(8, 1024))


def test_a_pause_now_and_then_changes_little() -> None:
    costs = CostModel()
    for i, (b, k) in enumerate(itertools.islice(itertools.cycle(SHAPES), 90)):
        pause = 20.0 if i % 10 == 3 else 1.0
        costs.observe(Work(b, b * k), pause * true_s(Work(b, b * k)))
    for b, k in SHAPES:
        assert costs.predict(Work(b, b * k)) == pytest.approx(true_s(Work(b, b * k)), rel=0.15)


@pytest.mark.parametrize("factor", [0.4, 3.0], ids=["faster", "slower"])
def test_another_speed_of_the_machine_is_noticed_within_four_passes(factor: float) -> None:
    costs = taught(96)
    for b, k in SHAPES[:4]:
        costs.observe(Work(b, b * k), factor * true_s(Work(b, b * k)))
    work = Work(8, 512)
    assert costs.predict(work) == pytest.approx(factor * true_s(work), rel=0.15)


def test_passes_that_are_all_alike_keep_what_was_known_of_the_parts() -> None:
    costs = taught()
    for _ in range(200):
        costs.observe(Work(8, 8 * 32), true_s(Work(8, 8 * 32)))
    assert costs.predict(Work(8, 8 * 32)) == pytest.approx(true_s(Work(8, 8 * 32)), rel=0.02)
    assert costs.predict(Work(1, 128)) == pytest.approx(true_s(Work(1, 128)), rel=0.25)


def test_a_request_costs_its_share_of_a_full_batch() -> None:
    costs = taught()
    expected = FIXED_S / 8 + REQUEST_S + 64 * TOKEN_S
    assert costs.request_cost_s(8, 64) == pytest.approx(expected, rel=0.05)


def test_pictures_cost_what_they_cost_once_some_were_seen() -> None:
    costs = taught()
    for pictures in (1, 2, 3, 1, 2, 3, 4, 1):
        work = Work(pictures, pictures * 128, pictures)
        costs.observe(work, true_s(work) + 0.05 * pictures)
    looked = Work(4, 4 * 128, 2)
    assert costs.predict(looked) == pytest.approx(true_s(looked) + 0.1, rel=0.2)


@settings(max_examples=50, deadline=None)
@given(
    st.lists(
        st.tuples(st.integers(1, 16), st.integers(1, 512), st.floats(1e-6, 10.0)),
        min_size=1,
        max_size=40,
    )
)
def test_whatever_was_seen_no_part_is_negative_or_not_finite(
    passes: list[tuple[int, int, float]],
) -> None:
    costs = CostModel()
    for b, k, seconds in passes:
        costs.observe(Work(b, b * k), seconds)
    parts = [costs.fixed_s, costs.request_s, costs.token_s, costs.picture_s, costs.spread_s]
    assert np.isfinite(parts).all()
    assert min(parts) >= 0.0


def test_passes_that_cannot_be_are_ignored() -> None:
    costs = CostModel()
    costs.observe(Work(0, 0), 1.0)
    costs.observe(Work(1, 1), 0.0)
    costs.observe(Work(1, 1), float("nan"))
    assert not costs.known


class Slow(StubCloud):
    """Each pass takes as long as its work says, on a clock of its own."""

    def __init__(self) -> None:
        super().__init__()
        self.now_s = 0.0

    def predict(self, requests: list) -> list:  # type: ignore[type-arg]
        work = Work(len(requests), sum(len(r.positions) for r in requests))
        self.now_s += 1000 * true_s(work) if self.too_slow else true_s(work)
        return super().predict(requests)

    too_slow = False


def test_calibration_tells_the_parts_apart_before_the_first_robot_calls() -> None:
    cloud, costs = Slow(), CostModel()
    calibrate(Engine(cloud), 8, costs, clock=lambda: cloud.now_s)
    work = Work(3, 3 * 9)
    assert costs.predict(work) == pytest.approx(true_s(work), rel=0.1)
    assert {len(batch) for batch in cloud.batches} == {1, 8}


def test_calibration_of_a_slow_model_stops_after_its_first_pass() -> None:
    cloud, costs = Slow(), CostModel()
    cloud.too_slow = True
    calibrate(Engine(cloud), 8, costs, clock=lambda: cloud.now_s)
    assert len(cloud.batches) == 1
    assert costs.known
