"""OpenTelemetry traces of a robot's steps, joined with the server's by W3C ``traceparent``.

Off unless a client is given a :class:`Tracing`; then nothing of OpenTelemetry is imported, and a step pays
for two calls that do nothing.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any

from comvla.errors import DependencyError

if TYPE_CHECKING:
    from comvla_client.prepared import Prepared
    from comvla_client.report import ActionChunk

Headers = tuple[tuple[str, str], ...]

_HEADERS: ContextVar[Headers] = ContextVar("comvla_trace_headers", default=())

# Names in a trace of the phases of a report, in the order in which they happen.
_PHASES = {
    "encode": "encode",
    "project": "project",
    "score": "vote",
    "select": "select",
    "quantize": "quantise",
}


def trace_headers() -> Headers:
    """What a call has to carry so that the server's part joins the trace; nothing where there is none."""
    return _HEADERS.get()


def session_hash(session: str) -> str:
    """A session in traces: told apart, and not told."""
    return hashlib.blake2b(session.encode(), digest_size=8).hexdigest()


class Tracing:
    """Makes a trace of every step.

    Args:
        provider: an OpenTelemetry ``TracerProvider``; who made it also shuts it down.
    """

    def __init__(self, provider: Any) -> None:
        try:
            from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator
        except ImportError as error:
            raise DependencyError(
                "traces need OpenTelemetry: pip install 'comvla[otel]'"
            ) from error
        self.provider = provider
        self._tracer = provider.get_tracer("comvla_client")
        self._propagator = TraceContextTextMapPropagator()

    @classmethod
    def otlp(
        cls, endpoint: str | None = None, *, sample: float = 1.0, service: str = "comvla-robot"
    ) -> Tracing:
        """Traces that go to a collector over OTLP/HTTP.

        Args:
            endpoint: e.g. ``http://127.0.0.1:4318/v1/traces``; OpenTelemetry's own variables
                (``OTEL_EXPORTER_OTLP_ENDPOINT``) where None.
            sample: share of the steps that are traced, 0 to 1.
            service: name of this robot's service in the traces.

        Raises:
            DependencyError: OpenTelemetry is not installed.
        """
        try:
            from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
            from opentelemetry.sdk.resources import Resource
            from opentelemetry.sdk.trace import TracerProvider
            from opentelemetry.sdk.trace.export import BatchSpanProcessor
            from opentelemetry.sdk.trace.sampling import ParentBased, TraceIdRatioBased
        except ImportError as error:
            raise DependencyError(
                "traces need OpenTelemetry: pip install 'comvla[otel]'"
            ) from error
        provider = TracerProvider(
            sampler=ParentBased(TraceIdRatioBased(sample)),
            resource=Resource.create({"service.name": service}),
        )
        provider.add_span_processor(BatchSpanProcessor(OTLPSpanExporter(endpoint=endpoint)))
        return cls(provider)

    def close(self) -> None:
        """Sends what is left."""
        self.provider.shutdown()

    @contextmanager
    def step(self) -> Iterator[StepTrace]:
        """Around a step."""
        with _span(self._tracer, "comvla.step") as span:
            yield StepTrace(self._tracer, self._propagator, span)


@contextmanager
def _span(tracer: Any, name: str, **how: Any) -> Iterator[Any]:
    """A current span. Of an error it keeps the kind alone: the words name sessions and identities."""
    from opentelemetry.trace import Status, StatusCode

    with tracer.start_as_current_span(
        name, record_exception=False, set_status_on_exception=False, **how
    ) as span:
        try:
            yield span
        except Exception as error:
            span.set_status(Status(StatusCode.ERROR, type(error).__name__))
            raise


class StepTrace:
    """The trace of one step."""

    def __init__(self, tracer: Any, propagator: Any, span: Any) -> None:
        self._tracer, self._propagator, self._span = tracer, propagator, span

    def prepared(self, prepared: Prepared) -> None:
        """The edge half is done; its phases are known by their lengths."""
        if not self._span.is_recording():
            return
        zero_ns = time.time_ns() - int(1e9 * time.perf_counter())
        at = prepared.planned
        self._phase("comvla.budget", zero_ns, prepared.started, at)
        for phase, name in _PHASES.items():
            took_s = prepared.report.timings_s.get(phase, 0.0)
            if took_s > 0.0:
                self._phase(f"comvla.{name}", zero_ns, at, at + took_s)
                at += took_s

    @contextmanager
    def call(self) -> Iterator[None]:
        """Around the call: sending, and waiting for the answer."""
        from opentelemetry.trace import SpanKind

        with _span(self._tracer, "comvla.call", kind=SpanKind.CLIENT):
            carrier: dict[str, str] = {}
            self._propagator.inject(carrier)
            token = _HEADERS.set(tuple(carrier.items()))
            try:
                yield
            finally:
                _HEADERS.reset(token)

    def done(self, chunk: ActionChunk) -> None:
        """How the step ended."""
        report, span = chunk.report, self._span
        span.set_attributes(
            {
                "comvla.session": session_hash(report.session),
                "comvla.step": report.step,
                "comvla.uplink": report.uplink,
                "comvla.tokens": report.tokens,
                "comvla.payload_bytes": report.payload_bytes,
                "comvla.framed_bytes": report.framed_bytes,
                "comvla.source": report.source,
            }
        )
        if report.snr_db is not None:
            span.set_attribute("comvla.snr_db", report.snr_db)
        if report.fallback_reason is not None:
            from opentelemetry.trace import Status, StatusCode

            # The reason alone: the detail may name sessions and identities.
            span.set_attribute("comvla.fallback_reason", report.fallback_reason)
            span.set_status(Status(StatusCode.ERROR, report.fallback_reason))

    def _phase(self, name: str, zero_ns: int, begin_s: float, end_s: float) -> None:
        span = self._tracer.start_span(name, start_time=zero_ns + int(1e9 * begin_s))
        span.end(zero_ns + int(1e9 * end_s))


class _NoTrace:
    """The trace of a step that nobody traces."""

    def prepared(self, prepared: Prepared) -> None:
        """Nothing."""

    def call(self) -> _NoTrace:
        """Nothing, around the call."""
        return self

    def done(self, chunk: ActionChunk) -> None:
        """Nothing."""

    def __enter__(self) -> _NoTrace:
        return self

    def __exit__(self, *_: object) -> None:
        pass


_NO_TRACE = _NoTrace()


def traced(tracing: Tracing | None) -> Any:
    """Around a step: its trace, a context manager."""
    return _NO_TRACE if tracing is None else tracing.step()
