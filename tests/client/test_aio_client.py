"""The asyncio client is the synchronous one on an event loop."""

from __future__ import annotations

import asyncio
import threading
import time
from dataclasses import replace
from typing import Any

import grpc
import numpy as np
import pytest
from client_stubs import (
    NARROW,
    WORDS,
    AsyncStubTransport,
    StubEdge,
    StubService,
    StubTransport,
    fault,
    model_response,
    never_answer,
    observation,
    other_model,
    reserved_port,
    serving,
    set_deadline,
)

from comvla.errors import HandshakeError, InstructionError, ObservationError
from comvla.v1.policy_pb2 import InferRequest
from comvla_client import AsyncComVLAClient, ClientClosedError, ComVLAClient, TransportError
from comvla_client.transport_aio import GrpcAioTransport

OBS = observation()
SCRIPT = (None, fault("UNAVAILABLE"), fault("DEADLINE_EXCEEDED"), None)
REFUSED = "127.0.0.1:1"


def aio_client_of(target: Any, **options: Any) -> AsyncComVLAClient:
    options = {"link": NARROW, "edge": StubEdge(), "budget": 4, "deadline_s": 20.0, **options}
    return AsyncComVLAClient(target, **options)


async def test_both_forms_give_the_same_on_the_same_input() -> None:
    options: dict[str, Any] = {
        "edge": StubEdge(),
        "link": NARROW,
        "execute": 3,
        "selector": "random",
        "seed": 5,
        "deadline_s": 20.0,
    }
    snrs = (10.0, 3.0, 20.0, float("-inf"), 12.0)
    with ComVLAClient(StubTransport(*SCRIPT), **options) as client:
        expected = [client.step(observation(i), WORDS, snr) for i, snr in enumerate(snrs)]
        expected_row = client.act(observation(9), WORDS, 10.0)
    async with AsyncComVLAClient(AsyncStubTransport(*SCRIPT), **options) as aio:
        came = [await aio.step(observation(i), WORDS, snr) for i, snr in enumerate(snrs)]
        row = await aio.act(observation(9), WORDS, 10.0)
    np.testing.assert_array_equal(row, expected_row)
    for one, other in zip(came, expected, strict=True):
        np.testing.assert_array_equal(one.actions, other.actions)
        assert one.planned == other.planned
        # Sessions differ by their random part, times by the clock.
        same = {"session": "", "timings_s": {}}
        left, right = replace(one.report, **same), replace(other.report, **same)
        assert left.to_dict() == right.to_dict()


@pytest.mark.usefixtures("patient")
async def test_a_step_over_a_real_socket() -> None:
    with serving() as (target, service):
        async with aio_client_of(target) as client:
            assert client.info == StubEdge().info
            assert (await client.step(OBS, WORDS)).source == "cloud"
            assert [float((await client.act(OBS, WORDS))[1]) for _ in range(9)] == [*range(8), 0.0]
            await client.reset()
            assert (await client.step(OBS, WORDS)).report.step == 0
    assert [request.step for request in service.requests] == [0, 1, 0]


async def test_the_first_step_connects() -> None:
    with serving() as (target, _):
        client = aio_client_of(target)
        assert (await client.step(OBS, WORDS)).source == "cloud"
        await client.connect()
        await client.close()


async def test_steps_of_several_tasks_run_one_after_another() -> None:
    transport = AsyncStubTransport()
    async with aio_client_of(transport) as client:
        chunks = await asyncio.gather(*(client.step(OBS, WORDS) for _ in range(5)))
    assert [chunk.report.step for chunk in chunks] == list(range(5))


async def test_the_loop_stays_free_while_the_cameras_are_encoded() -> None:
    running = asyncio.Event()
    loop = asyncio.get_running_loop()

    class WaitingEdge(StubEdge):
        def encode(self, images: Any) -> Any:
            asyncio.run_coroutine_threadsafe(note(), loop).result(10.0)
            return super().encode(images)

    async def note() -> None:
        running.set()

    async with aio_client_of(AsyncStubTransport(), edge=WaitingEdge(), deadline_s=10.0) as client:
        assert (await client.step(OBS, WORDS)).source == "cloud"
    assert running.is_set()


@pytest.mark.alone
async def test_a_server_that_never_answers() -> None:
    service = StubService()
    service.before = never_answer
    with serving(service) as (target, _):
        async with aio_client_of(target, deadline_s=0.03) as client:
            overruns_s, lateness_s = [], []
            for _ in range(50):
                began = time.perf_counter()
                report = (await client.step(OBS, WORDS)).report
                overruns_s.append(time.perf_counter() - began - client.deadline_s)
                assert report.fallback_reason == "deadline"
                # How late this machine wakes anybody now: that much more is allowed.
                began = time.perf_counter()
                await asyncio.sleep(0.005)
                lateness_s.append(time.perf_counter() - began - 0.005)
            assert np.percentile(overruns_s, 95) <= 0.010 + np.percentile(lateness_s, 95)
            service.before = None
            set_deadline(client, 20.0)
            assert (await client.step(OBS, WORDS)).source == "cloud"


