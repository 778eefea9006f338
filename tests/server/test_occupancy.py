"""Models that share an inference thread: what each is told of the others."""

from __future__ import annotations

import math

import pytest

from comvla_server.cost_model import CostModel, Work
from comvla_server.load_control import LoadControl
from comvla_server.load_policy import LoadPolicy
from comvla_server.metrics import Metrics
from comvla_server.occupancy import Occupancy
from comvla_server.refusals import Refusal
from comvla_server.tickets import Place

WORK = Work(1, 10)


def test_a_thread_that_rests_is_free_now() -> None:
    occupancy = Occupancy()
    assert occupancy.free_s("a", 5.0) == 5.0
    occupancy.begin("a", 0.2, 5.0)
    assert occupancy.end("a", 5.2) == -math.inf
    assert occupancy.free_s("a", 6.0) == 6.0


def test_the_next_pass_begins_after_the_turns_of_the_others() -> None:
    occupancy = Occupancy()
    for owner, predicted_s in (("a", 0.1), ("b", 0.2), ("c", 0.4)):
        occupancy.begin(owner, predicted_s, 5.0)
    assert occupancy.free_s("new", 5.0) == pytest.approx(5.7)
    assert occupancy.free_s("a", 5.0) == pytest.approx(5.7)
    assert occupancy.free_s("b", 5.0) == pytest.approx(5.8)  # a, b, c, a
    assert occupancy.free_s("b", 5.25) == pytest.approx(5.25 + 0.15 + 0.2 + 0.5)  # a takes long
    assert occupancy.turn_s("b") == pytest.approx(0.5)


def test_waiting_for_another_model_is_no_cost_of_ones_own() -> None:
    occupancy = Occupancy()
    costs = [CostModel(), CostModel()]
    slow, fast = (LoadControl(8, 512, LoadPolicy(), c, Metrics(), occupancy) for c in costs)
    for turn in range(5):
        began_s = 10.0 * turn
        slow.begin(WORK, began_s)
        fast.begin(WORK, began_s)
        slow.end(WORK, began_s, began_s + 2.0, succeeded=True)
        fast.end(WORK, began_s, began_s + 2.1, succeeded=True)
    assert costs[0].predict(WORK) == pytest.approx(2.0, rel=0.02)
    assert costs[1].predict(WORK) == pytest.approx(0.1, rel=0.02)


def test_what_is_asked_of_all_models_counts() -> None:
    occupancy = Occupancy()
    occupancy.join("a", lambda now_s: 0.7, lambda now_s: 0.9)
    occupancy.join("b", lambda now_s: 0.1 * now_s, lambda now_s: 2.7)
    assert occupancy.load(4.0) == pytest.approx(1.1)
    assert occupancy.share("a", 4.0) == pytest.approx(0.25)
    assert occupancy.share("new", 4.0) == 1.0
    occupancy.leave("a")
    assert occupancy.load(4.0) == pytest.approx(0.4)
    assert occupancy.share("b", 4.0) == 1.0


def test_a_model_with_a_wrong_estimate_is_tried_again_though_another_keeps_the_thread_busy() -> (
    None
):
    occupancy = Occupancy()
    wrong = CostModel()
    wrong.observe(WORK, 0.5)  # a stall; it takes 0.05 s
    model = LoadControl(8, 512, LoadPolicy(), wrong, Metrics(), occupancy)
    let_in_s = []
    for tick in range(200):
        now_s = 10.0 + 0.05 * tick
        occupancy.begin("other", 0.05, now_s)
        try:
            model.let_in(Place("arm", WORK, now_s + 0.4, now_s + 0.4), [], now_s, replaces=False)
        except Refusal:
            occupancy.end("other", now_s + 0.05)
            continue
        let_in_s.append(now_s)
        model.begin(WORK, now_s)
        occupancy.end("other", now_s + 0.05)
        model.end(WORK, now_s, now_s + 0.1, succeeded=True)
    assert wrong.predict(WORK) < 0.15
    assert len(let_in_s) > 50


def test_a_model_that_is_gone_is_not_waited_for() -> None:
    occupancy = Occupancy()
    costs = CostModel()
    costs.observe(WORK, 3.0)
    gone = LoadControl(8, 512, LoadPolicy(), costs, Metrics(), occupancy)
    gone.begin(WORK, 1.0)
    occupancy.begin("stays", 0.5, 1.5)
    assert occupancy.free_s("new", 1.5) == pytest.approx(4.5)
    gone.close()
    assert occupancy.free_s("new", 1.5) == pytest.approx(2.0)
