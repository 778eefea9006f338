"""One server gone and another busy: the robot hears the busy one in time."""

from __future__ import annotations

import grpc
import pytest
from client_stubs import NARROW, WORDS, StubEdge, StubService, fault, observation, serving

from comvla.load_hints import LoadHints
from comvla_client import AsyncComVLAClient, ComVLAClient
from comvla_client.errors import TransportError
from comvla_client.report import ActionChunk
from comvla_client.roster import Roster
from comvla_client.search import Search
from comvla_client.targets import Address

OBS = observation()
REFUSED = "127.0.0.1:1"
HOUR_S = 3600.0
AWAY = fault("UNAVAILABLE")
BUSY, BUSIER = (fault("RESOURCE_EXHAUSTED", hints=LoadHints(s, 16)) for s in (0.1, 0.2))


class Nothing:
    """A transport that only closes."""

    def close(self) -> None:
        """Does nothing."""


def searching(
    *answers: TransportError, timeout_s: float = HOUR_S
) -> tuple[Search[Nothing], dict[str, TransportError]]:
    """A search among servers that always answer so, and the answers by target."""
    roster: Roster[Nothing] = Roster(lambda address: Nothing())
    targets = [f"host:{port}" for port in range(1, len(answers) + 1)]
    roster.update(map(Address, targets))
    search = Search(roster, ",".join(targets), timeout_s)
    return search, dict(zip(targets, answers, strict=True))


def outcome(search: Search[Nothing], says: dict[str, TransportError]) -> tuple[list[str], object]:
    """Who was asked, in order, and what was raised in the end; nobody really waits in between."""
    asked: list[str] = []
    try:
        while len(asked) < 100:
            member = search.next()
            if member is None:
                search.pause_s()
                continue
            asked.append(member.address.target)
            search.failed(member, says[member.address.target])
    except TransportError as error:
        return asked, error
    return asked, None


def test_who_is_away_is_asked_once_more_where_another_is_busy() -> None:
    asked, error = outcome(*searching(AWAY, BUSY, AWAY))
    assert error is BUSY
    assert sorted(asked) == ["host:1", "host:1", "host:2", "host:3", "host:3"]


def test_of_several_who_are_busy_that_one_is_told_who_has_time_first() -> None:
    asked, error = outcome(*searching(BUSIER, AWAY, BUSY))
    assert error is BUSY
    assert len(asked) == 4


def test_who_is_away_is_asked_again_and_again_where_nobody_is_busy() -> None:
    asked, error = outcome(*searching(AWAY, fault("FAILED_PRECONDITION")))
    assert error is None
    assert asked.count("host:1") == 99


def test_who_comes_back_only_to_be_busy_is_told() -> None:
    search, says = searching(AWAY)
    member = search.next()
    assert member is not None
    search.failed(member, AWAY)
    search.pause_s()
    says["host:1"] = BUSY
    assert outcome(search, says) == (["host:1"], BUSY)


def test_a_busy_server_is_told_where_the_time_is_over_before_the_rest_may_be_asked_again() -> None:
    _, error = outcome(*searching(AWAY, BUSY, timeout_s=0.0))
    assert error is BUSY


def test_a_busy_server_is_told_where_the_clock_cut_short_an_attempt_to_one_that_was_down() -> None:
    late = fault("DEADLINE_EXCEEDED")
    for down, told in ((True, BUSY), (False, late)):
        search, _ = searching(BUSY, late)
        first, second = search.next(), search.next()
        assert first is not None
        assert second is not None
        search.failed(first, BUSY)
        second.down = down
        with pytest.raises(TransportError) as caught:
            search.failed(second, late)
        assert caught.value is told


def test_that_nobody_was_known_at_first_is_not_told_of_a_server_that_is_late() -> None:
    late = fault("DEADLINE_EXCEEDED")
    roster: Roster[Nothing] = Roster(lambda address: Nothing())
    search = Search(roster, "dns:///fleet:1", HOUR_S)
    assert search.next() is None
    assert search.pause_s() > 0.0
    roster.update([Address("host:1")])
    member = search.next()
    assert member is not None
    with pytest.raises(TransportError) as caught:
        search.failed(member, late)
    assert caught.value is late


def crowded() -> StubService:
    """A server that answers the handshake, has no time, and asks for at most 3 tokens."""
    service = StubService()

    def before(request: object, context: grpc.ServicerContext) -> None:
        context.set_trailing_metadata(LoadHints(HOUR_S, 3).to_metadata())
        context.abort(grpc.StatusCode.RESOURCE_EXHAUSTED, "too much is asked")

    service.before = before
    return service


def check(refused: ActionChunk, after: ActionChunk) -> None:
    """The refusal was heard, and the next step knows of it."""
    assert refused.report.fallback_reason == after.report.fallback_reason == "overloaded"
    assert refused.report.detail == "too much is asked"
    assert after.report.advised_tokens == 3


def test_the_robot_hears_a_busy_server_while_another_is_gone() -> None:
    with serving(crowded()) as (busy, _):
        client = ComVLAClient(
            f"{REFUSED},{busy}", edge=StubEdge(), link=NARROW, budget=4, deadline_s=20.0
        )
        with client:
            check(client.step(OBS, WORDS), client.step(OBS, WORDS))


async def test_the_asyncio_client_hears_it_too() -> None:
    with serving(crowded()) as (busy, _):
        client = AsyncComVLAClient(
            f"{REFUSED},{busy}", edge=StubEdge(), link=NARROW, budget=4, deadline_s=20.0
        )
        async with client:
            check(await client.step(OBS, WORDS), await client.step(OBS, WORDS))
