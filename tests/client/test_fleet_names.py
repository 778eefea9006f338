"""Names that stand for several servers: what a resolver that fails or is slow costs the robot."""

from __future__ import annotations

import socket
from collections.abc import Callable
from typing import Any

import pytest

from comvla_client.roster import Roster
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
    def answer(host: str) -> list[str]:
        raise socket.gaierror(socket.EAI_NONAME, "not known")

    resolve_by(monkeypatch, answer)
    assert Addresses(TARGET).look_up() == [BACKUP]
