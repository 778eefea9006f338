"""Overload over a real connection: what a robot is told, and where it stands in the metrics."""

from __future__ import annotations

import asyncio
import itertools
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import grpc
import numpy as np
import pytest
from numpy.typing import NDArray
from server_stubs import Robot, StubCloud, eventually, message

from comvla.load_hints import LoadHints
from comvla.v1 import policy_pb2
from comvla_server.background import BackgroundServer
from comvla_server.cost_model import CostModel, Work
from comvla_server.engine import Engine
from comvla_server.load_control import LoadControl
from comvla_server.load_policy import LoadPolicy
from comvla_server.loop_watch import LoopWatch
from comvla_server.metrics import Metrics
from comvla_server.models import Models
from comvla_server.refusals import Reason, Refusal
from comvla_server.screening import Screening
from comvla_server.settings import ServerSettings
from comvla_server.tickets import Place
from comvla_vla.request import PolicyRequest


def sample(server: BackgroundServer, name: str, **labels: str) -> float:
    value = server.server.metrics.registry.get_sample_value(f"comvla_{name}", labels)
    assert value is not None
    return value


def ask(robot: Robot, session: str, timeout_s: float) -> Any:
    """A call that is over."""
    call = robot.send(message(session), timeout_s)
    call.exception()
    return call


def told_in_time(robot: Robot) -> Any:
    """The first call of many that is turned away before its own deadline, which a busy machine may
    not keep: each has a little longer than the one before."""
    numbers = itertools.count()

    def turned_away() -> Any:
        number = next(numbers)
        call = ask(robot, f"robot-{number}", timeout_s=0.05 + 0.01 * number)
        return call if call.code() is grpc.StatusCode.RESOURCE_EXHAUSTED else None

    return eventually(turned_away)


def keep_loop_watch(server: BackgroundServer, late_s: float) -> None:
    """From now on the server's event loop counts as so late, whatever the machine does."""
    service = server.server._service
    assert service is not None
    watch = service.screening.loop_watch
    watch.look = lambda: None  # type: ignore[method-assign]
    watch.forget()
    watch.late_s = late_s


def test_what_cannot_be_answered_in_time_is_turned_away_with_a_hint_when_to_retry(
    server: BackgroundServer, robot: Robot, cloud: StubCloud
) -> None:
    # A loop that is late turns calls away unread, in the same words, and counts them elsewhere.
    keep_loop_watch(server, late_s=0.0)
    cloud.hold()
    running = robot.send(message("busy", name=-1.0))
    cloud.wait_until_running()
    # A pass that already took longer than the deadline will not end within it.
    call = told_in_time(robot)
    hints = LoadHints.from_metadata(call.trailing_metadata())
    assert hints.retry_after_s is not None
    assert 0.0 < hints.retry_after_s < 60.0
    assert "are predicted for 3 tokens; retry in" in call.details()
    assert sample(server, "requests_dropped_total", reason="predicted_late") >= 1
    eventually(lambda: sample(server, "queue_depth") == 0)
    cloud.release()
    assert running.result()
    assert {name for batch in cloud.batches for name in batch} == {-1.0}


def test_without_admission_requests_wait_for_their_deadline(cloud: StubCloud) -> None:
    settings = ServerSettings(admission=False)
    with BackgroundServer(Engine(cloud), settings) as server, Robot(server.target) as robot:
        cloud.forget()
        cloud.hold()
        running = robot.send(message("busy"))
        cloud.wait_until_running()
        for i in range(3):
            assert ask(robot, f"s{i}", 0.05).code() is grpc.StatusCode.DEADLINE_EXCEEDED
        cloud.release()
        assert running.result()


class SlowByTokens(StubCloud):
    """A pass takes a millisecond for each token."""

    def _actions(self, requests: list[PolicyRequest]) -> list[NDArray[np.float32]]:
        time.sleep(0.001 * sum(len(request.positions) for request in requests))
        return super()._actions(requests)


