"""The service over a real connection, with a model whose timing the test commands."""

from __future__ import annotations

import itertools
import logging

import grpc
import numpy as np
import pytest
from server_stubs import (
    PATIENCE_S,
    STUB_INFO,
    Robot,
    StubCloud,
    eventually,
    message,
    refusal_of,
    stub_actions,
)

from comvla import codec
from comvla.errors import InstructionError
from comvla.v1 import policy_pb2
from comvla_server.background import BackgroundServer
from comvla_server.engine import Engine
from comvla_server.settings import ServerSettings
from comvla_server.validation import Validator


def depth(server: BackgroundServer) -> int:
    """Requests that wait in the server."""
    value = server.server.metrics.registry.get_sample_value("comvla_queue_depth")
    assert value is not None
    return int(value)


def test_an_answer_carries_actions_cost_timings_and_load(robot: Robot, cloud: StubCloud) -> None:
    request = message("r1", 7, k=5)
    response = robot.infer(request)
    expected = stub_actions(Validator(Engine(cloud), 10_000).read(request))
    actions = np.float32(response.actions).reshape(response.action_horizon, response.action_dim)
    np.testing.assert_array_equal(actions, expected)
    assert (response.session_id, response.step) == ("r1", 7)
    assert (response.tokens_used, response.batch_size) == (5, 1)
    assert response.cloud_flops == 5000.0
    assert response.model_fingerprint == STUB_INFO.fingerprint
    timings = response.timings
    phases = (timings.decode_s, timings.queue_s, timings.predict_s)
    assert min(phases) > 0
    assert sum(phases) <= timings.total_s
    assert 0.0 <= response.load.utilization <= 1.0
    assert (response.load.queue_depth, response.load.suggested_tokens) == (0, 0)


def test_the_handshake_describes_the_model(robot: Robot) -> None:
    response = robot.stub.GetModel(policy_pb2.GetModelRequest(protocol_version=99))
    assert response.model_fingerprint == STUB_INFO.fingerprint
    assert response.token_dim == STUB_INFO.token_dim
    assert response.max_request_bytes == ServerSettings().max_request_bytes
    assert len(response.quantizations) == len(codec.QUANTIZATIONS)


def test_the_load_hint_tells_how_many_wait(
    server: BackgroundServer, robot: Robot, cloud: StubCloud
) -> None:
    cloud.hold()
    running = robot.send(message("first"))
    cloud.wait_until_running()
    waiting = [robot.send(message(f"s{i}")) for i in range(12)]
    eventually(lambda: depth(server) == 12)
    cloud.release(passes=1)
    assert running.result().load.queue_depth == 4  # eight of twelve are inside the model
    cloud.release()
    assert {call.result().batch_size for call in waiting} == {8, 4}


def test_a_retry_is_answered_from_the_record_and_computed_once(
    robot: Robot, cloud: StubCloud
) -> None:
    first = robot.infer(message(step=1))
    again = robot.infer(message(step=1, snr_db=3.0, snr_age_s=0.5))
    assert list(again.actions) == list(first.actions)
    assert again.cloud_flops == first.cloud_flops
    assert again.timings.predict_s == 0.0
    assert again.timings.total_s > 0.0
    assert len(cloud.batches) == 1


def test_a_retry_of_a_step_in_flight_joins_it(
    server: BackgroundServer, robot: Robot, cloud: StubCloud
) -> None:
    cloud.hold()
    one = robot.send(message())
    cloud.wait_until_running()
    registry = server.server.metrics.registry
    before = registry.get_sample_value("comvla_tx_framed_bytes_total")
    two = robot.send(message())
    eventually(lambda: registry.get_sample_value("comvla_tx_framed_bytes_total") > before)
    cloud.release()
    assert list(one.result().actions) == list(two.result().actions)
    assert len(cloud.batches) == 1


def test_the_same_step_with_other_content_is_refused(robot: Robot) -> None:
    robot.infer(message(step=1))
    code, words = robot.refused(message(step=1, instruction="close it"))
    assert code is grpc.StatusCode.INVALID_ARGUMENT
    assert "sent before with other content" in words


def test_the_latest_observation_wins(
    server: BackgroundServer, robot: Robot, cloud: StubCloud
) -> None:
    cloud.hold()
    running = robot.send(message("busy", name=-1.0))
    cloud.wait_until_running()
    older = robot.send(message("robot", 1, name=1.0))
    eventually(lambda: depth(server) == 1)
    newer = robot.send(message("robot", 2, name=2.0))
    code, words = refusal_of(older)
    assert code is grpc.StatusCode.ABORTED
    assert "step 1 of session 'robot' was superseded by step 2" in words
    cloud.release()
    assert running.result().step == 0
    assert newer.result().step == 2
    assert cloud.batches == [[-1.0], [2.0]]


def test_a_deadline_that_passes_in_the_queue_costs_no_compute(cloud: StubCloud) -> None:
    # Without admission, which would turn the call away before it waits.
    settings = ServerSettings(admission=False)
    with BackgroundServer(Engine(cloud), settings) as server, Robot(server.target) as robot:
        cloud.forget()
        cloud.hold()
        running = robot.send(message("busy", name=-1.0))
        cloud.wait_until_running()
        registry = server.server.metrics.registry
        numbers = itertools.count(1)

        def dropped() -> float | None:
            # Where the machine is busy a call may be over before it has arrived: the next has longer.
            number = next(numbers)
            late = message(f"late-{number}", name=5.0)
            code, _ = robot.refused(late, timeout_s=0.1 * number)
            assert code is grpc.StatusCode.DEADLINE_EXCEEDED
            labels = {"reason": "deadline"}
            return registry.get_sample_value("comvla_requests_dropped_total", labels)

        eventually(dropped)
        cloud.release()
        running.result()
        robot.infer(message("next", name=6.0))
        assert cloud.batches == [[-1.0], [6.0]]


