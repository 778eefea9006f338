"""What the client makes of a busy server's wishes, at times that the test chooses."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import grpc
import pytest
from client_stubs import (
    INFO,
    NARROW,
    WORDS,
    AsyncStubTransport,
    StubEdge,
    StubService,
    StubTransport,
    answer,
    fault,
    observation,
    serving,
)
from hypothesis import given
from hypothesis import strategies as st

from comvla.load_hints import RETRY_AFTER_MS, SUGGESTED_TOKENS, LoadHints
from comvla.v1.policy_pb2 import InferRequest, InferResponse
from comvla_client import ActionChunk, AsyncComVLAClient, ComVLAClient, TransportError, core
from comvla_client.advice import BackOff, TokenAdvice
from comvla_client.sending import Floor
from comvla_client.transport import GrpcTransport
from comvla_client.transport_aio import GrpcAioTransport

OBS = observation()
QUERY_S = INFO.action_horizon * INFO.control_period_s


class Clock:
    """Seconds that pass when the test says so."""

    def __init__(self) -> None:
        self.now_s = 50.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """The time by which clients forget hints and end pauses; pauses are as long as they may be."""
    clock = Clock()
    monkeypatch.setattr(core, "TokenAdvice", partial(TokenAdvice, clock=clock))
    monkeypatch.setattr(core, "BackOff", partial(BackOff, clock=clock, draw=lambda: 0.0))
    return clock


def suggesting(tokens: int) -> Callable[[InferRequest], InferResponse]:
    """An answer of a server that would like so many tokens."""
    return lambda request: answer(request, suggested_tokens=tokens)


def options(**changes: Any) -> dict[str, Any]:
    return {"edge": StubEdge(), "link": NARROW, "deadline_s": 20.0, **changes}


def busy(**hints: Any) -> TransportError:
    return fault("RESOURCE_EXHAUSTED", "too much is asked", LoadHints(**hints))


# ---- The bound on K ---------------------------------------------------------------------------


def test_a_hint_bounds_k_at_once_and_is_in_the_report(clock: Clock) -> None:
    transport = StubTransport(suggesting(7))
    with ComVLAClient(transport, **options()) as client:
        reports = [client.step(OBS, WORDS, 10.0).report for _ in range(3)]
    assert [r.tokens for r in reports] == [18, 7, 7]
    assert [r.advised_tokens for r in reports] == [None, 7, 7]
    assert [r.token_budget for r in reports] == [18, 18, 18]  # what the link would have carried


async def test_the_asyncio_client_does_the_same(clock: Clock) -> None:
    transport = AsyncStubTransport(suggesting(7), busy(retry_after_s=0.1, suggested_tokens=5))
    async with AsyncComVLAClient(transport, **options()) as client:
        first, second, third = [await client.step(OBS, WORDS, 10.0) for _ in range(3)]
        clock.now_s += 0.11
        fourth = await client.step(OBS, WORDS, 10.0)
    assert [c.report.tokens for c in (first, second, third, fourth)] == [18, 7, 0, 5]
    assert third.report.fallback_reason == "overloaded"
    assert len(transport.inner.requests) == 3


def test_a_hint_above_what_the_link_carries_changes_nothing(clock: Clock) -> None:
    with ComVLAClient(StubTransport(suggesting(30)), **options()) as client:
        assert [client.step(OBS, WORDS, 10.0).report.tokens for _ in range(2)] == [18, 18]


def test_the_bound_is_lifted_step_by_step_when_hints_cease(clock: Clock) -> None:
    with ComVLAClient(StubTransport(suggesting(4)), **options()) as client:
        client.step(OBS, WORDS, 10.0)
        sent = []
        for _ in range(5):
            sent.append(client.step(OBS, WORDS, 10.0).report.tokens)
            clock.now_s += 1.0
    assert sent == [4, 8, 16, 18, 18]


def test_a_wish_holds_for_a_robot_that_asks_but_once_in_seconds(clock: Clock) -> None:
    transport = StubTransport(suggesting(4), suggesting(4))
    with ComVLAClient(transport, **options()) as client:
        sent = []
        for _ in range(4):
            sent.append(client.step(OBS, WORDS, 10.0).report.tokens)
            clock.now_s += 3.0
    assert sent == [18, 4, 4, 18]  # the third answer has no wish: after it three seconds lift all


def test_silence_lifts_the_bound_later_than_an_answer_without_a_wish(clock: Clock) -> None:
    advice = TokenAdvice(512, clock=clock)
    advice.hear(16)
    advice.hear_refusal(0)
    clock.now_s += 4.9
    assert advice.most_tokens == 16
    clock.now_s += 2.1
    assert advice.most_tokens == 64
    advice.hear_refusal(20)
    assert advice.most_tokens == 20
    advice.hear(0)
    clock.now_s += 1.0
    advice.hear(0)
    clock.now_s += 1.0
    assert advice.most_tokens == 80
    clock.now_s += 10.0
    assert advice.most_tokens is None


def test_the_latest_hint_holds_whether_it_is_lower_or_higher(clock: Clock) -> None:
    transport = StubTransport(suggesting(9), suggesting(3), suggesting(12))
    with ComVLAClient(transport, **options()) as client:
        sent = [client.step(OBS, WORDS, 10.0).report.tokens for _ in range(4)]
    assert sent == [18, 9, 3, 12]


def test_what_must_be_sent_whole_is_not_bounded(clock: Clock) -> None:
    with ComVLAClient(StubTransport(suggesting(4)), **options(selector="full")) as client:
        assert [client.step(OBS, WORDS, 10.0).report.tokens for _ in range(2)] == [32, 32]


def test_no_hint_asks_for_fewer_tokens_than_are_useful(clock: Clock) -> None:
    chosen = options(sending=Floor(tokens=6))
    with ComVLAClient(StubTransport(suggesting(2)), **chosen) as client:
        assert [client.step(OBS, WORDS, 10.0).report.tokens for _ in range(2)] == [18, 6]


def test_the_bound_outlives_an_episode(clock: Clock) -> None:
    with ComVLAClient(StubTransport(suggesting(7)), **options()) as client:
        client.step(OBS, WORDS, 10.0)
        client.reset()
        assert client.step(OBS, WORDS, 10.0).report.tokens == 7


@given(st.integers(1, 10_000), st.floats(0.0, 1e6))
def test_a_bound_is_between_what_was_asked_and_all(hint: int, later_s: float) -> None:
    clock = Clock()
    advice = TokenAdvice(512, clock=clock)
    advice.hear(hint)
    clock.now_s += later_s
    bound = advice.most_tokens
    assert bound is None or min(hint, 512) <= bound < 512


# ---- The pause after a refusal ----------------------------------------------------------------


def step_while_busy(clock: Clock, *script: Any, pauses_s: list[float]) -> list[ActionChunk]:
    """One answer, then the script, with so many seconds after each step."""
    transport = StubTransport(None, *script)
    with ComVLAClient(transport, **options(execute=2)) as client:
        chunks = [client.step(OBS, WORDS, 10.0)]
        for pause_s in pauses_s:
            chunks.append(client.step(OBS, WORDS, 10.0))
            clock.now_s += pause_s
    return chunks


def test_after_a_refusal_the_robot_runs_its_chunk_and_sends_nothing_for_a_while(
    clock: Clock,
) -> None:
    chunks = step_while_busy(clock, busy(retry_after_s=0.03), pauses_s=[0.01, 0.01, 0.02, 0.0])
    assert [c.source for c in chunks] == ["cloud", "rest", "rest", "rest", "cloud"]
    assert [c.report.tokens for c in chunks] == [18, 18, 0, 0, 18]
    assert [c.report.fallback_reason for c in chunks[1:4]] == ["overloaded"] * 3
    assert chunks[1].report.detail == "too much is asked"
    assert "asking again in 0.020 s" in chunks[2].report.detail


def test_pauses_double_and_never_exceed_the_time_between_two_queries() -> None:
    clock = Clock()
    back_off = BackOff(0.4, clock=clock, draw=lambda: 0.0)
    pauses_s = [back_off.refused(0.03) for _ in range(7)]
    assert pauses_s == pytest.approx([0.03, 0.06, 0.12, 0.24, 0.4, 0.4, 0.4])
    back_off.answered()
    assert back_off.remaining_s == 0.0
    assert back_off.refused(0.03) == pytest.approx(0.03)


@given(
    st.floats(0.001, 10.0),
    st.lists(st.tuples(st.none() | st.floats(0.0, 1e6), st.floats(0.0, 1.0, exclude_max=True))),
)
def test_every_pause_is_bounded_and_drawn_from_its_upper_half(
    longest_s: float, refusals: list[tuple[float | None, float]]
) -> None:
    clock, doubled = Clock(), 1.0
    for hint_s, drawn in refusals:
        back_off = BackOff(longest_s, clock=clock, draw=lambda drawn=drawn: drawn)
        ceiling_s = min(longest_s, (0.25 * longest_s if hint_s is None else hint_s) * doubled)
        pause_s = back_off.refused(hint_s)
        assert 0.5 * ceiling_s <= pause_s * (1 + 1e-9)
        assert pause_s <= ceiling_s
        assert 0.0 <= back_off.remaining_s <= longest_s * (1 + 1e-9)


def test_robots_that_were_turned_away_together_do_not_come_back_together() -> None:
    clock = Clock()
    pauses_s = {BackOff(0.4, clock=clock).refused(0.2) for _ in range(64)}
    assert len(pauses_s) > 32
    assert max(pauses_s) - min(pauses_s) > 0.05


def test_the_pause_of_a_client_is_at_most_its_own_time_between_queries(clock: Clock) -> None:
    longest_s = 2 * INFO.control_period_s
    chunks = step_while_busy(
        clock, busy(retry_after_s=60.0), pauses_s=[0.99 * longest_s, 0.02 * longest_s, 0.0]
    )
    assert [c.report.tokens for c in chunks] == [18, 18, 0, 18]


def test_other_faults_make_nobody_pause(clock: Clock) -> None:
    chunks = step_while_busy(clock, fault("UNAVAILABLE"), fault("ABORTED"), pauses_s=[0, 0, 0])
    assert [c.report.tokens for c in chunks] == [18, 18, 18, 18]


def test_a_policy_that_learns_the_link_learns_nothing_from_a_busy_server(clock: Clock) -> None:
    learned = []

    class Listener(Floor):
        def learn(self, outcome: Any) -> None:
            learned.append(outcome.offered_tokens)

    script = (None, busy(retry_after_s=0.03))
    with ComVLAClient(StubTransport(*script), **options(sending=Listener())) as client:
        for _ in range(3):
            client.step(OBS, WORDS, 15.0)
    assert len(learned) == 1  # of the answer: not of the refusal, nor of the pause after it


# ---- On the wire ------------------------------------------------------------------------------


def test_hints_survive_the_metadata_and_nonsense_is_no_hint() -> None:
    hints = LoadHints(0.0373, 24)
    assert LoadHints.from_metadata(hints.to_metadata()) == LoadHints(0.038, 24)
    assert LoadHints().to_metadata() == ()
    for text in ("-1", "soon", "", "1.5", "9" * 40, "٣"):
        read = LoadHints.from_metadata([(RETRY_AFTER_MS, text), (SUGGESTED_TOKENS, text)])
        assert read == LoadHints()
    assert LoadHints.from_metadata([(RETRY_AFTER_MS, b"20")]).retry_after_s == 0.02
    assert LoadHints.from_metadata(None) == LoadHints()


def turn_away(request: InferRequest, context: grpc.ServicerContext) -> None:
    context.set_trailing_metadata(LoadHints(0.25, 12).to_metadata())
    context.abort(grpc.StatusCode.RESOURCE_EXHAUSTED, "too much is asked")


def a_request() -> InferRequest:
    return InferRequest(session_id="robot", model_fingerprint=INFO.fingerprint)


def test_hints_of_a_refusal_cross_a_socket() -> None:
    service = StubService()
    service.before = turn_away
    with serving(service) as (target, _):
        transport = GrpcTransport(target)
        with pytest.raises(TransportError, match="too much is asked") as caught:
            transport.infer(a_request(), 20.0)
        transport.close()
    assert caught.value.hints == LoadHints(0.25, 12)


async def test_hints_of_a_refusal_cross_a_socket_on_an_event_loop() -> None:
    service = StubService()
    service.before = turn_away
    with serving(service) as (target, _):
        transport = GrpcAioTransport(target)
        with pytest.raises(TransportError, match="too much is asked") as caught:
            await transport.infer(a_request(), 20.0)
        await transport.close()
    assert caught.value.hints == LoadHints(0.25, 12)
