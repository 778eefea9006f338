"""Counters say what happened."""

from __future__ import annotations

import re

from prometheus_client import generate_latest
from server_stubs import STUB_INFO, Robot, StubCloud, message

from comvla import codec
from comvla_server.background import BackgroundServer
from comvla_server.metrics import Metrics
from comvla_server.refusals import Reason


def value(server: BackgroundServer, name: str, **labels: str) -> float:
    found = server.server.metrics.registry.get_sample_value(name, labels)
    assert found is not None, f"{name}{labels} does not exist"
    return found


def test_a_fresh_server_has_counted_nothing_though_it_warmed_up(server: BackgroundServer) -> None:
    for name in (
        "comvla_tx_payload_bytes_total",
        "comvla_tx_encoded_bytes_total",
        "comvla_tx_framed_bytes_total",
        "comvla_tokens_received_total",
        "comvla_inference_flops_total",
        "comvla_inference_busy_seconds_total",
        "comvla_model_errors_total",
        "comvla_batch_size_count",
        "comvla_queue_depth",
        "comvla_sessions",
        "comvla_inference_utilization_ratio",
    ):
        assert value(server, name) == 0.0
    for phase in ("decode", "queue", "predict"):
        assert value(server, "comvla_step_phase_seconds_count", phase=phase) == 0.0
    for reason in Reason:
        assert value(server, "comvla_requests_dropped_total", reason=reason.value) == 0.0
    assert value(server, "comvla_server_ready") == 1.0


def test_bytes_tokens_and_flops_are_what_was_sent(server: BackgroundServer, robot: Robot) -> None:
    sent = [
        message("a", i, k=k, quantization=q)
        for i, (k, q) in enumerate([(1, "float32"), (5, "int8"), (16, "int4"), (3, "float16")])
    ]
    responses = [robot.infer(request) for request in sent]
    dim = STUB_INFO.token_dim
    assert value(server, "comvla_tx_payload_bytes_total") == sum(
        codec.payload_bytes(k, dim, q)
        for k, q in [(1, "float32"), (5, "int8"), (16, "int4"), (3, "float16")]
    )
    assert value(server, "comvla_tx_encoded_bytes_total") == sum(len(r.payload) for r in sent)
    assert value(server, "comvla_tx_framed_bytes_total") == sum(
        codec.wire_bytes(r.ByteSize()) for r in sent
    )
    assert value(server, "comvla_tokens_received_total") == 25
    assert value(server, "comvla_request_tokens_count") == 4
    flops = sum(r.cloud_flops for r in responses)
    assert value(server, "comvla_inference_flops_total") == flops == 25_000
    assert value(server, "comvla_batch_size_sum") == 4
    assert value(server, "comvla_sessions") == 1
    assert value(server, "comvla_step_duration_seconds_count", outcome="ok") == 4
    for phase in ("decode", "queue", "predict"):
        assert value(server, "comvla_step_phase_seconds_count", phase=phase) == 4


def test_a_repeat_crosses_the_link_again_but_costs_no_compute(
    server: BackgroundServer, robot: Robot
) -> None:
    for _ in range(3):
        robot.infer(message(k=2))
    assert value(server, "comvla_tokens_received_total") == 6
    assert value(server, "comvla_inference_flops_total") == 2000
    assert value(server, "comvla_step_duration_seconds_count", outcome="repeat") == 2


def test_refused_calls_are_counted_by_reason(
    server: BackgroundServer, robot: Robot, cloud: StubCloud
) -> None:
    robot.infer(message(step=5))
    cloud.breaks_on = lambda r: ValueError() if r.proprio[0] == 9.0 else None
    for request in (
        message("a", instruction=""),
        message("a", model_fingerprint="beef"),
        message(step=4),
        message(step=5, k=9),
        message("a", name=9.0),
    ):
        robot.refused(request)
    for reason in ("invalid", "mismatch", "superseded", "conflict", "model"):
        assert value(server, "comvla_requests_dropped_total", reason=reason) == 1
        assert value(server, "comvla_step_duration_seconds_count", outcome=reason) == 1
    # What was refused crossed the link as well.
    assert value(server, "comvla_request_tokens_count") == 6


def test_a_payload_that_is_none_counts_as_bytes_only(
    server: BackgroundServer, robot: Robot
) -> None:
    robot.refused(message(payload=b"junk"))
    assert value(server, "comvla_tx_encoded_bytes_total") == 4
    assert value(server, "comvla_tx_payload_bytes_total") == 0
    assert value(server, "comvla_request_tokens_count") == 0


def test_the_model_is_described_by_labels(server: BackgroundServer) -> None:
    text = generate_latest(server.server.metrics.registry).decode()
    (line,) = re.findall(r"^comvla_model_info\{(.*)\} 1\.0$", text, re.MULTILINE)
    assert 'model="stub"' in line
    assert 'fingerprint="f00d"' in line


def test_names_follow_the_conventions_and_no_robot_is_a_label(
    server: BackgroundServer, robot: Robot
) -> None:
    robot.infer(message("very-private-robot"))
    registry = server.server.metrics.registry
    text = generate_latest(registry).decode()
    assert "very-private-robot" not in text
    for family in registry.collect():
        assert family.name.startswith(("comvla_", "process_"))
        assert family.documentation
        assert not re.search(r"_(ms|kb|milliseconds|kib|mb)\b", family.name)


def test_two_servers_in_one_process_count_for_themselves() -> None:
    one, two = Metrics(), Metrics()
    one.tx_payload_bytes.inc(5)
    assert one.registry.get_sample_value("comvla_tx_payload_bytes_total") == 5
    assert two.registry.get_sample_value("comvla_tx_payload_bytes_total") == 0
