"""The batcher alone, on the event loop of the test."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Callable
from typing import Any

import numpy as np
import pytest
import pytest_asyncio
from server_stubs import PATIENCE_S, StubCloud, policy_request, stub_actions

from comvla_server.batcher import Batcher
from comvla_server.cost_model import CostModel, Work
from comvla_server.engine import Engine
from comvla_server.inference_thread import InferenceThread
from comvla_server.load_policy import LoadPolicy
from comvla_server.metrics import Metrics
from comvla_server.refusals import Reason, Refusal
from comvla_server.tickets import Answer

MakeBatcher = Callable[..., Batcher]


class Clock:
    """Monotonic seconds that pass when the test says so."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s


@pytest_asyncio.fixture
async def make(cloud: StubCloud) -> AsyncIterator[MakeBatcher]:
    """Builds started batchers around the stub and closes them."""
    made: list[tuple[Batcher, InferenceThread]] = []

    def build(**options: Any) -> Batcher:
        thread = InferenceThread()
        batcher = Batcher(Engine(cloud), thread=thread, **options)
        batcher.start()
        made.append((batcher, thread))
        return batcher

    yield build
    cloud.release()
    for batcher, thread in made:
        await batcher.close()
        assert thread.close(PATIENCE_S)


def soon() -> float:
    """A deadline that no test reaches."""
    return time.monotonic() + PATIENCE_S


def ask(
    batcher: Batcher, session: str, step: int = 0, name: float = 0.0, **options: Any
) -> asyncio.Task[Answer]:
    """A call in flight; its request is known to the stub by ``name``."""
    k = options.pop("k", 3)
    deadline_s = options.pop("deadline_s", soon())
    digest = options.pop("digest", b"same")
    request = policy_request(name, k)
    return asyncio.create_task(batcher.submit(session, step, request, deadline_s, digest))


async def refusal(task: asyncio.Task[Answer]) -> Refusal:
    """The refusal of a call that must not be answered."""
    with pytest.raises(Refusal) as caught:
        await asyncio.wait_for(task, PATIENCE_S)
    return caught.value


async def occupy(batcher: Batcher, cloud: StubCloud) -> asyncio.Task[Answer]:
    """Keeps the model busy with session ``first`` until the stub is released."""
    cloud.hold()
    task = ask(batcher, "first", name=-1.0)
    await asyncio.to_thread(cloud.wait_until_running)
    return task


async def queued(batcher: Batcher, depth: int) -> None:
    """Returns when so many wait."""
    deadline_s = time.monotonic() + PATIENCE_S
    while batcher.queue_depth != depth:
        assert time.monotonic() < deadline_s, "they never queued"
        await asyncio.sleep(0)


async def test_what_arrives_while_the_model_runs_shares_the_next_pass(
    make: MakeBatcher, cloud: StubCloud
) -> None:
    batcher = make(max_batch=4)
    first = await occupy(batcher, cloud)
    others = [ask(batcher, f"s{i}", name=i, k=i + 1) for i in range(6)]
    await queued(batcher, 6)
    cloud.release()
    answers = await asyncio.gather(*others)
    assert (await first).batch_size == 1
    assert cloud.batches == [[-1.0], [0.0, 1.0, 2.0, 3.0], [4.0, 5.0]]
    assert [a.batch_size for a in answers] == [4, 4, 4, 4, 2, 2]
    for i, answer in enumerate(answers):
        assert answer.tokens_used == i + 1
        assert answer.cloud_flops == 1000.0 * (i + 1)
        np.testing.assert_array_equal(answer.actions, stub_actions(policy_request(i, i + 1)))


async def test_max_batch_one_turns_batching_off(make: MakeBatcher, cloud: StubCloud) -> None:
    batcher = make(max_batch=1)
    first = await occupy(batcher, cloud)
    others = [ask(batcher, f"s{i}") for i in range(3)]
    await queued(batcher, 3)
    cloud.release()
    assert {a.batch_size for a in await asyncio.gather(first, *others)} == {1}


