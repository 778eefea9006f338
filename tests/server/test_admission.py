"""Who may come in and whose turn it is, at times that the test chooses."""

from __future__ import annotations

import pytest

from comvla_server.admission import Admission
from comvla_server.cost_model import CostModel, Work
from comvla_server.fairness import FairShares
from comvla_server.load_policy import LoadPolicy
from comvla_server.refusals import Reason, Refusal
from comvla_server.tickets import Place

PASS_S = 0.1
NOW_S = 1000.0


def admission(shares: FairShares | None = None, **policy: object) -> Admission:
    """Batches of two, a pass takes 0.1 s, nothing is uncertain."""
    costs = CostModel()
    for _ in range(8):
        costs.observe(Work(2, 20), PASS_S)
    costs.fixed_s, costs.request_s, costs.token_s, costs.spread_s = PASS_S, 0.0, 0.0, 0.0
    options = {"deadline_margin_s": 0.0, **policy}
    return Admission(costs, shares or FairShares(), LoadPolicy(**options), 2)  # type: ignore[arg-type]


def place(within_s: float, robot: str = "robot") -> Place:
    return Place(robot, Work(1, 10), NOW_S + within_s, NOW_S + within_s)


def ask(
    judge: Admission,
    new: Place,
    waiting: list[Place],
    free_in_s: float = 0.05,
    *,
    overloaded: bool = False,
    replaces: bool = False,
) -> float:
    return judge.require(
        new, waiting, NOW_S + free_in_s, NOW_S, overloaded=overloaded, replaces=replaces
    )


def refused(*arguments: object, **options: bool) -> Refusal:
    with pytest.raises(Refusal) as caught:
        ask(*arguments, **options)  # type: ignore[arg-type]
    return caught.value


def test_the_earliest_deadline_is_computed_first() -> None:
    a, b, c = place(0.9), place(0.3), place(0.6)
    assert admission().order([a, b, c]) == [b, c, a]
    assert admission(earliest_deadline_first=False).order([a, b, c]) == [a, b, c]


def test_equal_deadlines_are_computed_in_order_of_arrival() -> None:
    places = [place(0.5) for _ in range(5)]
    assert admission().order(places) == places


def test_the_wait_is_what_runs_and_the_passes_before() -> None:
    judge = admission()
    assert ask(judge, place(1.0), []) == pytest.approx(0.05 + PASS_S)
    assert ask(judge, place(1.0), [place(0.9)]) == pytest.approx(0.05 + PASS_S)  # shares its pass
    assert ask(judge, place(1.0), [place(0.9)] * 2) == pytest.approx(0.05 + 2 * PASS_S)


def test_what_cannot_be_answered_in_time_is_turned_away_with_a_hint_when_to_retry() -> None:
    refusal = refused(admission(), place(0.2), [place(0.19), place(0.19)])
    assert refusal.reason is Reason.PREDICTED_LATE
    assert refusal.retry_after_s == pytest.approx(0.05)  # so much earlier it would have fitted
    assert "retry in 0.050 s" in refusal.message


def test_an_urgent_request_may_overtake_who_can_wait() -> None:
    judge = admission()
    patient = [place(0.9), place(0.9), place(0.9), place(0.9)]
    assert ask(judge, place(0.2), patient) == pytest.approx(0.05 + PASS_S)


def test_nobody_who_was_let_in_becomes_late_because_of_a_new_one() -> None:
    judge = admission()
    tight = [place(0.16), place(0.26), place(0.26), place(0.26)]
    judged = refused(judge, place(0.2), tight)
    assert judged.reason is Reason.PREDICTED_LATE
    assert judged.retry_after_s == pytest.approx(PASS_S)


def test_who_would_be_late_anyway_keeps_nobody_out() -> None:
    hopeless = place(0.01)
    assert ask(admission(), place(0.9), [hopeless]) == pytest.approx(0.05 + PASS_S)


def test_a_model_that_rests_tries_everything() -> None:
    assert ask(admission(), place(0.001), [], free_in_s=0.0) == pytest.approx(PASS_S)


def test_admission_can_be_switched_off() -> None:
    assert ask(admission(admission=False), place(0.01), [place(0.01)] * 4) > 0.01


def test_margins_are_kept_for_the_way_back_and_for_what_is_uncertain() -> None:
    judge = admission(deadline_margin_s=0.02)
    judge.lag_s = 0.03
    assert ask(judge, place(0.21), []) == pytest.approx(0.05 + PASS_S + 0.05)
    assert refused(judge, place(0.19), []).reason is Reason.PREDICTED_LATE


def test_under_overload_who_got_more_steps_back_and_who_got_less_does_not() -> None:
    shares = FairShares()
    for robot, answers in (("rich", 3.0), ("poor", 1.0)):
        shares.note_asked(robot, NOW_S)
        shares.credit(robot, NOW_S, answers)
    judge = admission(shares)
    waiting = [place(0.49, "a"), place(0.49, "b")]
    refusal = refused(judge, place(0.5, "rich"), waiting, overloaded=True)
    assert refusal.reason is Reason.FAIR_SHARE
    assert refusal.retry_after_s == pytest.approx(PASS_S)
    assert ask(judge, place(0.5, "poor"), waiting, overloaded=True) > 0
    # Not without overload, not while there is room, and not for a newer observation.
    assert ask(judge, place(0.5, "rich"), waiting) > 0
    assert ask(judge, place(0.5, "rich"), [], overloaded=True) > 0
    assert ask(judge, place(0.5, "rich"), waiting, overloaded=True, replaces=True) > 0
    assert ask(admission(shares, fair_shares=False), place(0.5, "rich"), waiting, overloaded=True)


def test_under_overload_the_queue_leaves_time_to_spare() -> None:
    judge, waiting = admission(), [place(0.3), place(0.3)]
    assert ask(judge, place(0.3), waiting) == pytest.approx(0.25)
    late = refused(judge, place(0.3), waiting, overloaded=True)
    assert late.reason is Reason.PREDICTED_LATE
    assert late.retry_after_s == pytest.approx(0.25 - 0.6 * 0.3)
    # A batch that is not full yet costs nobody anything.
    assert ask(judge, place(0.16), waiting[:1], overloaded=True) == pytest.approx(0.15)


def test_answers_of_long_ago_and_robots_that_left_do_not_count() -> None:
    shares = FairShares(memory_s=10.0)
    for robot in ("early", "late"):
        shares.note_asked(robot, 0.0)
    shares.credit("early", 0.0, 5.0)
    assert shares.above_mean("early", 0.0)
    shares.note_asked("late", 40.0)
    shares.credit("late", 40.0)
    assert len(shares) == 1  # the other was silent for three memories
    assert not shares.above_mean("late", 40.0)


def test_the_mean_is_the_mean_of_what_is_left_of_each() -> None:
    shares = FairShares(memory_s=10.0)
    for i, robot in enumerate("abcd"):
        shares.note_asked(robot, float(i))
        shares.credit(robot, float(i), 1.0 + i)
    shares.credit("d", 5.0, -2.0)
    above = [robot for robot in "abcd" if shares.above_mean(robot, 6.0)]
    assert above == ["c"]


def test_robots_remembered_are_bounded() -> None:
    shares = FairShares(most=3)
    for i in range(10):
        shares.note_asked(str(i), NOW_S)
        shares.credit(str(i), NOW_S)
    assert len(shares) == 3
    assert not shares.above_mean("9", NOW_S)
