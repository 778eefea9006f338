"""From taking ports to letting go of them."""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import AsyncIterator
from typing import Any

import grpc
import httpx
import pytest
import pytest_asyncio
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection_pb2, reflection_pb2_grpc
from server_stubs import PATIENCE_S, Robot, StubCloud, eventually, message, quiet_port, refusal_of

from comvla.errors import CheckpointError
from comvla.v1 import policy_pb2, policy_pb2_grpc
from comvla_server.background import BackgroundServer
from comvla_server.engine import Engine
from comvla_server.grpc_adapter import SERVICE_NAME
from comvla_server.lifecycle import Lifecycle, Phase
from comvla_server.ports import BindError, authority
from comvla_server.server import Server
from comvla_server.settings import ServerSettings, SettingsError

SERVING = health_pb2.HealthCheckResponse.SERVING
NOT_SERVING = health_pb2.HealthCheckResponse.NOT_SERVING


@pytest_asyncio.fixture
async def bound(cloud: StubCloud) -> AsyncIterator[Server]:
    """A server that has its ports and no model yet."""
    server = Server(lambda: Engine(cloud))
    await server.bind()
    yield server
    cloud.release()
    await server.stop()


async def health_of(channel: grpc.aio.Channel, service: str) -> int:
    request = health_pb2.HealthCheckRequest(service=service)
    response = await health_pb2_grpc.HealthStub(channel).Check(request, timeout=PATIENCE_S)
    return int(response.status)


async def readyz(server: Server) -> tuple[int, dict[str, Any]]:
    async with httpx.AsyncClient() as http:
        answer = await http.get(f"{server.admin_url}/readyz", timeout=PATIENCE_S)
    return answer.status_code, answer.json()


async def test_health_says_not_serving_until_the_warm_up_ends(
    bound: Server, cloud: StubCloud
) -> None:
    async with grpc.aio.insecure_channel(bound.target) as channel:
        stub = policy_pb2_grpc.PolicyServiceStub(channel)
        assert await readyz(bound) == (503, {"ready": False, "phase": "loading"})
        for service in ("", SERVICE_NAME):
            assert await health_of(channel, service) == NOT_SERVING
        for call in (
            stub.Infer(message(), timeout=PATIENCE_S),
            stub.GetModel(policy_pb2.GetModelRequest(), timeout=PATIENCE_S),
        ):
            with pytest.raises(grpc.aio.AioRpcError) as caught:
                await call
            assert caught.value.code() is grpc.StatusCode.UNAVAILABLE
            assert "retry when its health check says SERVING" in caught.value.details()

        cloud.hold()
        starting = asyncio.create_task(bound.make_ready())
        await asyncio.to_thread(cloud.wait_until_running)
        assert await readyz(bound) == (503, {"ready": False, "phase": "warming"})
        assert await health_of(channel, SERVICE_NAME) == NOT_SERVING

        cloud.release()
        assert await starting == cloud.info
        assert await readyz(bound) == (200, {"ready": True, "phase": "serving"})
        for service in ("", SERVICE_NAME):
            assert await health_of(channel, service) == SERVING
        assert (await stub.Infer(message(), timeout=PATIENCE_S)).step == 0


async def test_a_health_watcher_sees_serving_and_draining(bound: Server, cloud: StubCloud) -> None:
    async with grpc.aio.insecure_channel(bound.target) as channel:
        request = health_pb2.HealthCheckRequest(service=SERVICE_NAME)
        watch = health_pb2_grpc.HealthStub(channel).Watch(request, timeout=PATIENCE_S)
        assert (await watch.read()).status == NOT_SERVING
        await bound.make_ready()
        assert (await watch.read()).status == SERVING
        stopping = asyncio.create_task(bound.stop())
        assert (await watch.read()).status == NOT_SERVING
        assert await stopping  # an open watch does not hold up the stop


async def test_stopping_while_the_model_warms_up_stays_stopped(
    bound: Server, cloud: StubCloud
) -> None:
    cloud.hold()
    starting = asyncio.create_task(bound.make_ready())
    await asyncio.to_thread(cloud.wait_until_running)
    stopping = asyncio.create_task(bound.stop())
    cloud.release()
    await asyncio.gather(starting, stopping)
    assert bound.lifecycle.phase is Phase.STOPPED


def test_a_stop_lets_calls_in_flight_finish_and_refuses_new_ones(
    server: BackgroundServer, robot: Robot, cloud: StubCloud
) -> None:
    cloud.hold()
    running = robot.send(message("running"))
    cloud.wait_until_running()
    waiting = robot.send(message("waiting"))
    registry = server.server.metrics.registry
    eventually(lambda: registry.get_sample_value("comvla_queue_depth") == 1)

    stopped: list[bool] = []
    stopper = threading.Thread(target=lambda: stopped.append(server.stop(grace_s=PATIENCE_S)))
    stopper.start()
    health = health_pb2_grpc.HealthStub(robot.channel)
    request = health_pb2.HealthCheckRequest(service=SERVICE_NAME)
    eventually(lambda: health.Check(request).status == NOT_SERVING)
    assert httpx.get(f"{server.admin_url}/readyz", timeout=PATIENCE_S).json()["phase"] == "draining"
    code, words = robot.refused(message("new"))
    assert code is grpc.StatusCode.UNAVAILABLE
    assert "draining and takes no new calls" in words
    assert "another replica" in words

    cloud.release()
    assert running.result().session_id == "running"
    assert waiting.result().session_id == "waiting"
    stopper.join(PATIENCE_S)
    assert stopped == [True]
    assert robot.refused(message("late"))[0] is grpc.StatusCode.UNAVAILABLE