async def test_a_newer_observation_replaces_the_one_that_waits(
    make: MakeBatcher, cloud: StubCloud
) -> None:
    batcher = make(max_batch=1)
    first = await occupy(batcher, cloud)
    older = ask(batcher, "robot", 1, name=1.0)
    await queued(batcher, 1)
    neighbour = ask(batcher, "other", 0, name=9.0)
    await queued(batcher, 2)
    newer = ask(batcher, "robot", 2, name=2.0)
    refused = await refusal(older)
    assert refused.reason is Reason.SUPERSEDED
    assert "superseded by step 2" in refused.message
    cloud.release()
    await asyncio.gather(first, newer, neighbour)
    # The session keeps the place in the queue that its older observation had.
    assert cloud.batches == [[-1.0], [2.0], [9.0]]


async def test_an_observation_older_than_the_newest_is_refused(make: MakeBatcher) -> None:
    batcher = make()
    await ask(batcher, "robot", 5)
    refused = await refusal(ask(batcher, "robot", 4))
    assert refused.reason is Reason.SUPERSEDED
    assert "new session_id after a reset" in refused.message


async def test_the_running_observation_is_answered_though_a_newer_one_waits(
    make: MakeBatcher, cloud: StubCloud
) -> None:
    batcher = make()
    running = await occupy(batcher, cloud)
    newer = ask(batcher, "first", 1)
    await queued(batcher, 1)
    cloud.release()
    assert isinstance(await running, Answer)
    assert isinstance(await newer, Answer)


async def test_a_repeat_is_answered_from_the_record(make: MakeBatcher, cloud: StubCloud) -> None:
    batcher = make()
    once = await ask(batcher, "robot", 3)
    again = await ask(batcher, "robot", 3)
    assert again is once
    assert len(cloud.batches) == 1


@pytest.mark.parametrize("busy", [False, True], ids=["running", "queued"])
async def test_a_repeat_joins_the_one_in_flight(
    make: MakeBatcher, cloud: StubCloud, busy: bool
) -> None:
    batcher = make()
    first = await occupy(batcher, cloud)
    one = ask(batcher, "robot", 0) if busy else first
    session = "robot" if busy else "first"
    await queued(batcher, 1 if busy else 0)
    two = ask(batcher, session, 0)
    await asyncio.sleep(0)
    cloud.release()
    assert await one is await two
    await first
    assert len(cloud.batches) == (2 if busy else 1)


async def test_a_repeat_with_other_content_is_an_error(make: MakeBatcher) -> None:
    batcher = make()
    await ask(batcher, "robot", 0, digest=b"one")
    refused = await refusal(ask(batcher, "robot", 0, digest=b"two"))
    assert refused.reason is Reason.CONFLICT
    assert "expected the same bytes for a retry" in refused.message


async def test_a_full_queue_refuses_the_next_session_but_takes_a_newer_step(
    make: MakeBatcher, cloud: StubCloud
) -> None:
    batcher = make(max_queue=2, max_batch=8)
    first = await occupy(batcher, cloud)
    waiting = [ask(batcher, f"s{i}") for i in range(2)]
    await queued(batcher, 2)
    refused = await refusal(ask(batcher, "s2"))
    assert refused.reason is Reason.OVERLOAD
    assert "2 of 2 sessions wait" in refused.message
    newer = ask(batcher, "s0", 1)
    assert (await refusal(waiting[0])).reason is Reason.SUPERSEDED
    cloud.release()
    await asyncio.gather(first, waiting[1], newer)


async def test_a_request_past_its_deadline_costs_no_compute(
    make: MakeBatcher, cloud: StubCloud
) -> None:
    clock = Clock()
    batcher = make(clock=clock)
    first = asyncio.create_task(
        batcher.submit("first", 0, policy_request(-1.0), clock() + PATIENCE_S)
    )
    cloud.hold()
    await asyncio.to_thread(cloud.wait_until_running)
    late = ask(batcher, "late", name=1.0, deadline_s=clock() + PATIENCE_S)
    await queued(batcher, 1)
    clock.now_s += PATIENCE_S + 1
    cloud.release()
    refused = await refusal(late)
    assert refused.reason is Reason.DEADLINE
    await first
    assert cloud.batches == [[-1.0]]


async def test_a_deadline_that_has_passed_is_refused_at_once(
    make: MakeBatcher, cloud: StubCloud
) -> None:
    batcher = make()
    refused = await refusal(ask(batcher, "robot", deadline_s=time.monotonic() - 1))
    assert refused.reason is Reason.DEADLINE
    assert batcher.queue_depth == 0
    assert cloud.batches == []


