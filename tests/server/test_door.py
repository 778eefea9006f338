"""The door in front of every RPC: who is let in, whose session it is, how much each may send."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import grpc
import httpx
import numpy as np
import pytest
from google.protobuf import descriptor_pb2
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection_pb2, reflection_pb2_grpc
from server_stubs import PATIENCE_S, Robot, StubCloud, eventually, message, refusal_of

from comvla.v1 import policy_pb2
from comvla_client import AccessError, ComVLAClient, TlsOptions
from comvla_client.access import Access
from comvla_client.transport import GrpcTransport, TransportError
from comvla_server.background import BackgroundServer
from comvla_server.engine import Engine
from comvla_server.grpc_adapter import SERVICE_NAME
from comvla_server.identity import Identity, Limits
from comvla_server.settings import ServerSettings
from comvla_server.tokens import TokenLine, new_token
from comvla_vla import random_policy

OK = grpc.StatusCode.OK
UNAUTHENTICATED = grpc.StatusCode.UNAUTHENTICATED
PERMISSION_DENIED = grpc.StatusCode.PERMISSION_DENIED
INVALID_ARGUMENT = grpc.StatusCode.INVALID_ARGUMENT
RESOURCE_EXHAUSTED = grpc.StatusCode.RESOURCE_EXHAUSTED

ARM_7, ARM_8, SLOW, SMALL = (new_token() for _ in range(4))


@pytest.fixture
def tokens(tmp_path: Path) -> Path:
    """A tokens file. Rates are so low that however long a test takes, nothing more may be sent."""
    identities = {
        ARM_7: Identity("arm-7"),
        ARM_8: Identity("arm-8"),
        SLOW: Identity("slow", Limits(requests_per_s=0.001)),
        SMALL: Identity("small", Limits(bytes_per_s=0.5, max_request_bytes=400)),
    }
    path = tmp_path / "tokens"
    path.touch(mode=0o600)
    lines = (str(TokenLine.of(identity, token)) for token, identity in identities.items())
    path.write_text("\n".join(lines))
    return path


@pytest.fixture
def server(cloud: StubCloud, tokens: Path) -> Iterator[BackgroundServer]:
    """A server that asks for tokens."""
    settings = ServerSettings(tokens_file=tokens, reload_interval_s=0.02, max_concurrent_calls=16)
    with BackgroundServer(Engine(cloud), settings) as running:
        cloud.forget()
        yield running
        cloud.release()


@pytest.fixture
def robot(server: BackgroundServer) -> Iterator[Robot]:
    with Robot(server.target) as client:
        yield client


def bearer(token: str) -> tuple[tuple[str, str], ...]:
    return (("authorization", f"Bearer {token}"),)


def rewrite(tokens: Path, text: str) -> None:
    """At one stroke: the server looks at any moment, and must not see half a file."""
    new = tokens.with_suffix(".new")
    new.touch(mode=0o600)
    new.write_text(text)
    new.replace(tokens)


def infer(robot: Robot, token: str | None, *args: Any, **kwargs: Any) -> Any:
    """A call in flight."""
    metadata = None if token is None else bearer(token)
    return robot.stub.Infer.future(message(*args, **kwargs), timeout=PATIENCE_S, metadata=metadata)


def waits(server: BackgroundServer, count: int) -> None:
    """Returns when so many observations wait for the model."""
    registry = server.server.metrics.registry
    eventually(lambda: registry.get_sample_value("comvla_queue_depth") == count)


def refused_calls(server: BackgroundServer, reason: str) -> float:
    value = server.server.metrics.registry.get_sample_value(
        "comvla_calls_refused_total", {"reason": reason}
    )
    assert value is not None
    return value


def test_a_robot_with_its_token_is_answered(robot: Robot) -> None:
    assert infer(robot, ARM_7).result(PATIENCE_S).session_id == "robot"


HEADERS: dict[str, list[tuple[str, str]]] = {
    "no token": [],
    "an unknown token": [("authorization", f"Bearer {new_token()}")],
    "half a token": [("authorization", f"Bearer {ARM_7[:-1]}")],
    "the hash of a token": [("authorization", f"Bearer {TokenLine.of(Identity('a'), ARM_7)}")],
    "an empty header": [("authorization", "")],
    "a token without a scheme": [("authorization", ARM_7)],
    "another scheme": [("authorization", f"Basic {ARM_7}")],
    "two tokens": [("authorization", f"Bearer {ARM_7}"), ("authorization", f"Bearer {ARM_8}")],
    "a very long token": [("authorization", "Bearer " + "x" * 5000)],
}


@pytest.mark.parametrize("who", list(HEADERS))
def test_no_or_a_wrong_token_is_unauthenticated(
    server: BackgroundServer, robot: Robot, cloud: StubCloud, who: str
) -> None:
    calls = [
        robot.stub.GetModel.future(
            policy_pb2.GetModelRequest(), timeout=PATIENCE_S, metadata=HEADERS[who]
        ),
        robot.stub.Infer.future(message(), timeout=PATIENCE_S, metadata=HEADERS[who]),
    ]
    for call in calls:
        code, words = refusal_of(call)
        assert code is UNAUTHENTICATED
        assert "comvla-server token new" in words
        assert ARM_7 not in words
    assert cloud.batches == []
    assert refused_calls(server, "no_identity") == 2


def test_every_method_that_the_server_offers_asks_for_a_token_but_health(robot: Robot) -> None:
    """Asked of the server itself, so that a method added later is asked about as well."""
    reflection = reflection_pb2_grpc.ServerReflectionStub(robot.channel)

    def ask(**question: str) -> Any:
        request = reflection_pb2.ServerReflectionRequest(**question)
        metadata = bearer(ARM_7)
        (answer,) = reflection.ServerReflectionInfo(
            iter([request]), timeout=PATIENCE_S, metadata=metadata
        )
        return answer

    seen = set()
    for service in ask(list_services="").list_services_response.service:
        described = ask(file_containing_symbol=service.name).file_descriptor_response
        for content in described.file_descriptor_proto:
            file = descriptor_pb2.FileDescriptorProto.FromString(content)
            for declared in file.service:
                for method in declared.method:
                    path = f"/{file.package}.{declared.name}/{method.name}"
                    seen.add(path)
                    call = robot.channel.stream_stream(path)(iter([b""]), timeout=PATIENCE_S)
                    try:
                        next(call)
                        code = OK
                    except grpc.RpcError as error:
                        code = error.code()
                    call.cancel()
                    if path.startswith("/grpc.health.v1.Health/"):
                        assert code in (OK, grpc.StatusCode.UNIMPLEMENTED), path
                    else:
                        assert code is UNAUTHENTICATED, path
    assert {f"/{SERVICE_NAME}/Infer", f"/{SERVICE_NAME}/GetModel"} <= seen
    assert "/grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo" in seen
    assert "/grpc.health.v1.Health/Check" in seen


def test_the_session_of_another_robot_is_permission_denied(robot: Robot, cloud: StubCloud) -> None:
    answered = infer(robot, ARM_7, "mine", 0, name=1.0).result(PATIENCE_S)
    for step in (0, 1):  # neither its record nor its queue
        code, words = refusal_of(infer(robot, ARM_8, "mine", step, name=1.0))
        assert code is PERMISSION_DENIED
        assert "'mine' belongs to another identity than 'arm-8'" in words
    assert cloud.batches == [[1.0]]
    again = infer(robot, ARM_7, "mine", 0, name=1.0).result(PATIENCE_S)
    assert list(again.actions) == list(answered.actions)


def test_the_session_of_another_robot_is_shut_to_payloads_in_pieces_too(
    robot: Robot, cloud: StubCloud
) -> None:
    def in_pieces(token: str, step: int) -> Any:
        whole = message("mine", step)
        payload, whole.payload = whole.payload, b""
        head = policy_pb2.InferProgressiveHead(request=whole, window_s=5.0)
        messages = [
            policy_pb2.InferProgressiveRequest(head=head),
            policy_pb2.InferProgressiveRequest(piece=payload),
        ]
        return robot.stub.InferProgressive.future(
            iter(messages), timeout=PATIENCE_S, metadata=bearer(token)
        )

    assert in_pieces(ARM_7, 0).result(PATIENCE_S).response.session_id == "mine"
    assert refusal_of(in_pieces(ARM_8, 1))[0] is PERMISSION_DENIED
    assert refusal_of(in_pieces(new_token(), 1))[0] is UNAUTHENTICATED
    assert in_pieces(ARM_7, 1).result(PATIENCE_S).response.step == 1
    assert refusal_of(in_pieces(SMALL, 2))[0] is PERMISSION_DENIED


def test_an_observation_that_waits_cannot_be_replaced_by_another_robot(
    server: BackgroundServer, robot: Robot, cloud: StubCloud
) -> None:
    cloud.hold()
    running = infer(robot, ARM_8, "other")
    cloud.wait_until_running()
    waiting = infer(robot, ARM_7, "mine", 0, name=1.0)
    waits(server, 1)
    assert refusal_of(infer(robot, ARM_7, "mine", 0, name=2.0))[0] is INVALID_ARGUMENT
    assert refusal_of(infer(robot, ARM_8, "mine", 1))[0] is PERMISSION_DENIED
    cloud.release()
    assert waiting.result(PATIENCE_S)
    assert running.result(PATIENCE_S)


def test_tokens_come_and_go_without_a_restart(
    server: BackgroundServer, robot: Robot, tokens: Path
) -> None:
    assert infer(robot, ARM_7, "a", 0).exception(PATIENCE_S) is None
    fresh = new_token()
    rewrite(tokens, f"{TokenLine.of(Identity('arm-7'), fresh)}\n")
    eventually(lambda: infer(robot, ARM_7, "a", 1).code() is UNAUTHENTICATED)
    # The same identity under a new token still owns its session.
    assert infer(robot, fresh, "a", 2).exception(PATIENCE_S) is None
    rewrite(tokens, "broken")  # nobody new, nobody out
    registry, labels = server.server.metrics.registry, {"file": "tokens"}
    eventually(lambda: registry.get_sample_value("comvla_reload_failures_total", labels))
    assert infer(robot, fresh, "a", 3).exception(PATIENCE_S) is None


def test_a_robot_that_asks_too_often_is_told_when_to_come_back(
    server: BackgroundServer, robot: Robot
) -> None:
    assert infer(robot, SLOW, step=0).exception(PATIENCE_S) is None
    code, words = refusal_of(infer(robot, SLOW, step=1))
    assert code is RESOURCE_EXHAUSTED
    assert "'slow' may make 0.001 calls per second" in words
    assert "retry in" in words
    assert infer(robot, ARM_7, "other").exception(PATIENCE_S) is None
    assert refused_calls(server, "rate") == 1


def test_a_robot_that_sends_too_much_is_refused(server: BackgroundServer, robot: Robot) -> None:
    code, words = refusal_of(infer(robot, SMALL, k=12))
    assert code is RESOURCE_EXHAUSTED
    assert "a request of at most 400 bytes from 'small'" in words
    size = message(k=3).ByteSize()
    assert 1 < size < 400, "more than its two seconds of burst"
    assert infer(robot, SMALL, step=0).exception(PATIENCE_S) is None
    code, words = refusal_of(infer(robot, SMALL, step=1))
    assert code is RESOURCE_EXHAUSTED
    assert "'small' may send 0.5 bytes per second" in words
    assert refused_calls(server, "oversize") == 1


def test_one_robot_cannot_open_all_the_calls(cloud: StubCloud, tokens: Path) -> None:
    settings = ServerSettings(tokens_file=tokens, identity_max_calls=2)
    with BackgroundServer(Engine(cloud), settings) as server, Robot(server.target) as robot:
        cloud.forget()
        cloud.hold()
        calls = [infer(robot, ARM_7, "s0")]
        cloud.wait_until_running()  # else both may share a pass
        calls.append(infer(robot, ARM_7, "s1"))
        waits(server, 1)
        code, words = refusal_of(infer(robot, ARM_7, "s3"))
        assert code is RESOURCE_EXHAUSTED
        assert "'arm-7' has 2 calls open" in words
        other = infer(robot, ARM_8, "other")
        cloud.release()
        assert all(call.exception(PATIENCE_S) is None for call in (*calls, other))
        # Calls that have ended are no longer counted, a moment after their answers have left.
        eventually(lambda: infer(robot, ARM_7, "s4").exception(PATIENCE_S) is None)


def test_strangers_who_watch_the_health_cannot_keep_robots_out(
    server: BackgroundServer, robot: Robot
) -> None:
    watches = []
    for _ in range(2):  # an eighth of sixteen
        watch = health_pb2_grpc.HealthStub(robot.channel).Watch(health_pb2.HealthCheckRequest())
        assert next(watch).status == health_pb2.HealthCheckResponse.SERVING
        watches.append(watch)
    stub = health_pb2_grpc.HealthStub(robot.channel)
    with pytest.raises(grpc.RpcError) as caught:
        stub.Check(health_pb2.HealthCheckRequest(), timeout=PATIENCE_S)
    assert caught.value.code() is RESOURCE_EXHAUSTED
    assert infer(robot, ARM_7).exception(PATIENCE_S) is None
    for watch in watches:
        watch.cancel()

    def healthy() -> bool:
        call = stub.Check.future(health_pb2.HealthCheckRequest(), timeout=PATIENCE_S)
        return call.exception(PATIENCE_S) is None

    eventually(healthy)


def test_bytes_that_are_no_message_are_still_told_apart(robot: Robot) -> None:
    call = robot.channel.unary_unary(f"/{SERVICE_NAME}/Infer").future(
        b"\xff\xff\xff", timeout=PATIENCE_S, metadata=bearer(ARM_7)
    )
    code, words = refusal_of(call)
    assert code is INVALID_ARGUMENT
    assert "do not parse" in words


def test_a_call_without_a_request_is_refused(robot: Robot) -> None:
    call = robot.channel.stream_unary(f"/{SERVICE_NAME}/Infer").future(
        iter(()), timeout=PATIENCE_S, metadata=bearer(ARM_7)
    )
    assert refusal_of(call)[0] is INVALID_ARGUMENT


def test_sessions_are_listed_with_their_owner(server: BackgroundServer, robot: Robot) -> None:
    infer(robot, ARM_7, "mine").result(PATIENCE_S)
    (listed,) = httpx.get(f"{server.admin_url}/v1/sessions", timeout=PATIENCE_S).json()["sessions"]
    assert (listed["session_id"], listed["identity"]) == ("mine", "arm-7")


def test_the_clients_token_can_be_text_a_file_or_a_function(
    server: BackgroundServer, tmp_path: Path
) -> None:
    file = tmp_path / "arm.token"
    file.touch(mode=0o600)
    file.write_text(f"{ARM_7}\n")
    for token in (ARM_7, file, lambda: ARM_7):
        transport = GrpcTransport(server.target, token=token)
        assert transport.get_model(PATIENCE_S).model_name == "stub"
        transport.close()


def test_the_clients_token_is_renewed_from_its_file(
    server: BackgroundServer, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file = tmp_path / "arm.token"
    file.write_text(new_token())
    file.chmod(0o644)
    transport = GrpcTransport(server.target, token=file)
    try:
        assert "chmod 600" in caplog.text
        with pytest.raises(TransportError, match="UNAUTHENTICATED"):
            transport.get_model(PATIENCE_S)
        file.write_text(ARM_7)
        assert transport.get_model(PATIENCE_S).model_name == "stub"
        file.unlink()
        assert transport.get_model(PATIENCE_S).model_name == "stub"
        assert "the last token is used again" in caplog.text
    finally:
        transport.close()


def test_a_robot_whose_token_is_revoked_holds_and_recovers(tokens: Path) -> None:
    edge, cloud = random_policy(seed=0)
    height, width = edge.info.image_size
    obs = {
        "images": [np.zeros((height, width, 3), np.uint8)] * edge.info.grid[0],
        "proprio": np.zeros(edge.info.proprio_dim, np.float32),
    }
    words = "pull the green drawer open"
    settings = ServerSettings(tokens_file=tokens, reload_interval_s=0.02)
    with (
        BackgroundServer(Engine(cloud), settings) as server,
        ComVLAClient(server.target, edge=edge, token=ARM_7, budget=8, deadline_s=20) as robot,
    ):
        assert robot.step(obs, words).source == "cloud"
        kept = tokens.read_text()
        rewrite(tokens, f"{TokenLine.of(Identity('arm-8'), ARM_8)}\n")
        held = eventually(lambda: (chunk := robot.step(obs, words)).source != "cloud" and chunk)
        assert held.report.fallback_reason == "unauthorized"
        rewrite(tokens, kept)
        eventually(lambda: robot.step(obs, words).source == "cloud")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"token": "two words"}, "without spaces"),
        ({"token": ""}, "without spaces"),
        ({"token": Path("/nowhere")}, "cannot read the token in /nowhere"),
        ({"insecure": True, "tls": ...}, "contradict"),
    ],
)
def test_the_client_refuses_a_token_that_cannot_be_used(
    arguments: dict[str, Any], words: str
) -> None:
    if "tls" in arguments:
        arguments = {**arguments, "tls": TlsOptions()}
    with pytest.raises(AccessError, match=words):
        Access("127.0.0.1:1", **arguments)


def test_a_token_does_not_cross_a_network_in_the_clear() -> None:
    for target in ("192.0.2.1:50051", "cloud.example:50051", "[2001:db8::1]:50051"):
        with pytest.raises(AccessError, match=r"in the clear.*TlsOptions"):
            Access(target, token=ARM_7)
        assert Access(target, token=ARM_7, insecure=True).metadata() == bearer(ARM_7)
    for target in ("127.0.0.1:50051", "localhost:50051", "[::1]:50051"):
        assert Access(target, token=ARM_7).metadata() == bearer(ARM_7)


def test_options_that_would_be_ignored_are_refused() -> None:
    edge, _ = random_policy(seed=0)
    with pytest.raises(AccessError, match="transport of your own"):
        ComVLAClient(object(), edge=edge, token=ARM_7)  # type: ignore[arg-type]