def test_a_crowded_server_advises_fewer_tokens_in_answers_refusals_and_metrics() -> None:
    cloud, settings = SlowByTokens(), ServerSettings(advise_least_tokens=1, max_batch=2)
    advised = threading.Event()
    # Looked at while robots ask: both fade as soon as they stop.
    loads: list[float] = []
    wishes: list[float] = []
    with BackgroundServer(Engine(cloud), settings) as server:

        def keep_asking(name: str) -> None:
            with Robot(server.target) as robot:
                for step in range(1000):
                    # About three passes: with four robots, deadlines are in danger.
                    call = robot.send(message(name, step, k=16), timeout_s=0.1)
                    if call.exception() is None and 0 < call.result().load.suggested_tokens < 16:
                        advised.set()
                    loads.append(sample(server, "offered_load_ratio"))
                    wishes.append(sample(server, "suggested_tokens"))
                    if advised.is_set() and max(loads) > 0.8 and any(0 < w < 16 for w in wishes):
                        return

        threads = [threading.Thread(target=keep_asking, args=(f"r{i}",)) for i in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert advised.is_set()
        assert max(loads) > 0.8
        assert any(0 < wish < 16 for wish in wishes)
        assert sample(server, "predicted_wait_seconds_count") >= 8


def test_where_the_loop_does_not_keep_up_calls_are_turned_away_unread(
    server: BackgroundServer, robot: Robot, cloud: StubCloud
) -> None:
    cloud.hold()
    running = robot.send(message("busy"))
    cloud.wait_until_running()
    keep_loop_watch(server, late_s=1.0)
    # Not each is turned away unread: it may become hopeless while it is read.
    congested = {"reason": "congested"}
    eventually(lambda: told_in_time(robot) and sample(server, "calls_refused_total", **congested))
    cloud.release()
    assert running.result()
    assert robot.infer(message("later"))  # a model that rests is worth a look


class Times:
    """Both clocks of a loop."""

    now_s = worked_s = 0.0


def looks(watch: LoopWatch, times: Times, count: int, busy: float, late_s: float = 0.0) -> None:
    for _ in range(count):
        times.now_s += 0.05 + late_s
        times.worked_s += busy * (0.05 + late_s)
        watch.look()


def test_a_loop_is_congested_where_it_works_all_the_time_or_comes_late() -> None:
    times = Times()
    watch = LoopWatch(lambda: times.now_s, lambda: times.worked_s)
    looks(watch, times, 20, busy=0.5)
    assert not watch.congested
    looks(watch, times, 20, busy=0.95)
    assert watch.congested
    looks(watch, times, 20, busy=0.3)
    assert not watch.congested
    looks(watch, times, 20, busy=0.3, late_s=0.2)
    assert watch.congested


def test_what_a_loop_missed_while_a_model_was_loaded_is_forgotten() -> None:
    times = Times()
    watch = LoopWatch(lambda: times.now_s, lambda: times.worked_s)
    looks(watch, times, 20, busy=0.95)
    for i in range(5):
        watch.note(died=True)
        watch.note(died=True, who=f"robot-{i}", hopeless=True)
    looks(watch, times, 1, busy=0.95, late_s=0.3)
    assert watch.congested
    assert watch.looked_at < 1.0
    times.now_s += 0.3  # the last thing before robots are answered, which the loop has not seen yet
    for i in range(10):
        watch.note(died=True, who=f"robot-{i}", hopeless=True)
    watch.forget()
    looks(watch, times, 20, busy=0.95)
    assert watch.looked_at == 1.0
    watch.forget()
    assert watch.looked_at == 1.0
    assert not watch.congested
    looks(watch, times, 3, busy=0.2)
    assert not watch.congested


def test_a_congested_loop_looks_at_fewer_calls_until_the_others_live() -> None:
    times, drawn = Times(), [0.5]
    watch = LoopWatch(lambda: times.now_s, lambda: times.worked_s, lambda: drawn[0])
    looks(watch, times, 10, busy=0.95)
    assert watch.looked_at == 1.0
    assert not watch.skips()
    for _ in range(5):
        for _ in range(10):
            watch.note(died=True)
        looks(watch, times, 1, busy=0.95)
    assert watch.looked_at == pytest.approx(0.8**5)
    assert watch.skips()
    drawn[0] = 0.1
    assert not watch.skips()
    for _ in range(60):
        watch.note(died=False)
        looks(watch, times, 1, busy=0.95)
    assert watch.looked_at == 1.0


def test_calls_that_die_while_the_loop_has_time_are_their_own_affair() -> None:
    times = Times()
    watch = LoopWatch(lambda: times.now_s, lambda: times.worked_s)
    for _ in range(20):
        for _ in range(10):
            watch.note(died=True)
        looks(watch, times, 1, busy=0.2)
    assert watch.looked_at == 1.0


def test_one_robot_whose_calls_are_hopeless_shuts_nobody_out() -> None:
    times = Times()
    watch = LoopWatch(lambda: times.now_s, lambda: times.worked_s)
    for _ in range(20):
        for i in range(50):
            watch.note(died=True, who="arm-7", hopeless=True)
            watch.note(died=False, who=f"robot-{i}")
        looks(watch, times, 1, busy=0.95)
    assert watch.looked_at == 1.0
    for i in range(10):  # many robots at once have waited where the loop does not see it
        watch.note(died=True, who=f"robot-{i}", hopeless=True)
    looks(watch, times, 1, busy=0.95)
    assert watch.looked_at < 1.0


def test_a_call_with_less_time_than_any_answer_takes_is_hopeless(
    server: BackgroundServer, robot: Robot
) -> None:
    service = server.server._service
    assert service is not None
    noted: list[tuple[str, bool]] = []
    service.screening.loop_watch.note = (  # type: ignore[method-assign]
        lambda *, died, who="", hopeless=False: noted.append((who, hopeless))
    )
    service.screening.note_lost("arm-7", 0.001)
    service.screening.note_lost("arm-8", 1.0)
    service.screening.note_lost("arm-9", None)
    assert noted == [("arm-7", True), ("arm-8", False), ("arm-9", False)]


@pytest.mark.parametrize(
    ("given_s", "given_up_after_s", "died"),
    [(1.0, 0.3, False), (1.0, 0.95, True), (0.1, 0.09, True), (None, 5.0, False)],
)
def test_a_call_taken_back_before_its_deadline_is_no_loss(
    given_s: float | None, given_up_after_s: float, died: bool
) -> None:
    now_s = 100.0
    screening = Screening(Models(), admission=True, clock=lambda: now_s)
    noted: list[bool] = []
    screening.loop_watch.note = (  # type: ignore[method-assign]
        lambda *, died, who="", hopeless=False: noted.append(died)
    )

    async def given_up() -> policy_pb2.InferResponse:
        nonlocal now_s
        now_s += given_up_after_s
        raise asyncio.CancelledError

    with pytest.raises(asyncio.CancelledError):
        asyncio.run(screening.watched(given_up(), policy_pb2.InferRequest(), given_s))
    assert noted == [died]


def test_a_glance_asks_every_model_that_a_call_may_mean() -> None:
    answers: list[Refusal | None] = []

    class Queue:
        def glance(self, deadline_s: float) -> Refusal | None:
            return answers.pop()

    class Two:
        batcher, default = Queue(), True

        def __iter__(self) -> Iterator[Two]:
            return iter((self, self))

    screening = Screening(Two(), admission=True, clock=lambda: 0.0)  # type: ignore[arg-type]
    screening.loop_watch.late_s = 1.0
    late, later = (Refusal(Reason.CONGESTED, "late", retry_after_s=s) for s in (0.1, 0.2))
    answers[:] = [None, late]
    assert screening.glance(0.05) is None
    answers[:] = [late, later]
    assert screening.glance(0.05) is late


def test_the_lag_of_answers_fades_with_time_and_a_halt_is_not_expected_again() -> None:
    control = LoadControl(8, 512, LoadPolicy(), CostModel(), Metrics())
    control.note_lag(2.0, 100.0)
    assert control.lag_s(100.0) == pytest.approx(0.25)
    assert control.lag_s(100.5) == pytest.approx(0.125)
    control.note_lag(0.001, 101.0)
    assert control.lag_s(101.0) == pytest.approx(0.0625)
    assert control.lag_s(110.0) < 0.001


def test_what_could_never_be_answered_and_what_was_not_read_is_no_load() -> None:
    costs = CostModel()
    costs.observe(Work(1, 10), 0.1)
    control = LoadControl(8, 512, LoadPolicy(), costs, Metrics())
    control.begin(Work(1, 10), 10.0)

    def refused(ask: Callable[..., object], had_s: float) -> float:
        place = Place("arm-7", Work(1, 10), 10.0 + had_s, 10.0 + had_s)
        with pytest.raises(Refusal):
            ask(place, [], 10.0, replaces=False)
        return control.load(10.0)

    assert refused(control.screen, 0.001) == 0.0
    assert refused(control.predict, 0.15) == 0.0
    assert refused(control.screen, 0.15) > 0.0


def test_a_few_robots_are_looked_at_however_slow_the_machine_is() -> None:
    times = Times()
    watch = LoopWatch(lambda: times.now_s, lambda: times.worked_s)
    for _ in range(20):
        watch.note(died=True)
        looks(watch, times, 1, busy=0.3, late_s=0.2)
    assert watch.looked_at == 1.0