async def test_a_cancelled_call_leaves_the_queue(make: MakeBatcher, cloud: StubCloud) -> None:
    batcher = make()
    first = await occupy(batcher, cloud)
    gone = ask(batcher, "gone", name=7.0)
    await queued(batcher, 1)
    gone.cancel()
    with pytest.raises(asyncio.CancelledError):
        await gone
    assert batcher.queue_depth == 0
    cloud.release()
    await first
    assert cloud.batches == [[-1.0]]


async def test_a_ticket_stays_while_one_of_its_callers_does(
    make: MakeBatcher, cloud: StubCloud
) -> None:
    batcher = make()
    first = await occupy(batcher, cloud)
    one, two = ask(batcher, "robot"), ask(batcher, "robot")
    await queued(batcher, 1)
    one.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await one
    assert batcher.queue_depth == 1
    cloud.release()
    assert isinstance(await two, Answer)
    await first


async def test_a_refused_step_may_be_sent_again(make: MakeBatcher, cloud: StubCloud) -> None:
    batcher = make()
    assert (await refusal(ask(batcher, "robot", 4, deadline_s=0.0))).reason is Reason.DEADLINE
    assert isinstance(await ask(batcher, "robot", 4, digest=b"fresh"), Answer)


async def test_a_request_that_breaks_the_model_breaks_it_for_nobody_else(
    make: MakeBatcher, cloud: StubCloud
) -> None:
    metrics = Metrics()
    batcher = make(metrics=metrics)
    first = await occupy(batcher, cloud)
    cloud.breaks_on = lambda r: ValueError("poison") if r.proprio[0] == 2.0 else None
    tasks = [ask(batcher, f"s{i}", name=i) for i in range(4)]
    await queued(batcher, 4)
    cloud.release()
    refused = await refusal(tasks.pop(2))
    assert refused.reason is Reason.MODEL
    assert "ValueError" in refused.message
    assert "poison" not in refused.message  # what the model says belongs in the server's log
    for i, answer in zip((0, 1, 3), await asyncio.gather(*tasks), strict=True):
        np.testing.assert_array_equal(answer.actions, stub_actions(policy_request(i)))
        assert answer.batch_size == 1
    await first
    assert metrics.registry.get_sample_value("comvla_model_errors_total") == 2  # together, alone


@pytest.mark.parametrize(
    "answer",
    [
        lambda requests: [],
        lambda requests: [np.zeros((2, 2), np.float32)] * len(requests),
        lambda requests: [np.full((3, 2), np.nan, np.float32)] * len(requests),
    ],
    ids=["missing", "wrong shape", "not finite"],
)
async def test_unusable_actions_never_reach_a_robot(
    make: MakeBatcher, cloud: StubCloud, answer: Any
) -> None:
    batcher = make()
    usual, cloud.answer = cloud.answer, answer
    assert (await refusal(ask(batcher, "robot"))).reason is Reason.MODEL
    cloud.answer = usual
    assert isinstance(await ask(batcher, "robot"), Answer)  # the failure is not on record


@pytest.mark.parametrize("error", [SystemExit(3), KeyboardInterrupt(), MemoryError()])
async def test_the_server_survives_whatever_a_model_raises(
    make: MakeBatcher, cloud: StubCloud, error: BaseException
) -> None:
    batcher = make()
    cloud.breaks_on = lambda _: error
    assert (await refusal(ask(batcher, "robot"))).reason is Reason.MODEL
    cloud.breaks_on = lambda _: None
    assert isinstance(await ask(batcher, "robot", 1), Answer)
    assert batcher.alive


async def test_closing_refuses_what_waits_and_what_runs(
    make: MakeBatcher, cloud: StubCloud
) -> None:
    batcher = make()
    running = await occupy(batcher, cloud)
    waiting = ask(batcher, "robot")
    await queued(batcher, 1)
    await batcher.close()
    assert (await refusal(running)).reason is Reason.DRAINING
    assert (await refusal(waiting)).reason is Reason.DRAINING
    assert not batcher.alive