async def test_a_server_that_returns_is_found_by_the_first_step_after_it() -> None:
    with reserved_port() as port:
        with serving(port=port) as (target, _):
            client = aio_client_of(target)
            assert (await client.step(OBS, WORDS)).source == "cloud"
        set_deadline(client, 0.5)
        # A machine that is busy may miss half a second; three times in a row it does not.
        for _ in range(3):
            reasons = {(await client.step(OBS, WORDS)).report.fallback_reason for _ in range(4)}
            assert "unavailable" in reasons
            assert reasons <= {"unavailable", "deadline"}
            with serving(port=port):
                chunk = await client.step(OBS, WORDS)
            if chunk.source == "cloud":
                break
        assert chunk.source == "cloud"
        await client.close()


async def test_close_ends_a_step_under_way_with_a_clear_error() -> None:
    service, loop, called = StubService(), asyncio.get_running_loop(), asyncio.Event()

    def hang(request: Any, context: grpc.ServicerContext) -> None:
        loop.call_soon_threadsafe(called.set)
        never_answer(request, context)

    service.before = hang
    with serving(service) as (target, _):
        client = aio_client_of(target, deadline_s=60.0)
        step = asyncio.create_task(client.step(OBS, WORDS))
        await asyncio.wait_for(called.wait(), 10.0)
        await client.close()
        with pytest.raises(ClientClosedError, match="closed"):
            await asyncio.wait_for(step, 10.0)
        for use in (
            client.step(OBS, WORDS),
            client.act(OBS, WORDS),
            client.reset(),
            client.connect(),
        ):
            with pytest.raises(ClientClosedError):
                await use


async def test_a_cancelled_step_is_cancelled_and_the_client_lives_on() -> None:
    service, loop, called = StubService(), asyncio.get_running_loop(), asyncio.Event()

    def hang(request: Any, context: grpc.ServicerContext) -> None:
        loop.call_soon_threadsafe(called.set)
        never_answer(request, context)

    service.before = hang
    with serving(service) as (target, _):
        async with aio_client_of(target, deadline_s=60.0) as client:
            step = asyncio.create_task(client.step(OBS, WORDS))
            await asyncio.wait_for(called.wait(), 10.0)
            step.cancel()
            with pytest.raises(asyncio.CancelledError):
                await step
            service.before = None
            assert (await client.step(OBS, WORDS)).source == "cloud"


async def test_a_step_cancelled_while_it_encodes_does_not_meet_the_next_one() -> None:
    encoding, go_on = threading.Event(), threading.Event()

    class SlowEdge(StubEdge):
        busy = 0

        def encode(self, images: Any) -> Any:
            self.busy += 1
            assert self.busy == 1, "two steps in one edge model"
            encoding.set()
            assert go_on.wait(10.0)
            self.busy -= 1
            return super().encode(images)

    async with aio_client_of(AsyncStubTransport(), edge=SlowEdge()) as client:
        first = asyncio.create_task(client.step(OBS, WORDS))
        await asyncio.to_thread(encoding.wait)
        first.cancel()
        second = asyncio.create_task(client.step(OBS, WORDS))
        await asyncio.sleep(0)
        go_on.set()
        with pytest.raises(asyncio.CancelledError):
            await first
        assert (await second).source == "cloud"


async def test_no_server_names_host_budget_and_remedy() -> None:
    with pytest.raises(HandshakeError) as caught:
        async with aio_client_of(REFUSED, connect_timeout_s=0.2):
            pass
    for word in (REFUSED, "0.2 s", "comvla-server serve"):
        assert word in str(caught.value)


async def test_another_model_stops_before_the_robot_moves() -> None:
    transport = AsyncStubTransport(model=model_response(other_model(fingerprint="beef")))
    with pytest.raises(HandshakeError, match="beef"):
        async with aio_client_of(transport):
            pass
    assert transport.inner.closed


async def test_mistakes_in_the_program_raise() -> None:
    script = (fault("INVALID_ARGUMENT", "instruction 'x'"), fault("FAILED_PRECONDITION", "other"))
    async with aio_client_of(AsyncStubTransport(*script)) as client:
        with pytest.raises(ObservationError):
            await client.step({}, WORDS)
        with pytest.raises(InstructionError):
            await client.step(OBS, WORDS)
        with pytest.raises(HandshakeError):
            await client.step(OBS, WORDS)


async def test_an_edge_half_that_takes_all_the_time_sends_nothing() -> None:
    transport = AsyncStubTransport()
    async with aio_client_of(transport, deadline_s=1e-9) as client:
        assert client.deadline_s == 1e-9
        assert (await client.step(OBS, WORDS)).report.fallback_reason == "deadline"
    assert transport.inner.requests == []


@pytest.mark.usefixtures("patient")
async def test_a_connection_that_lives_is_kept_though_a_call_goes_unanswered() -> None:
    service = StubService()
    service.before = never_answer
    with serving(service) as (target, _):
        transport = GrpcAioTransport(target)
        channels = set()
        for _ in range(3):
            with pytest.raises(TransportError, match="DEADLINE_EXCEEDED"):
                await transport.infer(InferRequest(), 0.03)
            channels.add(transport._channel)
        assert len(channels) == 1
        await transport.close()
        with pytest.raises(ClientClosedError):
            await transport.get_model(1.0)


async def test_a_target_is_host_and_port() -> None:
    with pytest.raises(HandshakeError, match="host:port"):
        GrpcAioTransport("http://127.0.0.1:80")
