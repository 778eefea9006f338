"""Traces: one step is one trace, from the robot's cameras to the model's forward pass and back."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from comvla_client import AsyncComVLAClient, ComVLAClient, LinkProfile
from comvla_client.tracing import Tracing, session_hash, trace_headers
from comvla_server.background import BackgroundServer
from comvla_server.engine import Engine
from comvla_server.settings import ServerSettings, SettingsError
from comvla_server.tracing import Tracing as ServerTracing
from comvla_vla import CloudModel, EdgeModel

pytest.importorskip("opentelemetry.sdk", reason="traces need pip install 'comvla[otel]'")

EDGE = {"encode", "project", "vote", "select", "quantise"}


@pytest.fixture
def spans() -> Any:
    from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter

    return InMemorySpanExporter()


@pytest.fixture
def provider(spans: Any) -> Any:
    from opentelemetry.sdk.trace import TracerProvider
    from opentelemetry.sdk.trace.export import SimpleSpanProcessor

    provider = TracerProvider()
    provider.add_span_processor(SimpleSpanProcessor(spans))
    return provider


@pytest.fixture
def traced_server(
    policy: tuple[EdgeModel, CloudModel], provider: Any
) -> Iterator[BackgroundServer]:
    tracing = ServerTracing(provider)
    with BackgroundServer(Engine(policy[1]), tracing=tracing) as server:
        yield server


def observation(edge: EdgeModel) -> dict[str, Any]:
    info = edge.info
    images = [np.zeros((*info.image_size, 3), np.uint8)] * info.grid[0]
    return {"images": images, "proprio": np.zeros(info.proprio_dim)}


def by_name(spans: Any) -> dict[str, Any]:
    return {span.name.removeprefix("comvla."): span for span in spans.get_finished_spans()}


def assert_joined(found: dict[str, Any]) -> None:
    server = {"Infer", "decode", "queue", "batch", "forward", "encode"}
    assert set(found) >= EDGE | {"step", "budget", "call"} | server
    assert len({span.context.trace_id for span in found.values()}) == 1

    def parent(name: str) -> str:
        ids = {span.context.span_id: key for key, span in found.items()}
        return ids[found[name].parent.span_id]

    assert found["step"].parent is None
    assert {parent(name) for name in (EDGE - {"encode"}) | {"budget", "call"}} == {"step"}
    assert parent("Infer") == "call"
    assert {parent(name) for name in ("decode", "queue", "batch")} == {"Infer"}
    assert parent("forward") == "batch"
    for name in ("decode", "queue", "batch", "forward"):
        assert found["call"].start_time <= found[name].start_time
        assert found[name].end_time <= found["call"].end_time


def test_a_step_is_one_trace_over_a_real_server(
    policy: tuple[EdgeModel, CloudModel],
    traced_server: BackgroundServer,
    provider: Any,
    spans: Any,
) -> None:
    edge, _ = policy
    link = LinkProfile(bandwidth_hz=1e6)
    tracing = Tracing(provider)
    with ComVLAClient(
        traced_server.target, edge=edge, link=link, deadline_s=60.0, tracing=tracing
    ) as client:
        report = client.step(observation(edge), "push the drawer shut", 12.0).report
    assert report.source == "cloud"
    found = by_name(spans)
    assert_joined(found)
    step, infer = found["step"].attributes, found["Infer"].attributes
    assert step["comvla.tokens"] == infer["comvla.tokens"] == report.tokens
    assert step["comvla.payload_bytes"] == report.payload_bytes
    assert infer["comvla.request_bytes"] > report.encoded_bytes
    assert step["comvla.snr_db"] == infer["comvla.snr_db"] == 12.0
    assert step["comvla.session"] == infer["comvla.session"] == session_hash(report.session)
    assert infer["comvla.model"] == "default"
    assert report.session not in str([dict(s.attributes) for s in spans.get_finished_spans()])
    assert found["batch"].attributes["comvla.batch_size"] == 1
    assert trace_headers() == ()


async def test_the_asyncio_client_traces_alike(
    policy: tuple[EdgeModel, CloudModel],
    traced_server: BackgroundServer,
    provider: Any,
    spans: Any,
) -> None:
    edge, _ = policy
    async with AsyncComVLAClient(
        traced_server.target, edge=edge, budget=8, deadline_s=60.0, tracing=Tracing(provider)
    ) as client:
        assert (await client.step(observation(edge), "push the button")).source == "cloud"
    assert_joined(by_name(spans))


def test_a_step_without_an_answer_says_why(
    policy: tuple[EdgeModel, CloudModel], provider: Any, spans: Any
) -> None:
    edge, cloud = policy
    with BackgroundServer(Engine(cloud)) as server:
        client = ComVLAClient(
            server.target, edge=edge, budget=8, deadline_s=0.3, tracing=Tracing(provider)
        )
        server.stop()
        client.step(observation(edge), "push the button")
        client.step(observation(edge), "push the button", float("-inf"))
    client.close()
    reasons = [
        span.attributes["comvla.fallback_reason"]
        for span in spans.get_finished_spans()
        if span.name == "comvla.step"
    ]
    # On a busy machine the edge half may take all of the time; it has little, as nobody answers.
    assert reasons[0] in ("unavailable", "deadline")
    assert reasons[1] == "no_link"
    # Words of errors name sessions and identities: a trace has the reason alone.
    for span in spans.get_finished_spans():
        assert span.events == ()
        if span.name == "comvla.step":
            assert span.status.description == span.attributes["comvla.fallback_reason"]
        elif not span.status.is_ok and span.status.description is not None:
            assert span.status.description.isidentifier()
    assert not any(
        span.status.is_ok for span in spans.get_finished_spans() if span.name == "comvla.step"
    )


def test_a_refusal_marks_the_servers_span(traced_server: BackgroundServer, spans: Any) -> None:
    import grpc

    from comvla.v1 import policy_pb2, policy_pb2_grpc

    with grpc.insecure_channel(traced_server.target) as channel:
        stub = policy_pb2_grpc.PolicyServiceStub(channel)
        # What no tracer writes is taken for no trace at all.
        with pytest.raises(grpc.RpcError):
            stub.Infer(policy_pb2.InferRequest(), metadata=[("traceparent", "nonsense")])
    (span,) = spans.get_finished_spans()
    assert span.attributes["comvla.refusal"] == span.status.description == "mismatch"
    assert span.parent is None


def test_a_robot_that_is_not_sampled_is_not_traced_on_the_server_either(
    policy: tuple[EdgeModel, CloudModel], spans: Any
) -> None:
    from opentelemetry.sdk.trace import TracerProvider
    from opentelemetry.sdk.trace.export import SimpleSpanProcessor
    from opentelemetry.sdk.trace.sampling import ALWAYS_OFF, ALWAYS_ON, ParentBased

    edge, cloud = policy
    provider = TracerProvider(sampler=ParentBased(ALWAYS_ON))
    provider.add_span_processor(SimpleSpanProcessor(spans))
    silent = Tracing(TracerProvider(sampler=ALWAYS_OFF))
    with (
        BackgroundServer(Engine(cloud), tracing=ServerTracing(provider)) as server,
        ComVLAClient(server.target, edge=edge, budget=8, deadline_s=60.0, tracing=silent) as client,
    ):
        assert client.step(observation(edge), "push the button").source == "cloud"
    assert spans.get_finished_spans() == ()


def test_without_traces_nothing_of_opentelemetry_is_used(
    policy: tuple[EdgeModel, CloudModel], server: BackgroundServer
) -> None:
    edge, _ = policy
    assert ServerTracing.of(ServerSettings()) is None
    with ComVLAClient(server.target, edge=edge, budget=8, deadline_s=60.0) as client:
        assert client.step(observation(edge), "push the button").source == "cloud"


def test_settings_that_make_no_sense() -> None:
    with pytest.raises(SettingsError, match="OTLP/HTTP address"):
        ServerSettings(otel_endpoint="localhost:4317")
    with pytest.raises(SettingsError, match="from 0 to 1"):
        ServerSettings(otel_sample=2.0)


def test_spans_go_to_a_collector(policy: tuple[EdgeModel, CloudModel]) -> None:
    """Over a real socket; the collector only counts what comes."""
    import threading
    from http.server import BaseHTTPRequestHandler, HTTPServer

    came: list[tuple[str, int]] = []

    class Collector(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            length = int(self.headers["content-length"])
            self.rfile.read(length)
            came.append((self.path, length))
            self.send_response(200)
            self.end_headers()

        def log_message(self, *_: Any) -> None:
            pass

    collector = HTTPServer(("127.0.0.1", 0), Collector)
    threading.Thread(target=collector.serve_forever, daemon=True).start()
    endpoint = f"http://127.0.0.1:{collector.server_port}/v1/traces"
    edge, cloud = policy
    tracing = Tracing.otlp(endpoint)
    try:
        with (
            BackgroundServer(Engine(cloud), ServerSettings(otel_endpoint=endpoint)) as server,
            ComVLAClient(
                server.target, edge=edge, budget=8, deadline_s=60.0, tracing=tracing
            ) as client,
        ):
            assert client.step(observation(edge), "push the button").source == "cloud"
        tracing.close()
    finally:
        collector.shutdown()
    # Each side sends what it has at its end, and before that every few seconds.
    assert {path for path, _ in came} == {"/v1/traces"}
    assert len(came) >= 2