async def test_least_recently_seen_sessions_are_forgotten_first(make: MakeBatcher) -> None:
    batcher = make(max_sessions=3, max_queue=2, max_batch=1)
    for name in ("a", "b", "c"):
        await ask(batcher, name, 5)
    await ask(batcher, "a", 6)
    await ask(batcher, "d", 5)
    assert [s.session_id for s in batcher.sessions] == ["c", "a", "d"]
    assert isinstance(await ask(batcher, "b", 0), Answer)  # forgotten: may count from 0
    assert (await refusal(ask(batcher, "a", 5))).reason is Reason.SUPERSEDED


async def test_a_session_that_waits_is_never_forgotten(make: MakeBatcher, cloud: StubCloud) -> None:
    batcher = make(max_sessions=2, max_queue=8, max_batch=1)
    first = await occupy(batcher, cloud)
    tasks = [ask(batcher, f"s{i}") for i in range(5)]
    await queued(batcher, 5)
    assert len(batcher.sessions) == 6
    cloud.release()
    await asyncio.gather(first, *tasks)
    await ask(batcher, "last")
    assert len(batcher.sessions) == 2


async def test_a_silent_session_may_start_again(make: MakeBatcher) -> None:
    clock = Clock()
    batcher = make(clock=clock, session_ttl_s=60.0)

    async def step(session: str, number: int) -> Answer:
        request = policy_request()
        return await batcher.submit(session, number, request, clock() + PATIENCE_S, b"")

    await step("robot", 100)
    clock.now_s += 59
    with pytest.raises(Refusal, match="superseded"):
        await step("robot", 0)
    clock.now_s += 2
    assert isinstance(await step("robot", 0), Answer)
    clock.now_s += 100
    await step("other", 0)
    assert [s.session_id for s in batcher.sessions] == ["other"]


async def test_utilization_is_the_busy_share_of_the_last_seconds(
    make: MakeBatcher, cloud: StubCloud
) -> None:
    clock = Clock()
    batcher = make(clock=clock)
    cloud.hold()
    task = ask(batcher, "robot", deadline_s=clock() + PATIENCE_S)
    await asyncio.to_thread(cloud.wait_until_running)
    assert batcher.utilization == 0.0
    clock.now_s += 2.5
    assert batcher.utilization == pytest.approx(0.5)
    cloud.release()
    await task
    clock.now_s += 10
    assert batcher.utilization == 0.0


async def test_gaps_between_answered_steps_are_steps_that_a_robot_bridged(
    make: MakeBatcher, cloud: StubCloud
) -> None:
    metrics = Metrics()
    batcher = make(metrics=metrics)
    cloud.release()
    # First seen at 7, whatever came before; 8 and 9 are missing, then 11 and 12; another robot none.
    for step in (7, 10, 13, 14):
        await ask(batcher, "a", step)
    await ask(batcher, "b", 3)
    await ask(batcher, "b", 3)
    assert metrics.registry.get_sample_value("comvla_unanswered_steps_total") == 4


async def test_the_earliest_deadline_is_computed_first(make: MakeBatcher, cloud: StubCloud) -> None:
    batcher = make(max_batch=1)
    first = await occupy(batcher, cloud)
    later = ask(batcher, "later", name=1.0, deadline_s=soon() + 20)
    await queued(batcher, 1)
    sooner = ask(batcher, "sooner", name=2.0, deadline_s=soon() + 10)
    await queued(batcher, 2)
    cloud.release()
    await asyncio.gather(first, later, sooner)
    assert cloud.batches == [[-1.0], [2.0], [1.0]]


async def test_in_order_of_arrival_where_deadlines_shall_not_count(
    make: MakeBatcher, cloud: StubCloud
) -> None:
    batcher = make(max_batch=1, load=LoadPolicy(earliest_deadline_first=False))
    first = await occupy(batcher, cloud)
    later = ask(batcher, "later", name=1.0, deadline_s=soon() + 20)
    await queued(batcher, 1)
    sooner = ask(batcher, "sooner", name=2.0, deadline_s=soon() + 10)
    await queued(batcher, 2)
    cloud.release()
    await asyncio.gather(first, later, sooner)
    assert cloud.batches == [[-1.0], [1.0], [2.0]]