def test_a_call_without_a_deadline_gets_one(cloud: StubCloud) -> None:
    settings = ServerSettings(default_deadline_s=0.1)
    with BackgroundServer(Engine(cloud), settings) as server, Robot(server.target) as robot:
        cloud.hold()
        code, words = robot.refused(message(), timeout_s=None)
        assert code is grpc.StatusCode.DEADLINE_EXCEEDED
        assert "within its deadline" in words
        assert "allow more time" in words
        cloud.release()


def test_a_robot_that_hangs_up_leaves_the_queue(
    server: BackgroundServer, robot: Robot, cloud: StubCloud
) -> None:
    cloud.hold()
    running = robot.send(message("busy", name=-1.0))
    cloud.wait_until_running()
    gone = robot.send(message("gone", name=5.0))
    eventually(lambda: depth(server) == 1)
    gone.cancel()
    eventually(lambda: depth(server) == 0)
    cloud.release()
    running.result()
    registry = server.server.metrics.registry
    labels = {"reason": "cancelled"}
    assert registry.get_sample_value("comvla_requests_dropped_total", labels) == 1
    assert cloud.batches == [[-1.0]]


def test_overload_is_refused_at_once_and_passes(cloud: StubCloud) -> None:
    settings = ServerSettings(max_queue=2, max_batch=2)
    with BackgroundServer(Engine(cloud), settings) as server, Robot(server.target) as robot:
        cloud.forget()
        cloud.hold()
        calls = [robot.send(message("busy"))]
        cloud.wait_until_running()
        calls += [robot.send(message(f"s{i}")) for i in range(2)]
        eventually(lambda: depth(server) == 2)
        code, words = robot.refused(message("more"))
        assert code is grpc.StatusCode.RESOURCE_EXHAUSTED
        assert "2 of 2 sessions wait" in words
        assert "add a replica" in words
        cloud.release()
        assert all(call.result() for call in calls)
        assert robot.infer(message("later"))


def test_more_calls_than_the_server_may_hold_are_refused_by_grpc(cloud: StubCloud) -> None:
    settings = ServerSettings(max_concurrent_calls=2)
    with BackgroundServer(Engine(cloud), settings) as server, Robot(server.target) as robot:
        cloud.forget()
        cloud.hold()
        calls = [robot.send(message("a"))]
        cloud.wait_until_running()  # else both may share a pass
        calls.append(robot.send(message("b")))
        eventually(lambda: depth(server) == 1)
        assert robot.refused(message("c"))[0] is grpc.StatusCode.RESOURCE_EXHAUSTED
        cloud.release()
        assert all(call.result() for call in calls)


def test_a_failing_model_is_internal_to_its_requests_only(
    robot: Robot, cloud: StubCloud, caplog: pytest.LogCaptureFixture
) -> None:
    cloud.breaks_on = lambda r: RuntimeError("out of memory") if r.proprio[0] == 1.0 else None
    code, words = robot.refused(message("a", name=1.0))
    assert code is grpc.StatusCode.INTERNAL
    assert "RuntimeError" in words
    assert "the server goes on" in words
    assert robot.infer(message("b", name=2.0))
    assert any(record.exc_info for record in caplog.records)


def test_a_bug_in_the_server_is_internal_and_logged(
    server: BackgroundServer, robot: Robot, cloud: StubCloud, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(instruction: str) -> None:
        raise ZeroDivisionError

    cloud.check_instruction = broken  # type: ignore[method-assign]
    code, words = robot.refused(message())
    assert code is grpc.StatusCode.INTERNAL
    assert "ZeroDivisionError" in words
    assert any(record.exc_info for record in caplog.records)


def test_refusals_are_logged_without_stack_traces(
    robot: Robot, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    robot.refused(message("a\nb"))
    (record,) = [r for r in caplog.records if r.getMessage().startswith("refused")]
    assert record.exc_info is None
    assert "\n" not in record.getMessage()
    assert record.reason == "invalid"


def test_bytes_that_are_no_message_are_an_invalid_argument(robot: Robot) -> None:
    call = robot.channel.unary_unary("/comvla.v1.PolicyService/Infer")
    code, words = refusal_of(call.future(b"\xff\xff\xff", timeout=PATIENCE_S))
    assert code is grpc.StatusCode.INVALID_ARGUMENT
    assert "expected a comvla.v1.InferRequest, got 3 bytes" in words


def test_a_broken_handshake_request_is_answered(robot: Robot) -> None:
    call = robot.channel.unary_unary("/comvla.v1.PolicyService/GetModel")
    answer = policy_pb2.GetModelResponse.FromString(call(b"\xff\xff", timeout=PATIENCE_S))
    assert answer.model_name == "stub"


def test_an_unknown_method_is_unimplemented(robot: Robot) -> None:
    call = robot.channel.unary_unary("/comvla.v1.PolicyService/Explode")
    code, _ = refusal_of(call.future(b"", timeout=PATIENCE_S))
    assert code is grpc.StatusCode.UNIMPLEMENTED


def test_words_that_encode_to_many_bytes_still_reach_the_robot(
    robot: Robot, cloud: StubCloud, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A status message travels percent-encoded: an emoji takes twelve bytes."""

    def refuse(instruction: str) -> None:
        raise InstructionError("🙂" * 2000)

    monkeypatch.setattr(cloud, "check_instruction", refuse)
    for request in (message(), message(session="🙂" * 64), message(instruction="🙂" * 2000)):
        code, words = robot.refused(request)
        assert code is grpc.StatusCode.INVALID_ARGUMENT
        assert "session_id" in words or "instruction" in words
