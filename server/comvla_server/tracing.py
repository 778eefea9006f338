"""OpenTelemetry traces of the calls that a server answers, joined with the robots' by ``traceparent``."""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

from comvla.errors import DependencyError
from comvla.v1 import policy_pb2
from comvla_server.refusals import Refusal
from comvla_server.settings import ServerSettings
from comvla_server.tickets import Answer

_LAST_WORDS_S = 2.0
_PARENTS = ("traceparent", "tracestate")


class Tracing:
    """Makes a span of every call, with its phases as children.

    Args:
        provider: an OpenTelemetry ``TracerProvider``.

    Raises:
        DependencyError: OpenTelemetry is not installed.
    """

    def __init__(self, provider: Any) -> None:
        try:
            from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator
        except ImportError as error:
            raise DependencyError(
                "--otel-endpoint needs OpenTelemetry: pip install 'comvla[otel]'"
            ) from error
        self._provider = provider
        self._tracer = provider.get_tracer("comvla_server")
        self._propagator = TraceContextTextMapPropagator()

    @classmethod
    def of(cls, settings: ServerSettings) -> Tracing | None:
        """As the settings say; None where nobody wants traces.

        Raises:
            DependencyError: OpenTelemetry is not installed.
        """
        if settings.otel_endpoint is None:
            return None
        try:
            from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
            from opentelemetry.sdk.resources import Resource
            from opentelemetry.sdk.trace import TracerProvider
            from opentelemetry.sdk.trace.export import BatchSpanProcessor
            from opentelemetry.sdk.trace.sampling import ParentBased, TraceIdRatioBased
        except ImportError as error:
            raise DependencyError(
                "--otel-endpoint needs OpenTelemetry: pip install 'comvla[otel]'"
            ) from error
        provider = TracerProvider(
            sampler=ParentBased(TraceIdRatioBased(settings.otel_sample)),
            resource=Resource.create({"service.name": "comvla-server"}),
        )
        exporter = OTLPSpanExporter(endpoint=settings.otel_endpoint)
        provider.add_span_processor(BatchSpanProcessor(exporter))
        return cls(provider)

    def close(self) -> None:
        """Sends what is left, unless the collector takes too long."""
        thread = threading.Thread(target=self._provider.shutdown, name="comvla-otel", daemon=True)
        thread.start()
        thread.join(_LAST_WORDS_S)

    @contextmanager
    def call(
        self, method: str, metadata: Iterable[tuple[str, str | bytes]] | None
    ) -> Iterator[None]:
        """Around a call.

        Args:
            method: its name.
            metadata: of the call; a robot's ``traceparent`` is in it where the robot traces, too.
        """
        from opentelemetry.trace import SpanKind, Status, StatusCode

        carrier = {key: str(value) for key, value in metadata or () if key in _PARENTS}
        span = self._tracer.start_span(
            f"comvla.{method}", context=self._propagator.extract(carrier), kind=SpanKind.SERVER
        )
        token = _CURRENT.set(CallTrace(self._tracer, span) if span.is_recording() else None)
        try:
            yield
        except Refusal as refusal:
            # The reason alone: the message names sessions and identities.
            span.set_attribute("comvla.refusal", refusal.reason.value)
            span.set_status(Status(StatusCode.ERROR, refusal.reason.value))
            raise
        finally:
            _CURRENT.reset(token)
            span.end()


class CallTrace:
    """The span of a call under way."""

    def __init__(self, tracer: Any, span: Any) -> None:
        from opentelemetry.trace import set_span_in_context

        self._tracer, self._span = tracer, span
        self._inside = set_span_in_context(span)
        self._zero_ns = time.time_ns() - time.monotonic_ns()

    def answered(
        self,
        request: policy_pb2.InferRequest,
        answer: Answer,
        *,
        model: str,
        decoded_s: tuple[float, float],
        admitted_s: float,
        finished_s: float,
        encoded_s: float,
        repeat: bool,
    ) -> None:
        """Phases of a call that was answered; times on ``time.monotonic``.

        Args:
            request: what was asked.
            answer: what the model said.
            model: name of the model.
            decoded_s: begin and end of decoding.
            admitted_s: when the request joined the queue.
            finished_s: when the answer was there.
            encoded_s: when the response was made of it.
            repeat: whether it is the answer to an earlier call.
        """
        from opentelemetry.trace import set_span_in_context

        session = hashlib.blake2b(request.session_id.encode(), digest_size=8).hexdigest()
        attributes: dict[str, Any] = {
            "comvla.session": session,
            "comvla.step": request.step,
            "comvla.model": model,
            "comvla.tokens": answer.tokens_used,
            "comvla.request_bytes": request.ByteSize(),
            "comvla.batch_size": answer.batch_size,
            "comvla.repeat": repeat,
        }
        if request.HasField("snr_db"):
            attributes["comvla.snr_db"] = request.snr_db
        self._span.set_attributes(attributes)
        if not repeat:
            begun_s = admitted_s + answer.queue_s
            self._phase("decode", *decoded_s)
            self._phase("queue", admitted_s, begun_s)
            batch = self._start("batch", begun_s, self._inside)
            batch.set_attribute("comvla.batch_size", answer.batch_size)
            inside = set_span_in_context(batch)
            forward = self._start("forward", begun_s, inside)
            forward.set_attribute("comvla.flops", answer.cloud_flops)
            forward.end(self._ns(begun_s + answer.predict_s))
            batch.end(self._ns(finished_s))
        self._phase("encode", finished_s, encoded_s)

    def _phase(self, name: str, begin_s: float, end_s: float) -> None:
        self._start(name, begin_s, self._inside).end(self._ns(end_s))

    def _start(self, name: str, begin_s: float, inside: Any) -> Any:
        return self._tracer.start_span(f"comvla.{name}", inside, start_time=self._ns(begin_s))

    def _ns(self, at_s: float) -> int:
        return self._zero_ns + int(1e9 * at_s)


_CURRENT: ContextVar[CallTrace | None] = ContextVar("comvla_trace", default=None)


def current_trace() -> CallTrace | None:
    """The trace of the call that runs here; None where nobody looks at it."""
    return _CURRENT.get()