def test_calls_that_outlast_the_grace_are_cut_off_with_words(
    server: BackgroundServer, robot: Robot, cloud: StubCloud
) -> None:
    cloud.hold()
    running = robot.send(message())
    cloud.wait_until_running()
    assert server.stop(grace_s=0.05) is False
    code, words = refusal_of(running)
    assert code is grpc.StatusCode.UNAVAILABLE
    assert "stopped before step 0 was computed" in words


def test_stopping_twice_or_before_the_start_is_harmless(cloud: StubCloud) -> None:
    assert BackgroundServer(Engine(cloud)).stop()
    server = BackgroundServer(Engine(cloud)).start()
    assert server.stop()
    assert server.stop()


def test_a_server_can_come_back_on_its_port(cloud: StubCloud) -> None:
    settings = ServerSettings(port=quiet_port())
    with BackgroundServer(Engine(cloud), settings) as first, Robot(first.target) as robot:
        robot.infer(message())
    with BackgroundServer(Engine(cloud), settings) as second:
        assert second.server.port == first.server.port == settings.port
        with Robot(second.target) as robot:
            assert robot.infer(message())


@pytest.mark.parametrize("option", ["port", "admin_port"])
def test_a_taken_port_is_named_and_nothing_is_half_started(cloud: StubCloud, option: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        server = BackgroundServer(Engine(cloud), ServerSettings(**{option: port}))
        with pytest.raises(BindError, match=rf"cannot listen on 127\.0\.0\.1:{port}.*0 takes"):
            server.start()
    assert cloud.batches == []
    # Whatever the failed start had taken is free again.
    assert not any(t.name == "comvla-inference" for t in threading.enumerate())


def test_two_servers_never_share_a_port(cloud: StubCloud) -> None:
    with BackgroundServer(Engine(cloud)) as first:
        settings = ServerSettings(port=first.server.port)
        with pytest.raises(BindError):
            BackgroundServer(Engine(cloud), settings).start()


def test_an_address_of_another_machine_is_refused(cloud: StubCloud) -> None:
    with pytest.raises(BindError, match=r"192\.0\.2\.1"):
        BackgroundServer(Engine(cloud), ServerSettings(host="192.0.2.1", insecure=True)).start()


def test_a_model_that_cannot_be_loaded_ends_the_start() -> None:
    def load() -> Engine:
        raise CheckpointError("no such checkpoint: nowhere")

    server = BackgroundServer(load)
    with pytest.raises(CheckpointError, match="nowhere"):
        server.start()
    assert server.stop() is False


def test_a_message_cap_below_an_unpruned_observation_is_refused(cloud: StubCloud) -> None:
    settings = ServerSettings(max_request_bytes=2048)
    with pytest.raises(SettingsError, match="unpruned float32 observation of stub needs"):
        BackgroundServer(Engine(cloud), settings).start()


def test_listening_beyond_this_machine_is_warned_about(
    cloud: StubCloud, caplog: pytest.LogCaptureFixture
) -> None:
    with BackgroundServer(Engine(cloud), ServerSettings(host="0.0.0.0", insecure=True)):
        pass
    for words in ("without authentication", "without encryption", "admin surface on 0.0.0.0"):
        assert words in caplog.text


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost"])
def test_listening_on_this_machine_is_not(
    cloud: StubCloud, caplog: pytest.LogCaptureFixture, host: str
) -> None:
    with (
        BackgroundServer(Engine(cloud), ServerSettings(host=host)) as server,
        Robot(server.target) as robot,
    ):
        assert robot.infer(message())
    assert "without authentication" not in caplog.text


def test_ipv6_addresses_are_bracketed() -> None:
    assert authority("::1", 80) == "[::1]:80"
    assert authority("127.0.0.1", 80) == "127.0.0.1:80"


def test_reflection_lists_and_describes_the_service(robot: Robot) -> None:
    stub = reflection_pb2_grpc.ServerReflectionStub(robot.channel)
    asked = [
        reflection_pb2.ServerReflectionRequest(list_services=""),
        reflection_pb2.ServerReflectionRequest(file_containing_symbol=SERVICE_NAME),
    ]
    listed, described = stub.ServerReflectionInfo(iter(asked), timeout=PATIENCE_S)
    names = {service.name for service in listed.list_services_response.service}
    assert {SERVICE_NAME, "grpc.health.v1.Health"} <= names
    assert described.file_descriptor_response.file_descriptor_proto


def test_phases_only_go_forward() -> None:
    lifecycle = Lifecycle()
    lifecycle.enter(Phase.DRAINING)
    lifecycle.enter(Phase.SERVING)
    assert lifecycle.phase is Phase.DRAINING
    assert not lifecycle.ready
