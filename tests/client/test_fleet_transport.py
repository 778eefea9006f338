"""Several servers that answer alike: turns, and no step lost when one of them is gone, silent, or another model's."""

from __future__ import annotations

import asyncio
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import grpc
import pytest
from client_stubs import (
    NARROW,
    WORDS,
    StubEdge,
    StubService,
    fault,
    observation,
    other_model,
    reserved_port,
    serving,
    set_deadline,
)
from frozen_proxy import FrozenProxy

from comvla.errors import HandshakeError
from comvla.load_hints import LoadHints
from comvla.v1.policy_pb2 import InferRequest
from comvla_client import AsyncComVLAClient, ClientClosedError, ComVLAClient
from comvla_client.errors import TransportError
from comvla_client.fleet import FleetTransport
from comvla_client.line import Line
from comvla_client.roster import MOST_PROBED, Roster
from comvla_client.search import worst
from comvla_client.targets import Address, Addresses, is_fleet
from comvla_client.transport import GrpcTransport

OBS = observation()
AWAY = ("unavailable", "deadline")
REFUSED = "127.0.0.1:1"
OPTIONS: dict[str, Any] = {"link": NARROW, "budget": 4, "deadline_s": 20.0}


def client_of(*targets: str, **options: Any) -> ComVLAClient:
    return ComVLAClient(",".join(targets), edge=StubEdge(), **{**OPTIONS, **options})


