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
from comvla_server.occupancy import Occupancy
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


@dataclass
class Model:
    """The batcher's rules for one model: who waits, who is computed."""

    control: LoadControl
    queue: dict[int, Place] = field(default_factory=dict)
    running: list[tuple[int, Place]] = field(default_factory=list)
    work: Work = field(default_factory=lambda: Work(0, 0))
    ready_s: float = 0.0


def simulate(
    load: float, policy: LoadPolicy, *, seconds: float = 30.0, models: int = 1
) -> list[Robot]:
    """Arrivals and the ends of passes on an event queue. Advice is followed; models share a thread."""
    rng = random.Random(0)
    occupancy = Occupancy()
    served = [
        Model(LoadControl(BATCH, N, policy, CostModel(), Metrics(), occupancy))
        for _ in range(models)
    ]
    robots = [Robot() for _ in range(ROBOTS)]
    thread: list[Model] = []  # the first is computed, the others wait for it
    period_s = ROBOTS / (load * CAPACITY)
    numbers = itertools.count()
    events = [(rng.random() * period_s, next(numbers), robot) for robot in range(ROBOTS)]
    heapq.heapify(events)

    def compute(now_s: float) -> None:
        heapq.heappush(events, (now_s + pass_s(thread[0].work, rng), next(numbers), -1))

    while events[0][0] < seconds:
        now_s, _, robot = heapq.heappop(events)
        counted = now_s > 5.0
        if robot < 0:  # a pass ended
            model = thread.pop(0)
            model.control.end(model.work, model.ready_s, now_s, succeeded=True)
            for index, place in model.running:
                if now_s <= place.deadline_s:
                    robots[index].answered += counted
                else:
                    robots[index].late += counted
            model.running = []
            if thread:
                compute(now_s)
        else:
            model = served[robot % models]
            robots[robot].offered += counted
            k = min(128, model.control.suggested_tokens(now_s) or N)
            robots[robot].tokens.append(k)
            due_s = now_s + DEADLINE_S
            place = Place(str(robot), Work(1, k), due_s, due_s)
            older = model.queue.get(robot)
            if older is not None:
                place.due_s = older.due_s
            waiting = [p for index, p in model.queue.items() if index != robot]
            try:
                model.control.let_in(place, waiting, now_s, replaces=older is not None)
                model.queue[robot] = place
            except Refusal:
                pass
            again_s = now_s + period_s * rng.uniform(0.9, 1.1)
            heapq.heappush(events, (again_s, next(numbers), robot))
        if model.running or not model.queue:
            continue
        by_place = {id(place): index for index, place in model.queue.items()}
        for place in model.control.order(list(model.queue.values())):
            index = by_place[id(place)]
            if place.deadline_s <= now_s:
                robots[index].late += counted
                del model.queue[index]
            elif len(model.running) < BATCH:
                model.running.append((index, place))
                del model.queue[index]
        if model.running:
            model.work, model.ready_s = Work.of(p.work for _, p in model.running), now_s
            model.control.begin(model.work, now_s)
            thread.append(model)
            if len(thread) == 1:
                compute(now_s)
    return robots


def jain(values: list[int]) -> float:
    return sum(values) ** 2 / (len(values) * sum(value * value for value in values))


OFF = LoadPolicy(
    admission=False, fair_shares=False, earliest_deadline_first=False, advise_tokens=False
)


@pytest.mark.parametrize("models", [1, 2])
@pytest.mark.parametrize("load", [1.5, 10.0])
def test_who_is_let_in_is_answered_in_time_and_nobody_starves(load: float, models: int) -> None:
    robots = simulate(load, LoadPolicy(advise_tokens=False), models=models)
    answered, late = sum(r.answered for r in robots), sum(r.late for r in robots)
    assert answered / (answered + late) >= 0.99
    assert answered / 25.0 >= 0.9 * CAPACITY
    assert jain([r.answered for r in robots]) >= 0.97


def test_without_admission_the_same_robots_wait_and_die() -> None:
    off, on = (simulate(1.5, policy) for policy in (OFF, LoadPolicy(advise_tokens=False)))
    assert sum(r.late for r in off) > 10 * sum(r.late for r in on)
    assert sum(r.answered for r in off) < sum(r.answered for r in on)


@pytest.mark.parametrize("models", [1, 2])
def test_fewer_tokens_serve_more_robots_in_time(models: int) -> None:
    plain, advised = (
        simulate(1.5, LoadPolicy(advise_tokens=advise), models=models) for advise in (False, True)
    )
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


@pytest.mark.parametrize("models", [1, 2])
def test_below_capacity_nobody_is_turned_away(models: int) -> None:
    robots = simulate(0.7, LoadPolicy(), models=models)
    assert all(r.answered >= r.offered - 2 for r in robots)  # the last ones are still under way
    assert {k for robot in robots for k in robot.tokens} == {128}
