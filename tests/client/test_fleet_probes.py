"""Servers that were left out: each is asked by itself whether it is back, whatever the others do."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Iterator

import pytest
from waiting import until

from comvla_client import fleet_aio
from comvla_client.errors import TransportError
from comvla_client.fleet import FleetTransport
from comvla_client.fleet_aio import FleetAioTransport
from comvla_client.line import Line
from comvla_client.roster import FOREIGN_FOR_S, PROBED_AT_ONCE, Member, Roster
from comvla_client.targets import Address

SILENT = [f"127.0.0.1:{port}" for port in (1, 2, 3)]
BACK = "127.0.0.1:4"
TARGET = ",".join([*SILENT, BACK])


class Nothing:
    """A transport that only closes."""

    def close(self) -> None:
        """Does nothing."""


def all_down(count: int) -> Roster[Nothing]:
    """A fleet of which nobody is there."""
    roster: Roster[Nothing] = Roster(lambda address: Nothing())
    roster.update(Address(f"host:{port}") for port in range(1, count + 1))
    for member in roster.members:
        roster.leave(member)
    return roster


@pytest.fixture
def over() -> Iterator[threading.Event]:
    """Set when the test is over."""
    event = threading.Event()
    yield event
    event.set()


def test_a_server_that_is_back_is_found_while_others_are_silent(
    monkeypatch: pytest.MonkeyPatch, over: threading.Event
) -> None:
    asked: list[str] = []

    def is_well(line: Line) -> bool:
        asked.append(line.transport.target)
        return line.transport.target == BACK or over.wait(60.0)

    monkeypatch.setattr(Line, "is_well", is_well)
    fleet = FleetTransport(TARGET)
    members = {member.address.target: member for member in fleet._roster.members}
    for member in members.values():
        fleet._roster.leave(member)
    fleet._look_after()
    until(lambda: not members[BACK].down)
    until(lambda: set(SILENT) <= set(asked))
    assert all(members[target].down for target in SILENT)
    fleet._roster.leave(members[BACK])
    until(lambda: not members[BACK].down)
    assert all(asked.count(target) == 1 for target in SILENT), "asked while it owes an answer"
    fleet.close()


async def test_the_asyncio_client_finds_it_too(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    async def is_well(member: Member[object]) -> bool:
        asked.append(member.address.target)
        if member.address.target != BACK:
            await asyncio.sleep(60.0)
        return True

    monkeypatch.setattr(fleet_aio, "_is_well", is_well)
    fleet = FleetAioTransport(TARGET)
    members = {member.address.target: member for member in fleet._roster.members}
    for member in members.values():
        fleet._roster.leave(member)
    fleet._look_after()
    ends = time.monotonic() + 20.0
    while members[BACK].down or not set(SILENT) <= set(asked):
        assert time.monotonic() < ends, "waited in vain"
        await asyncio.sleep(0.005)
    assert all(members[target].down for target in SILENT)
    await fleet.close()


def test_few_are_asked_at_once_and_each_in_its_turn() -> None:
    roster = all_down(PROBED_AT_ONCE + 4)
    first = roster.to_probe()
    assert first == roster.members[:PROBED_AT_ONCE]
    assert roster.to_probe() == []
    for member in first[:6]:
        roster.probed(member, well=False)
    second = roster.to_probe()
    assert second[:4] == roster.members[PROBED_AT_ONCE:], "who waited longest comes first"
    assert second[4:] == first[:2]


def test_who_says_that_it_is_well_is_back_unless_a_call_to_it_failed_meanwhile() -> None:
    roster = all_down(2)
    one, other = roster.to_probe()
    roster.failed(other, TransportError("FAILED_PRECONDITION", "another model"))
    for member in (one, other):
        roster.probed(member, well=True)
    assert (one.down, other.down) == (False, True)
    assert other.probe_at - other.probed_at >= FOREIGN_FOR_S
    assert roster.to_probe() == []
