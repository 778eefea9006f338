"""Filler ahead of a query that follows a silence."""

from __future__ import annotations

import threading
from typing import Any

import pytest
from client_stubs import NARROW, WORDS, StubEdge, StubTransport, observation, serving
from hypothesis import given
from hypothesis import strategies as st

from comvla.v1.policy_pb2 import GetModelRequest
from comvla_client import ComVLAClient
from comvla_client.warm_up import SHORTEST_SILENCE_S, WarmUp, filler


@given(st.integers(0, 1 << 18))
def test_filler_is_a_request_that_says_nothing(nbytes: int) -> None:
    message = filler(nbytes)
    assert nbytes <= len(message) <= nbytes + 5
    assert GetModelRequest.FromString(message).protocol_version == 0


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def queried_every(interval_s: float, took_s: float, queries: int = 4) -> tuple[WarmUp, Clock]:
    clock = Clock()
    warm_up = WarmUp(lambda message: None, clock)
    for number in range(queries):
        clock.now = number * interval_s
        warm_up.query_begins(1000)
    clock.now += took_s
    return warm_up, clock


def test_filler_is_due_a_few_round_trips_before_the_next_query() -> None:
    warm_up, _ = queried_every(1.2, 0.04)
    due = warm_up.next_filler_at(0.04)
    assert due == pytest.approx(4 * 1.2 - 0.16)


def test_filler_never_comes_so_early_that_linux_forgets_again() -> None:
    warm_up, _ = queried_every(5.0, 1.0)
    due = warm_up.next_filler_at(1.0)
    assert due is not None
    assert 4 * 5.0 - due < SHORTEST_SILENCE_S


@pytest.mark.parametrize(("interval_s", "took_s"), [(0.05, 0.02), (0.2, 0.05)])
def test_queries_without_a_silence_between_need_no_filler(interval_s: float, took_s: float) -> None:
    warm_up, _ = queried_every(interval_s, took_s)
    assert warm_up.next_filler_at(took_s) is None


def test_nothing_is_sent_before_the_rhythm_is_known_or_after_a_query_without_answer() -> None:
    warm_up, _ = queried_every(1.2, 0.04, queries=1)
    assert warm_up.next_filler_at(0.04) is None
    warm_up, _ = queried_every(1.2, 0.04)
    assert warm_up.next_filler_at(None) is None


def test_filler_is_as_long_as_the_last_request_and_is_accounted_for() -> None:
    sent: list[bytes] = []
    arrived, clock = threading.Event(), Clock()

    def send(message: bytes) -> None:
        sent.append(message)
        arrived.set()
        raise OSError("no link: the next query will tell")

    warm_up = WarmUp(send, clock)
    # The last is long past its moment.
    for now, request_bytes in ((0.0, 70_000), (1.2, 70_000), (2.4, 70_000), (10.0, 50_000)):
        with warm_up._changed:  # time passes and the query begins in one, for the thread
            clock.now = now
            warm_up.query_begins(request_bytes)
        warm_up.query_ends(0.0)
        assert not sent
    clock.now = 20.0
    warm_up.query_ends(0.04)
    assert arrived.wait(10.0)
    assert len(sent[-1]) >= 50_000
    warm_up.close()
    assert warm_up.sent_bytes > 50_000


def test_a_client_with_warm_up_counts_its_filler_and_one_without_sends_none() -> None:
    options: dict[str, Any] = {"edge": StubEdge(), "link": NARROW, "budget": 4, "deadline_s": 20.0}
    with serving() as (target, _):
        with ComVLAClient(target, warm_up=True, **options) as client:
            assert client.step(observation(), WORDS).source == "cloud"
            assert client.filler_bytes == 0  # a single query has no rhythm
        with ComVLAClient(target, **options) as client:
            client.step(observation(), WORDS)
            assert client.filler_bytes == 0


def test_warm_up_is_refused_where_the_transport_is_the_callers_own() -> None:
    with pytest.raises(ValueError, match="give it to your transport"):
        ComVLAClient(StubTransport(), edge=StubEdge(), warm_up=True)
