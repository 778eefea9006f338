"""What Prometheus reads: prefix ``comvla_``, base units, no session or robot as a label."""

from __future__ import annotations

from collections.abc import Callable

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram
from prometheus_client.process_collector import ProcessCollector

from comvla.model_info import PROTOCOL_VERSION, ModelInfo
from comvla_server.piecewise import ENDINGS
from comvla_server.refusals import Reason

# 1 to 500 ms: a control period is tens of milliseconds, anything above is a miss.
SECONDS_BUCKETS = (0.001, 0.002, 0.005, 0.01, 0.02, 0.035, 0.05, 0.075, 0.1, 0.15, 0.2, 0.3, 0.5)
SNR_BUCKETS = (-10, -5, 0, 2.5, 5, 7.5, 10, 12.5, 15, 17.5, 20, 25, 30, 40)
TOKEN_BUCKETS = (1, 4, 8, 16, 32, 48, 64, 96, 128, 256, 512)
BATCH_BUCKETS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 64)

DOOR_REASONS = (
    Reason.NO_IDENTITY,
    Reason.RATE,
    Reason.OVERSIZE,
    Reason.SLOW,
    Reason.CONGESTED,
)
"""Why a call can be turned away before it reaches a service."""


class Metrics:
    """All counters of one server, in a registry of its own: two servers can share a process.

    TX is the robot's transmission, seen from the server: counted for every call that arrived,
    repeats and refused calls included, because they crossed the link too. Three sizes that must not
    be confused: ``payload`` is the paper's accounting K·D·B/8, or the files of coded pictures; ``encoded``
    the bytes of the payload or images field, ``framed`` the whole message with protobuf, gRPC and HTTP/2
    framing.
    """

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        ProcessCollector(registry=self.registry)
        self.tx_payload_bytes = self._counter(
            "comvla_tx_payload_bytes",
            "Paper accounting in bytes: token bits K*D*B/8, or the files of coded pictures.",
        )
        self.tx_image_bytes = self._counter(
            "comvla_tx_image_bytes", "Files of coded pictures received, in bytes."
        )
        self.tx_encoded_bytes = self._counter(
            "comvla_tx_encoded_bytes",
            "Bytes of the payload fields received (scales and positions), or of the images fields.",
        )
        self.tx_framed_bytes = self._counter(
            "comvla_tx_framed_bytes", "Bytes of requests with protobuf, gRPC and HTTP/2 framing."
        )
        self.tokens_received = self._counter(
            "comvla_tokens_received", "Visual tokens that arrived whole."
        )
        self.request_tokens = self._histogram(
            "comvla_request_tokens", "Visual tokens that arrived whole, per request.", TOKEN_BUCKETS
        )
        self.inference_flops = self._counter(
            "comvla_inference_flops",
            "Multiply-adds counted twice, spent on answers.",
        )
        self.inference_busy_seconds = self._counter(
            "comvla_inference_busy_seconds", "Time that the inference thread spent in the model."
        )
        self.model_errors = self._counter(
            "comvla_model_errors", "Forward passes that failed or returned unusable actions."
        )
        self.batch_size = self._histogram(
            "comvla_batch_size", "Requests per forward pass.", BATCH_BUCKETS
        )
        self.step_duration = Histogram(
            "comvla_step_duration_seconds",
            "Time from a parsed request to its response, by outcome: ok, repeat, or the refusal.",
            ["outcome"],
            buckets=SECONDS_BUCKETS,
            registry=self.registry,
        )
        self.step_phase = Histogram(
            "comvla_step_phase_seconds",
            "Time of one phase of an answered step: collect (pieces only), decode, queue, predict.",
            ["phase"],
            buckets=SECONDS_BUCKETS,
            registry=self.registry,
        )
        self.predicted_wait = self._histogram(
            "comvla_predicted_wait_seconds",
            "Time until its answer that was predicted when a request was let in, margins included.",
            SECONDS_BUCKETS,
        )
        self.requests_dropped = Counter(
            "comvla_requests_dropped",
            "Infer and InferProgressive calls that ended without actions, by reason.",
            ["reason"],
            registry=self.registry,
        )
        self.unanswered_steps = self._counter(
            "comvla_unanswered_steps",
            "Steps that robots had to bridge: gaps between the answered steps of a session.",
        )
        self.reported_snr_db = self._histogram(
            "comvla_reported_snr_db",
            "SNR that robots reported when they sized what they sent, dB.",
            SNR_BUCKETS,
        )
        self.streams = Counter(
            "comvla_progressive_streams",
            "Payloads that came in pieces, by how the stream ended: whole, closed by the robot, "
            "window over, repeat of a recorded step, or refused.",
            ["ending"],
            registry=self.registry,
        )
        self.calls_refused = Counter(
            "comvla_calls_refused",
            "Calls turned away before they reached a service, by reason.",
            ["reason"],
            registry=self.registry,
        )
        self.reload_failures = Counter(
            "comvla_reload_failures",
            "Files that changed and could not be used; the old content stays in force.",
            ["file"],
            registry=self.registry,
        )
        self.certificate_not_after = Gauge(
            "comvla_certificate_not_after_seconds",
            "When a certificate in use expires, seconds since 1970; no series without TLS.",
            ["certificate"],
            registry=self.registry,
        )
        self.model_requests = Counter(
            "comvla_model_requests",
            "Infer and InferProgressive calls by model and by whether it answered: ok, repeat, refused.",
            ["model", "outcome"],
            registry=self.registry,
        )
        self._model_queue_depth = Gauge(
            "comvla_model_queue_depth",
            "Requests that wait for one model.",
            ["model"],
            registry=self.registry,
        )
        # Every series exists from the start: a rate over a late one loses its first step.
        for reason in Reason:
            self.requests_dropped.labels(reason.value)
        for reason in DOOR_REASONS:
            self.calls_refused.labels(reason.value)
        for phase in ("collect", "decode", "queue", "predict"):
            self.step_phase.labels(phase)
        for ending in ENDINGS:
            self.streams.labels(ending)
        self._queue_depth = Gauge(
            "comvla_queue_depth", "Requests that wait for the model.", registry=self.registry
        )
        self._utilization = Gauge(
            "comvla_inference_utilization_ratio",
            "Busy share of the inference thread over the last seconds.",
            registry=self.registry,
        )
        self._offered_load = Gauge(
            "comvla_offered_load_ratio",
            "Work that robots ask for, turned away or not, as a share of what full batches can do.",
            registry=self.registry,
        )
        self._suggested_tokens = Gauge(
            "comvla_suggested_tokens",
            "Tokens that robots are advised to send at most, 0 for as many as they like.",
            registry=self.registry,
        )
        self._in_flight = Gauge(
            "comvla_bytes_in_flight",
            "Bytes that open calls hold, as messages and as decoded tokens.",
            registry=self.registry,
        )
        self._sessions = Gauge(
            "comvla_sessions", "Sessions whose last answer is on record.", registry=self.registry
        )
        self._ready = Gauge(
            "comvla_server_ready", "1 while calls are answered, else 0.", registry=self.registry
        )
        self._model_info = Gauge(
            "comvla_model_info",
            "Always 1; its labels describe the model.",
            ["model", "fingerprint", "protocol_version", "server_version"],
            registry=self.registry,
        )

    def watch(
        self,
        *,
        queue_depth: Callable[[], float],
        utilization: Callable[[], float],
        sessions: Callable[[], float],
        offered_load: Callable[[], float],
        suggested_tokens: Callable[[], float],
    ) -> None:
        """Reads these gauges from their owners at every scrape."""
        self._offered_load.set_function(offered_load)
        self._suggested_tokens.set_function(suggested_tokens)
        self._queue_depth.set_function(queue_depth)
        self._utilization.set_function(utilization)
        self._sessions.set_function(sessions)

    def watch_model(self, model: str, queue_depth: Callable[[], float]) -> None:
        """Tells a model apart from others from now on, by a name that the operator chose.

        Args:
            model: its name.
            queue_depth: read at every scrape.
        """
        for outcome in ("ok", "repeat", "refused"):
            self.model_requests.labels(model, outcome)
        self._model_queue_depth.labels(model).set_function(queue_depth)

    def watch_bytes(self, in_flight: Callable[[], float]) -> None:
        """Reads the bytes in flight at every scrape."""
        self._in_flight.set_function(in_flight)

    def watch_ready(self, ready: Callable[[], bool]) -> None:
        """Reads readiness at every scrape."""
        self._ready.set_function(lambda: float(ready()))

    def refusals(self) -> dict[str, int]:
        """Calls that ended without actions so far, by reason; reasons without any are left out."""
        counts: dict[str, int] = {}
        for counter in (self.requests_dropped, self.calls_refused):
            for sample in next(iter(counter.collect())).samples:
                if sample.name.endswith("_total") and sample.value:
                    reason = sample.labels["reason"]
                    counts[reason] = counts.get(reason, 0) + int(sample.value)
        return counts

    def describe_model(self, info: ModelInfo, server_version: str) -> None:
        """Publishes which model answers."""
        self._model_info.labels(
            info.name, info.fingerprint, str(PROTOCOL_VERSION), server_version
        ).set(1)

    def forget_model(self, info: ModelInfo, server_version: str) -> None:
        """Takes back a model that answers no more."""
        self._model_info.remove(info.name, info.fingerprint, str(PROTOCOL_VERSION), server_version)

    def _counter(self, name: str, text: str) -> Counter:
        return Counter(name, text, registry=self.registry)

    def _histogram(self, name: str, text: str, buckets: tuple[float, ...]) -> Histogram:
        return Histogram(name, text, buckets=buckets, registry=self.registry)
