"""Where all places are taken: who gets one, and whose."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from comvla_server.cost_model import CostModel, Work
from comvla_server.identity import ANYBODY, Identity, set_caller
from comvla_server.load_control import LoadControl
from comvla_server.load_policy import LoadPolicy
from comvla_server.metrics import Metrics
from comvla_server.refusals import Reason, Refusal
from comvla_server.sessions import Session
from comvla_server.tickets import Ticket
from comvla_server.waiting_room import WaitingRoom

WORK = Work(1, 10)
NOW_S = 10.0


@contextmanager
def calling(name: str) -> Iterator[None]:
    set_caller(Identity(name))
    yield
    set_caller(ANYBODY)


def room(size: int) -> WaitingRoom:
    return WaitingRoom(size, LoadControl(8, 512, LoadPolicy(), CostModel(), Metrics()))


def come(waiting: WaitingRoom, robot: str, session_id: str, within_s: float = 1.0) -> Ticket:
    with calling(robot):
        place = waiting.let_in(session_id, WORK, NOW_S + within_s, NOW_S)
    outcome = asyncio.get_running_loop().create_future()
    ticket = Ticket(session_id, 1, b"", None, place, NOW_S, outcome)
    waiting.seat(Session(session_id, NOW_S), ticket)
    return ticket


def run(story: Coroutine[Any, Any, None]) -> None:
    asyncio.run(story)


def test_who_opens_many_sessions_keeps_nobody_out() -> None:
    async def story() -> None:
        waiting = room(4)
        many = [come(waiting, "greedy", f"g{i}", 600.0 - i) for i in range(4)]
        honest = come(waiting, "arm", "arm-1", 0.4)
        assert len(waiting) == 4
        assert waiting.holds(honest)
        assert not waiting.holds(many[0])  # would have been computed last
        refusal = many[0].outcome.result()
        assert isinstance(refusal, Refusal)
        assert refusal.reason is Reason.FAIR_SHARE
        assert refusal.retry_after_s is not None
        come(waiting, "arm", "arm-2", 0.4)
        with pytest.raises(Refusal, match="queue is full"):  # two each: nothing to take
            come(waiting, "arm", "arm-3", 0.4)
        assert sum(waiting.holds(ticket) for ticket in many) == 2

    run(story())


def test_a_full_room_of_robots_with_a_place_each_takes_nobody_in() -> None:
    async def story() -> None:
        waiting = room(3)
        tickets = [come(waiting, f"arm-{i}", f"s{i}") for i in range(3)]
        with pytest.raises(Refusal) as caught:
            come(waiting, "late", "s9")
        assert caught.value.reason is Reason.OVERLOAD
        assert all(waiting.holds(ticket) for ticket in tickets)

    run(story())


def test_to_ask_whether_there_is_a_place_takes_none_away() -> None:
    async def story() -> None:
        waiting = room(3)
        tickets = [come(waiting, "greedy", f"g{i}") for i in range(3)]
        with calling("arm"):
            waiting.screen("arm", WORK, NOW_S + 1.0, NOW_S)
        assert all(waiting.holds(ticket) for ticket in tickets)

    run(story())