async def test_asking_anew_does_not_cost_a_robot_its_turn(
    make: MakeBatcher, cloud: StubCloud
) -> None:
    batcher = make(max_batch=1)
    first = await occupy(batcher, cloud)
    older = ask(batcher, "eager", 0, name=1.0, deadline_s=soon() + 10)
    await queued(batcher, 1)
    other = ask(batcher, "other", 0, name=2.0, deadline_s=soon() + 20)
    await queued(batcher, 2)
    newer = ask(batcher, "eager", 1, name=3.0, deadline_s=soon() + 30)
    assert (await refusal(older)).reason is Reason.SUPERSEDED
    cloud.release()
    await asyncio.gather(first, other, newer)
    assert cloud.batches == [[-1.0], [3.0], [2.0]]


def known(seconds: float) -> CostModel:
    """Costs of a model whose passes all take so long."""
    costs = CostModel()
    for b, k in ((1, 3), (2, 6), (2, 12), (1, 9)) * 3:
        costs.observe(Work(b, k), seconds)
    return costs


async def held(make: MakeBatcher, cloud: StubCloud, clock: Clock, **options: Any) -> Batcher:
    """A batcher whose model, which takes a second, has begun a pass for session ``first``."""
    batcher = make(clock=clock, costs=known(1.0), **options)
    cloud.hold()
    ask(batcher, "first", name=-1.0, deadline_s=clock() + PATIENCE_S)
    await asyncio.to_thread(cloud.wait_until_running)
    return batcher


async def test_what_would_be_late_is_turned_away_at_once_and_costs_nothing(
    make: MakeBatcher, cloud: StubCloud
) -> None:
    clock, metrics = Clock(), Metrics()
    batcher = await held(make, cloud, clock, metrics=metrics)
    refused = await refusal(ask(batcher, "robot", deadline_s=clock() + 1.5))
    assert refused.reason is Reason.PREDICTED_LATE
    assert refused.retry_after_s == pytest.approx(0.5, abs=0.1)
    assert batcher.queue_depth == 0
    welcome = ask(batcher, "robot", deadline_s=clock() + 2.5)
    await queued(batcher, 1)
    assert metrics.registry.get_sample_value("comvla_predicted_wait_seconds_count") == 2
    cloud.release()
    assert isinstance(await welcome, Answer)
    assert [len(batch) for batch in cloud.batches] == [1, 1]


async def test_a_newer_observation_that_would_be_late_leaves_the_older_one_waiting(
    make: MakeBatcher, cloud: StubCloud
) -> None:
    clock = Clock()
    batcher = await held(make, cloud, clock)
    older = ask(batcher, "robot", 0, name=1.0, deadline_s=clock() + 2.5)
    await queued(batcher, 1)
    refused = await refusal(ask(batcher, "robot", 1, deadline_s=clock() + 0.5))
    assert refused.reason is Reason.PREDICTED_LATE
    cloud.release()
    assert isinstance(await older, Answer)


async def test_screening_turns_away_like_admission_and_lets_repeats_pass(
    make: MakeBatcher, cloud: StubCloud
) -> None:
    clock = Clock()
    batcher = await held(make, cloud, clock)
    with pytest.raises(Refusal) as caught:
        batcher.screen("robot", 0, 3, clock() + 0.5, pictures=False)
    assert caught.value.reason is Reason.PREDICTED_LATE
    batcher.screen("first", 0, 3, clock() + 0.5, pictures=False)  # it runs
    batcher.screen("robot", 0, 3, clock() + 5.0, pictures=False)
    assert batcher.queue_depth == 0


async def test_a_glance_tells_whether_a_request_like_the_others_would_be_late(
    make: MakeBatcher, cloud: StubCloud
) -> None:
    clock = Clock()
    batcher = await held(make, cloud, clock)
    refused = batcher.glance(clock() + 0.5)
    assert refused is not None
    assert refused.reason is Reason.CONGESTED
    assert batcher.glance(clock() + 5.0) is None


async def test_two_batchers_in_one_process_know_nothing_of_each_other(
    make: MakeBatcher, cloud: StubCloud
) -> None:
    one, two = make(), make()
    await ask(one, "robot", 5)
    assert isinstance(await ask(two, "robot", 0), Answer)
    assert (len(one.sessions), len(two.sessions)) == (1, 1)
