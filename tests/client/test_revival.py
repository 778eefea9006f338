"""A connection that went silent is replaced by one that works, and one that is only late is kept."""

from __future__ import annotations

import threading
import time
from typing import Any

import pytest
from client_stubs import (
    NARROW,
    WORDS,
    StubEdge,
    StubService,
    observation,
    serving,
    set_deadline,
)
from frozen_proxy import FrozenProxy

from comvla_client import AsyncComVLAClient, ComVLAClient
from comvla_client.report import ActionChunk
from comvla_client.revival import PATIENCE_S

OBS = observation()
ATTEMPTS = 20
SLOW_S = 8 * PATIENCE_S
QUICK_STEPS = 4  # that tell the client what a call usually takes


def client_of(target: str, **options: Any) -> ComVLAClient:
    defaults: dict[str, Any] = {"edge": StubEdge(), "link": NARROW, "budget": 4, "execute": 1}
    return ComVLAClient(target, **(defaults | options))


def async_client_of(target: str, **options: Any) -> AsyncComVLAClient:
    defaults: dict[str, Any] = {"edge": StubEdge(), "link": NARROW, "budget": 4, "execute": 1}
    return AsyncComVLAClient(target, **(defaults | options))


def port_of(target: str) -> int:
    return int(target.rpartition(":")[2])


def test_a_step_finds_its_way_around_a_connection_that_died_before_it() -> None:
    with (
        serving() as (target, service),
        FrozenProxy(port_of(target)) as proxy,
        client_of(proxy.target, deadline_s=20.0) as client,
    ):
        assert client.step(OBS, WORDS).source == "cloud"
        proxy.freeze()
        proxy.thaw()  # what was open stays dead, what is new works
        chunk = client.step(OBS, WORDS)
        assert chunk.source == "cloud"
        assert chunk.report.timings_s["total"] < 10.0
        assert client.step(OBS, WORDS).source == "cloud"
    assert proxy.accepted >= 2
    assert {request.step for request in service.requests} == {0, 1, 2}


def test_a_robot_that_holds_goes_on_as_soon_as_the_link_is_back() -> None:
    with (
        serving() as (target, _),
        FrozenProxy(port_of(target)) as proxy,
        client_of(proxy.target, deadline_s=20.0) as client,
    ):
        assert client.step(OBS, WORDS).source == "cloud"
        proxy.freeze()
        set_deadline(client, 0.1)
        held = [client.step(OBS, WORDS) for _ in range(5)]
        assert {chunk.source for chunk in held} == {"rest"}
        proxy.thaw()
        set_deadline(client, 1.0)
        after: list[ActionChunk] = []
        while len(after) < ATTEMPTS and "cloud" not in [chunk.source for chunk in after]:
            after.append(client.step(OBS, WORDS))
        assert after[-1].source == "cloud"
        after += [client.step(OBS, WORDS) for _ in range(5)]
    # An answer that comes late is of no use to anyone: what is executed only gets newer.
    steps = [chunk.report.step for chunk in (*held, *after) if chunk.source == "cloud"]
    assert steps == sorted(steps)


def slow_service() -> StubService:
    """One that takes its time once it was quick for a while."""
    service, never = StubService(), threading.Event()

    def before(request: Any, context: Any) -> None:
        if request.step >= QUICK_STEPS:
            never.wait(SLOW_S)

    service.before = before
    return service


@pytest.mark.usefixtures("pings_in_time")
def test_a_server_that_is_only_slow_is_asked_once() -> None:
    def steps_that_came() -> list[int]:
        with (
            serving(slow_service()) as (target, service),
            FrozenProxy(port_of(target)) as proxy,
            client_of(proxy.target, deadline_s=20.0) as client,
        ):
            for _ in range(QUICK_STEPS + 1):
                assert client.step(OBS, WORDS).source == "cloud"
        return [request.step for request in service.requests]

    # A busy machine may delay a ping, too, but not every time.
    assert any(steps_that_came() == list(range(QUICK_STEPS + 1)) for _ in range(5))


@pytest.mark.alone
def test_closing_does_not_wait_for_a_dead_connection() -> None:
    with serving() as (target, _), FrozenProxy(port_of(target)) as proxy:
        client = client_of(proxy.target, deadline_s=0.1)
        proxy.freeze()
        client.step(OBS, WORDS)
        began = time.perf_counter()
        client.close()
        # gRPC itself would wait for 5 seconds and more.
        assert time.perf_counter() - began < 4.0


async def test_an_asyncio_step_finds_its_way_around_a_dead_connection_too() -> None:
    with serving() as (target, service), FrozenProxy(port_of(target)) as proxy:
        async with async_client_of(proxy.target, deadline_s=20.0) as client:
            assert (await client.step(OBS, WORDS)).source == "cloud"
            proxy.freeze()
            proxy.thaw()
            chunk = await client.step(OBS, WORDS)
            assert chunk.source == "cloud"
            assert chunk.report.timings_s["total"] < 10.0
    assert proxy.accepted >= 2
    assert {request.step for request in service.requests} == {0, 1}


async def test_an_asyncio_robot_goes_on_as_soon_as_the_link_is_back() -> None:
    with serving() as (target, _), FrozenProxy(port_of(target)) as proxy:
        async with async_client_of(proxy.target, deadline_s=20.0) as client:
            assert (await client.step(OBS, WORDS)).source == "cloud"
            proxy.freeze()
            set_deadline(client, 0.1)
            held = [await client.step(OBS, WORDS) for _ in range(5)]
            assert {chunk.source for chunk in held} == {"rest"}
            proxy.thaw()
            set_deadline(client, 1.0)
            for _ in range(ATTEMPTS):
                after = await client.step(OBS, WORDS)
                if after.source == "cloud":
                    break
    assert after.source == "cloud"


@pytest.mark.usefixtures("pings_in_time")
async def test_an_asyncio_client_asks_a_server_that_is_only_slow_once() -> None:
    async def steps_that_came() -> list[int]:
        with (
            serving(slow_service()) as (target, service),
            FrozenProxy(port_of(target)) as proxy,
        ):
            async with async_client_of(proxy.target, deadline_s=20.0) as client:
                for _ in range(QUICK_STEPS + 1):
                    assert (await client.step(OBS, WORDS)).source == "cloud"
        return [request.step for request in service.requests]

    for _ in range(5):
        came = await steps_that_came()
        if came == list(range(QUICK_STEPS + 1)):
            break
    assert came == list(range(QUICK_STEPS + 1))