def eventually(claim: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + 30.0
    while not claim():
        assert time.monotonic() < deadline_s, "it never came true"
        time.sleep(0.005)


@contextmanager
def two_servers() -> Iterator[tuple[tuple[str, StubService], tuple[str, StubService]]]:
    with serving() as one, serving() as other:
        yield one, other


@pytest.mark.usefixtures("patient")
def test_servers_take_turns() -> None:
    with two_servers() as ((a, one), (b, other)), client_of(a, b) as client:
        assert all(client.step(OBS, WORDS).source == "cloud" for _ in range(10))
    assert len(one.requests) == len(other.requests) == 5
    steps = {request.step for request in one.requests + other.requests}
    assert steps == set(range(10)), "each step was sent once"


def test_no_step_is_lost_when_one_goes_and_it_is_asked_again_when_it_is_back() -> None:
    with serving() as (a, one), reserved_port() as port:
        with ExitStack() as second:
            b, _ = second.enter_context(serving(port=port))
            client = client_of(a, b)
            for _ in range(4):
                assert client.step(OBS, WORDS).source == "cloud"
            second.close()
            for _ in range(4):
                assert client.step(OBS, WORDS).source == "cloud"
        with serving(port=port) as (_, again):

            def asked() -> bool:
                assert client.step(OBS, WORDS).source == "cloud"
                return bool(again.requests)

            eventually(asked)
        client.close()
    assert one.requests


def test_a_server_that_went_silent_costs_no_step() -> None:
    with two_servers() as ((a, _), (b, other)):
        proxy = FrozenProxy(int(a.rpartition(":")[2]))
        with client_of(proxy.target, b) as client:
            for _ in range(4):
                assert client.step(OBS, WORDS).source == "cloud"
            proxy.freeze()
            before = len(other.requests)
            for _ in range(6):
                assert client.step(OBS, WORDS).source == "cloud"
            assert len(other.requests) == before + 6
            proxy.thaw()

            def back() -> bool:
                count = len(other.requests)
                assert client.step(OBS, WORDS).source == "cloud"
                return len(other.requests) == count

            eventually(back)


@pytest.mark.usefixtures("pings_in_time")
def test_a_server_that_is_merely_slow_is_waited_for_and_nothing_sent_twice() -> None:
    def requests_that_came() -> int:
        with two_servers() as ((a, one), (b, other)), client_of(a, b) as client:
            for _ in range(8):  # which tell the client what a call usually takes
                assert client.step(OBS, WORDS).source == "cloud"
            for service in (one, other):
                service.before = lambda *_: time.sleep(0.6)
            for _ in range(2):
                assert client.step(OBS, WORDS).source == "cloud"
        return len(one.requests) + len(other.requests)

    # A busy machine may delay a ping, too, but not every time.
    assert any(requests_that_came() == 10 for _ in range(5))


@pytest.mark.usefixtures("patient")
def test_a_server_of_another_model_is_left_out() -> None:
    with serving() as (a, one), serving() as (b, other), client_of(a, b) as client:
        assert client.step(OBS, WORDS).source == "cloud"
        other.info = other_model(fingerprint="0ther")  # replaced while the robot runs
        for _ in range(6):
            assert client.step(OBS, WORDS).source == "cloud"
        assert len(other.requests) <= 2
        one.info = other.info
        with pytest.raises(HandshakeError, match="another model"):
            client.step(OBS, WORDS)


@pytest.mark.usefixtures("patient")
def test_a_server_of_another_model_is_no_reason_to_stop_while_the_right_one_restarts() -> None:
    with serving() as (b, other), reserved_port() as port, ExitStack() as right:
        a, _ = right.enter_context(serving(port=port))
        with client_of(a, b) as client:
            assert client.step(OBS, WORDS).source == "cloud"
            other.info = other_model(fingerprint="0ther")
            right.close()
            asked = len(other.requests)
            set_deadline(client, 0.5)
            for _ in range(3):
                assert client.step(OBS, WORDS).report.fallback_reason in AWAY
            assert len(other.requests) <= asked + 3, "asked again in the same step"
            with serving(port=port):
                eventually(lambda: client.step(OBS, WORDS).source == "cloud")


async def test_the_asyncio_client_waits_for_the_right_server_too() -> None:
    with serving() as (b, other), ExitStack() as right:
        a, _ = right.enter_context(serving())
        options = {**OPTIONS, "deadline_s": 0.5}
        async with AsyncComVLAClient(f"{a},{b}", edge=StubEdge(), **options) as client:
            other.info = other_model(fingerprint="0ther")
            right.close()
            for _ in range(3):
                chunk = await client.step(OBS, WORDS)
                assert chunk.report.fallback_reason in AWAY


def too_busy(request: InferRequest, context: grpc.ServicerContext) -> None:
    context.abort(grpc.StatusCode.RESOURCE_EXHAUSTED, "too much is asked")


@pytest.mark.usefixtures("patient")
def test_a_busy_server_does_not_silence_the_robot_towards_the_others() -> None:
    with two_servers() as ((a, one), (b, other)), client_of(a, b, execute=8) as client:
        assert all(client.step(OBS, WORDS).source == "cloud" for _ in range(2))
        one.before = too_busy
        assert all(client.step(OBS, WORDS).source == "cloud" for _ in range(6))
        other.before = too_busy
        asked = len(one.requests), len(other.requests)
        refused, waits = (client.step(OBS, WORDS).report for _ in range(2))
        assert (len(one.requests), len(other.requests)) == (asked[0] + 1, asked[1] + 1)
    assert refused.fallback_reason == waits.fallback_reason == "overloaded"
    assert refused.detail == "too much is asked"
    assert "asking again in" in waits.detail


async def test_the_asyncio_client_asks_another_server_where_one_is_busy() -> None:
    with two_servers() as ((a, one), (b, _)):
        one.before = too_busy
        async with AsyncComVLAClient(f"{a},{b}", edge=StubEdge(), **OPTIONS) as client:
            for _ in range(6):
                assert (await client.step(OBS, WORDS)).source == "cloud"


def test_what_is_told_of_several_servers_is_what_may_pass_soonest() -> None:
    gone, foreign = fault("UNAVAILABLE"), fault("FAILED_PRECONDITION")
    busy, later = (fault("RESOURCE_EXHAUSTED", hints=LoadHints(s, 0)) for s in (0.1, 0.2))
    assert worst([foreign, busy, gone]) is gone
    assert worst([foreign, later, busy]) is busy
    assert worst([foreign, foreign]) is foreign


def test_all_gone_is_a_fallback_and_the_first_to_return_is_found() -> None:
    with reserved_port() as port:
        with serving() as (a, _), serving(port=port) as (b, _):
            client = client_of(a, b)
            assert client.step(OBS, WORDS).source == "cloud"
        set_deadline(client, 0.5)
        reasons = [client.step(OBS, WORDS).report.fallback_reason for _ in range(3)]
        # On a busy machine a step may end before both were asked.
        assert "unavailable" in reasons
        assert set(reasons) <= set(AWAY)
        with serving(port=port):
            eventually(lambda: client.step(OBS, WORDS).source == "cloud")
        client.close()


@pytest.mark.usefixtures("patient")
def test_a_name_stands_for_its_servers() -> None:
    with serving() as (a, service):
        target = f"dns:///localhost:{a.rpartition(':')[2]}"
        with client_of(target) as client:
            for _ in range(4):
                assert client.step(OBS, WORDS).source == "cloud"
    assert len(service.requests) == 4


@pytest.mark.usefixtures("patient")
def test_a_name_is_looked_up_again_when_a_server_is_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    with ExitStack() as first, serving() as (b, other):
        a, _ = first.enter_context(serving())
        known = [a]

        def look_up(self: Addresses) -> list[Address]:
            return [Address(target, "fleet") for target in known]

        monkeypatch.setattr(Addresses, "look_up", look_up)
        with client_of("dns:///fleet:1") as client:
            assert client.step(OBS, WORDS).source == "cloud"
            first.close()
            known[:] = [b]
            assert client.step(OBS, WORDS).source == "cloud"
    assert len(other.requests) == 1


def test_a_name_that_nobody_knows() -> None:
    with pytest.raises(HandshakeError, match="stands for no server"):
        client_of("dns:///nowhere.invalid:1", connect_timeout_s=0.2)


@pytest.mark.parametrize(
    "target", ["a:1,", ",a:1", "a:1,b", "a:1,http://b:1", "dns:///a", "dns:///"]
)
def test_what_is_no_address_is_refused(target: str) -> None:
    with pytest.raises(HandshakeError, match="expected a target host:port"):
        client_of(target)


def test_warm_up_is_for_one_connection() -> None:
    with pytest.raises(ValueError, match="take turns"):
        client_of("a:1", "b:1", warm_up=True)


def test_closing_ends_a_step_in_another_thread() -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent, serving() as (a, service):
        entered = threading.Event()

        def wait(request: Any, context: Any) -> None:
            entered.set()
            context.add_callback(released.set)
            released.wait(20.0)

        released = threading.Event()
        client = client_of(a, f"127.0.0.1:{silent.getsockname()[1]}")
        service.before = wait
        ended: list[BaseException] = []

        def step() -> None:
            try:
                client.step(OBS, WORDS)
            except BaseException as error:
                ended.append(error)

        thread = threading.Thread(target=step)
        thread.start()
        assert entered.wait(20.0)
        client.close()
        thread.join(20.0)
        assert not thread.is_alive()
        assert [type(error) for error in ended] == [ClientClosedError]
        with pytest.raises(ClientClosedError):
            client.step(OBS, WORDS)


def test_a_call_over_a_closed_line_fails_at_once() -> None:
    line = Line(GrpcTransport(REFUSED, patient=False))
    assert line.submit(lambda: 7).result(30.0) == 7
    line.close()
    with pytest.raises(TransportError, match="closed") as caught:
        line.submit(lambda: 7).result(30.0)
    assert caught.value.code == "UNAVAILABLE"


def test_a_fleet_of_tokens_asks_for_tls_at_every_address() -> None:
    from comvla_client.access import AccessError

    with pytest.raises(AccessError, match=r"192\.0\.2\.1:1 in the clear"):
        FleetTransport("127.0.0.1:1,192.0.2.1:1", token="secret")


def test_the_next_in_turn_is_who_is_well_and_idle() -> None:
    class Transport:
        def close(self) -> None:
            pass

    roster = Roster(lambda address: Transport())
    roster.update([Address(f"host:{i}") for i in range(1, 5)])
    a, b, c, d = roster.members
    assert {id(roster.pick()) for _ in range(4)} == {id(m) for m in (a, b, c, d)}
    roster.leave(a)
    roster.begin(b)
    assert {id(roster.pick()) for _ in range(4)} == {id(c), id(d)}
    assert roster.pick([c, d]) is b
    assert roster.pick([b, c, d]) is a
    assert roster.pick([a, b, c, d]) is None
    assert roster.update([]) == []
    assert roster.update([c.address, Address("host:9")]) == [a, b, d]
    assert roster.members[0] is c


def test_few_are_asked_to_stand_in_for_a_silent_server_and_those_first_who_are_well() -> None:
    roster: Roster[Any] = Roster(lambda address: address)
    roster.update(Address(f"a:{port}") for port in range(1, 8))
    members = roster.members
    silent, tried, well = members[0], members[1:2], members[5]
    for member in members[2:]:
        member.down = member is not well
    for _ in range(20):
        chosen = roster.others(silent, tried)
        assert len(chosen) == MOST_PROBED
        assert chosen[0] is well
        assert not {id(m) for m in chosen} & {id(m) for m in (silent, *tried)}


def test_what_is_a_fleet() -> None:
    assert [is_fleet(t) for t in ("a:1", "a:1,b:1", "dns:///a:1")] == [False, True, True]


async def test_the_asyncio_client_takes_turns_and_loses_no_step() -> None:
    with serving() as (a, one), serving() as (b, other):
        proxy = FrozenProxy(int(b.rpartition(":")[2]))
        client = AsyncComVLAClient(f"{a},{proxy.target},{REFUSED}", edge=StubEdge(), **OPTIONS)
        async with client:
            for _ in range(6):
                assert (await client.step(OBS, WORDS)).source == "cloud"
            assert one.requests
            assert other.requests
            proxy.freeze()
            before = len(one.requests)
            for _ in range(4):
                assert (await client.step(OBS, WORDS)).source == "cloud"
            assert len(one.requests) == before + 4
            proxy.thaw()
            for _ in range(3000):
                count = len(other.requests)
                assert (await client.step(OBS, WORDS)).source == "cloud"
                if len(other.requests) > count:
                    break
                await asyncio.sleep(0.005)
            else:
                pytest.fail("the server that came back was never asked again")


async def test_the_asyncio_client_ends_a_call_that_its_task_gives_up() -> None:
    with serving() as (a, service), serving() as (b, other):
        async with AsyncComVLAClient(f"{a},{b}", edge=StubEdge(), **OPTIONS) as client:
            assert (await client.step(OBS, WORDS)).source == "cloud"
            ended = threading.Event()
            began = threading.Event()

            def wait(request: Any, context: Any) -> None:
                context.add_callback(ended.set)
                began.set()
                ended.wait(20.0)

            service.before = other.before = wait
            step = asyncio.ensure_future(client.step(OBS, WORDS))
            assert await asyncio.to_thread(began.wait, 20.0)
            step.cancel()
            with pytest.raises(asyncio.CancelledError):
                await step
            assert await asyncio.to_thread(ended.wait, 20.0)
