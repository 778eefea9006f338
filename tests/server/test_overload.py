"""64 robots ask for more than a model can do, in simulated time: no clock of any machine is involved."""

from __future__ import annotations

import heapq
import itertools
import random
from dataclasses import dataclass, field

import pytest

from comvla_server.cost_model import CostModel, Work
from comvla_server.load_control import LoadControl
from comvla_server.load_policy import LoadPolicy
from comvla_server.metrics import Metrics
from comvla_server.refusals import Refusal
from comvla_server.tickets import Place

ROBOTS, BATCH, N = 64, 8, 512
FIXED_S, REQUEST_S, TOKEN_S = 0.010, 0.002, 0.00005
CAPACITY = BATCH / (FIXED_S + BATCH * REQUEST_S + BATCH * 128 * TOKEN_S)
DEADLINE_S = 4 * BATCH / CAPACITY


@dataclass
class Robot:
    """What became of one robot's requests."""

    answered: int = 0
    late: int = 0
    offered: int = 0
    tokens: list[int] = field(default_factory=list)


def pass_s(work: Work, rng: random.Random) -> float:
    """A pass, up to 10 % shorter or longer than usual."""
    usual_s = FIXED_S + REQUEST_S * work.requests + TOKEN_S * work.tokens
    return usual_s * rng.uniform(0.9, 1.1)


def simulate(load: float, policy: LoadPolicy, *, seconds: float = 30.0) -> list[Robot]:
    """The batcher's rules on an event queue: arrivals, and the ends of passes. Advice is followed."""
    rng = random.Random(0)
    control = LoadControl(BATCH, N, policy, CostModel(), Metrics())
    robots = [Robot() for _ in range(ROBOTS)]
    queue: dict[int, Place] = {}
    running: list[tuple[int, Place]] = []
    work, ready_s = Work(0, 0), 0.0
    period_s = ROBOTS / (load * CAPACITY)
    numbers = itertools.count()
    events = [(rng.random() * period_s, next(numbers), robot) for robot in range(ROBOTS)]
    heapq.heapify(events)
    while events[0][0] < seconds:
        now_s, _, robot = heapq.heappop(events)
        counted = now_s > 5.0
        if robot < 0:  # a pass ended
            control.end(work, ready_s, now_s, succeeded=True)
            for index, place in running:
                if now_s <= place.deadline_s:
                    robots[index].answered += counted
                else:
                    robots[index].late += counted
            running = []
        else:
            robots[robot].offered += counted
            k = min(128, control.suggested_tokens(now_s) or N)
            robots[robot].tokens.append(k)
            due_s = now_s + DEADLINE_S
            place = Place(str(robot), Work(1, k), due_s, due_s)
            older = queue.get(robot)
            if older is not None:
                place.due_s = older.due_s
            waiting = [p for index, p in queue.items() if index != robot]
            try:
                control.let_in(place, waiting, now_s, replaces=older is not None)
                queue[robot] = place
            except Refusal:
                pass
            again_s = now_s + period_s * rng.uniform(0.9, 1.1)
            heapq.heappush(events, (again_s, next(numbers), robot))
        if running or not queue:
            continue
        by_place = {id(place): index for index, place in queue.items()}
        for place in control.order(list(queue.values())):
            index = by_place[id(place)]
            if place.deadline_s <= now_s:
                robots[index].late += counted
                del queue[index]
            elif len(running) < BATCH:
                running.append((index, place))
                del queue[index]
        if running:
            work, ready_s = Work.of(place.work for _, place in running), now_s
            control.begin(work, now_s)
            heapq.heappush(events, (now_s + pass_s(work, rng), next(numbers), -1))
    return robots


def jain(values: list[int]) -> float:
    return sum(values) ** 2 / (len(values) * sum(value * value for value in values))


OFF = LoadPolicy(
    admission=False, fair_shares=False, earliest_deadline_first=False, advise_tokens=False
)


@pytest.mark.parametrize("load", [1.5, 10.0])
def test_who_is_let_in_is_answered_in_time_and_nobody_starves(load: float) -> None:
    robots = simulate(load, LoadPolicy(advise_tokens=False))
    answered, late = sum(r.answered for r in robots), sum(r.late for r in robots)
    assert answered / (answered + late) >= 0.99
    assert answered / 25.0 >= 0.9 * CAPACITY
    assert jain([r.answered for r in robots]) >= 0.97


def test_without_admission_the_same_robots_wait_and_die() -> None:
    off, on = (simulate(1.5, policy) for policy in (OFF, LoadPolicy(advise_tokens=False)))
    assert sum(r.late for r in off) > 10 * sum(r.late for r in on)
    assert sum(r.answered for r in off) < sum(r.answered for r in on)


def test_fewer_tokens_serve_more_robots_in_time() -> None:
    plain, advised = (simulate(1.5, LoadPolicy(advise_tokens=advise)) for advise in (False, True))
    shares = [
        sum(r.answered for r in robots) / sum(r.offered for r in robots)
        for robots in (plain, advised)
    ]
    assert shares[0] < 0.8
    assert shares[1] > 0.97
    late = [k for robot in advised for k in robot.tokens[-20:]]
    assert min(late) >= 20
    assert max(late) < 128  # crowded, so everyone sends fewer
    assert max(late) - min(late) < 25  # and the advice does not swing


def test_below_capacity_nobody_is_turned_away() -> None:
    robots = simulate(0.7, LoadPolicy())
    assert all(r.answered >= r.offered - 2 for r in robots)  # the last ones are still under way
    assert {k for robot in robots for k in robot.tokens} == {128}
