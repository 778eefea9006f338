"""Names that stand for several servers: what a resolver that fails or is slow costs the robot."""

from __future__ import annotations

import queue
import socket
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from client_stubs import NARROW, WORDS, StubEdge, observation, serving
from waiting import until

from comvla.errors import HandshakeError
from comvla_client import AsyncComVLAClient, ComVLAClient
from comvla_client.look_up import LookUps
from comvla_client.roster import LOOK_UP_NOBODY_EVERY_S, Roster
from comvla_client.targets import Address, Addresses

TARGET = "backup:1,dns:///fleet:1"
BACKUP, ONE, TWO = (
    Address("backup:1"),
    Address("10.0.0.1:1", "fleet"),
    Address("10.0.0.2:1", "fleet"),
)


def resolve_by(monkeypatch: pytest.MonkeyPatch, answer: Callable[[str], list[str]]) -> None:
    """Lets ``answer`` give the IPv4 addresses of a host."""

    def getaddrinfo(host: str, port: int, **_: Any) -> list[Any]:
        stream = socket.SOCK_STREAM
        return [(socket.AF_INET, stream, 6, "", (place, port)) for place in answer(host)]

    monkeypatch.setattr(socket, "getaddrinfo", getaddrinfo)


def unknown(host: str) -> list[str]:
    """For :func:`resolve_by`: nobody knows any name."""
    raise socket.gaierror(socket.EAI_NONAME, "not known")


class Nothing:
    """A transport that only closes."""

    def close(self) -> None:
        """Does nothing."""


def test_a_look_up_that_fails_once_drops_no_server(monkeypatch: pytest.MonkeyPatch) -> None:
    known = ["10.0.0.1", "10.0.0.2"]

    def answer(host: str) -> list[str]:
        if not known:
            raise socket.gaierror(socket.EAI_AGAIN, "temporary failure")
        return list(known)

    resolve_by(monkeypatch, answer)
    addresses = Addresses(TARGET)
    roster: Roster[Nothing] = Roster(lambda address: Nothing())
    assert roster.update(addresses.look_up()) == []
    before = roster.members
    assert [member.address for member in before] == [BACKUP, ONE, TWO]
    known.clear()
    assert roster.update(addresses.look_up()) == []
    assert roster.members == before
    known.append("10.0.0.2")
    assert [gone.address for gone in roster.update(addresses.look_up())] == [ONE]


def test_one_name_that_fails_leaves_the_others_as_they_are_looked_up(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    known = {"here": ["10.0.0.1"], "there": ["10.0.1.1"]}

    def answer(host: str) -> list[str]:
        if host not in known:
            raise socket.gaierror(socket.EAI_NONAME, "not known")
        return known[host]

    resolve_by(monkeypatch, answer)
    addresses = Addresses("dns:///here:1,dns:///there:2")
    assert [one.target for one in addresses.look_up()] == ["10.0.0.1:1", "10.0.1.1:2"]
    del known["here"]
    known["there"] = ["10.0.1.2"]
    assert [one.target for one in addresses.look_up()] == ["10.0.0.1:1", "10.0.1.2:2"]


def test_a_name_that_was_never_known_stands_for_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    resolve_by(monkeypatch, unknown)
    assert Addresses(TARGET).look_up() == [BACKUP]


class Stuck:
    """A resolver that answers only when it is let go."""

    def __init__(self) -> None:
        self.asked, self.let_go, self.answered = (threading.Event() for _ in range(3))

    def __call__(self, host: str) -> list[str]:
        self.asked.set()
        self.let_go.wait(60.0)
        self.answered.set()
        return ["127.0.0.1"]


@pytest.fixture
def stuck(monkeypatch: pytest.MonkeyPatch) -> Iterator[Stuck]:
    """The system's resolver is stuck until the test is over."""
    resolver = Stuck()
    resolve_by(monkeypatch, resolver)
    yield resolver
    resolver.let_go.set()


def test_a_resolver_that_is_stuck_does_not_hold_up_a_client(stuck: Stuck) -> None:
    with pytest.raises(HandshakeError, match="stands for no server"):
        ComVLAClient("dns:///fleet:1", edge=StubEdge(), connect_timeout_s=0.2)
    assert stuck.asked.wait(20.0)
    assert not stuck.answered.is_set()


async def test_nor_the_asyncio_client(stuck: Stuck) -> None:
    client = AsyncComVLAClient("dns:///fleet:1", edge=StubEdge(), connect_timeout_s=0.2)
    with pytest.raises(HandshakeError, match="stands for no server"):
        await client.connect()
    assert stuck.asked.wait(20.0)
    assert not stuck.answered.is_set()


def test_servers_with_an_address_answer_while_a_resolver_is_stuck(stuck: Stuck) -> None:
    with serving() as (address, _):
        target = f"{address},dns:///fleet:1"
        with ComVLAClient(
            target, edge=StubEdge(), link=NARROW, budget=4, deadline_s=20.0
        ) as client:
            for _ in range(3):
                assert client.step(observation(), WORDS).source == "cloud"
    assert not stuck.answered.is_set()


def test_a_name_that_nobody_knows_is_not_looked_up_again_and_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[str] = []

    def answer(host: str) -> list[str]:
        asked.append(host)
        return unknown(host)

    resolve_by(monkeypatch, answer)
    began = time.monotonic()
    with pytest.raises(HandshakeError, match="stands for no server"):
        ComVLAClient("dns:///fleet:1", edge=StubEdge(), connect_timeout_s=0.4)
    until(lambda: bool(asked))
    # At once, and then no more often than this; on a busy machine 0.4 s last longer.
    took_s = time.monotonic() - began
    assert len(asked) <= 2 + took_s // LOOK_UP_NOBODY_EVERY_S


def test_a_name_is_looked_up_one_at_a_time_and_no_sooner_than_asked_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    begun, go_on = queue.SimpleQueue[str](), queue.SimpleQueue[list[str]]()

    def answer(host: str) -> list[str]:
        begun.put(host)
        return go_on.get(timeout=20.0)

    resolve_by(monkeypatch, answer)
    now_s = 100.0
    names = LookUps(Addresses("dns:///fleet:1"), clock=lambda: now_s)

    def found() -> bool:
        nonlocal news
        news = news or names.news(0.5)
        return bool(news)

    news: list[Address] = []
    assert names.news(0.5) == []
    assert begun.get(timeout=20.0) == "fleet"
    now_s += 10.0
    assert names.news(0.5) == [], "one is under way, and not waited for"
    assert begun.empty()
    now_s -= 9.6
    go_on.put(["10.0.0.1"])
    until(found)
    assert news == [ONE]
    assert names.news(0.5) == [], "that was told"
    assert begun.empty()
    now_s += 0.2
    assert names.news(0.5) == []
    assert begun.get(timeout=20.0) == "fleet"
    go_on.put([])


def test_without_a_name_nothing_is_looked_up(monkeypatch: pytest.MonkeyPatch) -> None:
    resolve_by(monkeypatch, lambda host: pytest.fail("looked up"))
    addresses = Addresses("a:1,b:2,a:1")
    assert addresses.fixed == [Address("a:1"), Address("b:2")]
    assert LookUps(addresses).news(0.0) == []
