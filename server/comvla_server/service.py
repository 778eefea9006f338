"""``comvla.v1.PolicyService``: from a message to a status or a chunk of actions."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import grpc

from comvla import codec, handshake
from comvla.errors import CodecError
from comvla.images import picture_bytes
from comvla.v1 import policy_pb2, policy_pb2_grpc
from comvla_server.batcher import Batcher
from comvla_server.decoding import Decoding
from comvla_server.engine import Engine
from comvla_server.lifecycle import Lifecycle
from comvla_server.log_throttle import LogThrottle
from comvla_server.metrics import Metrics
from comvla_server.refusals import Reason, Refusal
from comvla_server.settings import ServerSettings
from comvla_server.tickets import Answer
from comvla_server.validation import Validator, content_digest
from comvla_server.version import server_version
from comvla_server.wording import shown
from comvla_vla.request import AnyRequest

_log = logging.getLogger(__name__)

# A robot's own deadline began when it sent: it hangs up earlier than the deadline seen from here.
_TRANSIT_S = 0.05

STATUS = {
    Reason.MALFORMED: grpc.StatusCode.INVALID_ARGUMENT,
    Reason.INVALID: grpc.StatusCode.INVALID_ARGUMENT,
    Reason.CONFLICT: grpc.StatusCode.INVALID_ARGUMENT,
    Reason.MISMATCH: grpc.StatusCode.FAILED_PRECONDITION,
    Reason.OVERSIZE: grpc.StatusCode.RESOURCE_EXHAUSTED,
    Reason.OVERLOAD: grpc.StatusCode.RESOURCE_EXHAUSTED,
    Reason.KEY_FRAME: grpc.StatusCode.ABORTED,
    Reason.SUPERSEDED: grpc.StatusCode.ABORTED,
    Reason.DEADLINE: grpc.StatusCode.DEADLINE_EXCEEDED,
    Reason.CANCELLED: grpc.StatusCode.CANCELLED,
    Reason.LOADING: grpc.StatusCode.UNAVAILABLE,
    Reason.DRAINING: grpc.StatusCode.UNAVAILABLE,
    Reason.MODEL: grpc.StatusCode.INTERNAL,
}


@dataclass(frozen=True)
class Runtime:
    """What exists once the model is loaded."""

    engine: Engine
    batcher: Batcher
    validator: Validator
    decoding: Decoding


class PolicyService(policy_pb2_grpc.PolicyServiceServicer):
    """Validates, queues, answers. One instance lives on one event loop.

    Args:
        lifecycle: whether calls are welcome.
        metrics: where calls are counted.
        settings: limits and the default deadline.
        clock: monotonic seconds.

    Attributes:
        runtime: the loaded model behind its queue, None while loading.
        idle: set while no Infer call is open.
    """

    def __init__(
        self,
        lifecycle: Lifecycle,
        metrics: Metrics,
        settings: ServerSettings,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.runtime: Runtime | None = None
        self.idle = asyncio.Event()
        self.idle.set()
        self._calls = 0
        self._lifecycle = lifecycle
        self._metrics = metrics
        self._settings = settings
        self._clock = clock
        self._throttle = LogThrottle(clock)

    async def GetModel(
        self, request: policy_pb2.GetModelRequest, context: grpc.aio.ServicerContext[Any, Any]
    ) -> policy_pb2.GetModelResponse:
        """Describes the model, to any protocol version: the robot says what differs."""
        try:
            runtime = self._require_runtime()
        except Refusal as refusal:
            await context.abort(STATUS[refusal.reason], refusal.message)
        return handshake.to_response(
            runtime.engine.info,
            quantizations=codec.QUANTIZATIONS,
            max_request_bytes=self._settings.max_request_bytes,
            server_version=server_version(),
            image_codings=runtime.engine.image_codings,
        )

    async def Infer(
        self, request: policy_pb2.InferRequest, context: grpc.aio.ServicerContext[Any, Any]
    ) -> policy_pb2.InferResponse:
        """Actions for one observation, or a status that says why not."""
        try:
            return await self.infer(request, context.time_remaining())
        except Refusal as refusal:
            await context.abort(STATUS[refusal.reason], refusal.message)

    async def infer(
        self, request: policy_pb2.InferRequest, time_remaining_s: float | None
    ) -> policy_pb2.InferResponse:
        """:meth:`Infer` without a transport.

        Args:
            request: a parsed message.
            time_remaining_s: seconds until the caller gives up, None where it did not say.

        Raises:
            Refusal: no actions, and why.
        """
        started_s = self._clock()
        deadline_s = started_s + (
            self._settings.default_deadline_s if time_remaining_s is None else time_remaining_s
        )
        outcome = Reason.CANCELLED.value
        self._calls += 1
        self.idle.clear()
        try:
            self._count_arrival(request)
            response, repeat = await self._answer(request, started_s, deadline_s)
            outcome = "repeat" if repeat else "ok"
            return response
        except Refusal as refusal:
            outcome = refusal.reason.value
            self._note_refusal(request, refusal)
            raise
        except asyncio.CancelledError:
            if self._clock() >= deadline_s - _TRANSIT_S:
                outcome = Reason.DEADLINE.value
            self._metrics.requests_dropped.labels(outcome).inc()
            raise
        except Exception as error:
            outcome = Reason.MODEL.value
            _log.exception("a request broke the server's own code")
            self._metrics.requests_dropped.labels(outcome).inc()
            raise Refusal(
                Reason.MODEL,
                f"expected actions, the server failed with {type(error).__name__}: "
                "its log says more, please report it",
            ) from error
        finally:
            self._calls -= 1
            if not self._calls:
                self.idle.set()
            self._metrics.step_duration.labels(outcome).observe(self._clock() - started_s)

    def note_malformed(self, size_bytes: int) -> Refusal:
        """Counts bytes that are no InferRequest, and says so."""
        refusal = Refusal(
            Reason.MALFORMED,
            f"expected a comvla.v1.InferRequest, got {size_bytes} bytes that do not parse as one: "
            "build requests from the contract's generated code",
        )
        self._metrics.tx_framed_bytes.inc(codec.wire_bytes(size_bytes))
        self._note_refusal(policy_pb2.InferRequest(), refusal)
        return refusal

    def _require_runtime(self) -> Runtime:
        self._lifecycle.require_ready()
        assert self.runtime is not None, "a server that is ready has a model"
        return self.runtime

    async def _answer(
        self, request: policy_pb2.InferRequest, started_s: float, deadline_s: float
    ) -> tuple[policy_pb2.InferResponse, bool]:
        runtime = self._require_runtime()
        if deadline_s <= started_s:
            raise Refusal(
                Reason.DEADLINE,
                "the deadline had passed when the request arrived: expected time to compute, none "
                "was left; allow more time or send fewer tokens",
            )
        runtime.validator.check_identity(request)
        digest = content_digest(request)
        batcher = runtime.batcher
        ticket = batcher.find(request.session_id, request.step, digest)
        decode_s = 0.0
        policy_request: AnyRequest | None = None
        if ticket is None:
            policy_request = await self._read(runtime, request, deadline_s)
            decode_s = self._clock() - started_s
            self._metrics.step_phase.labels("decode").observe(decode_s)
            # While pictures were decoded, a repeat of this step or a newer one may have come.
            ticket = batcher.find(request.session_id, request.step, digest)
        repeat = ticket is not None
        on_record = ticket is not None and ticket.outcome.done()
        if ticket is None:
            assert policy_request is not None
            ticket = batcher.admit(request.session_id, request.step, policy_request, digest)
        answer = await batcher.wait(ticket, deadline_s)
        response = self._response(request, runtime, answer)
        response.timings.decode_s = decode_s
        if not on_record:  # phases of this call, so that they never exceed its total
            response.timings.queue_s = answer.queue_s
            response.timings.predict_s = answer.predict_s
        response.timings.total_s = self._clock() - started_s
        return response, repeat

    async def _read(
        self, runtime: Runtime, request: policy_pb2.InferRequest, deadline_s: float
    ) -> AnyRequest:
        """Tokens here and now, which takes microseconds; pictures in their own thread."""
        read = partial(runtime.validator.read, request)
        if request.HasField("images"):
            return await runtime.decoding.run(read, deadline_s)
        return read()

    def _response(
        self, request: policy_pb2.InferRequest, runtime: Runtime, answer: Answer
    ) -> policy_pb2.InferResponse:
        horizon, action_dim = answer.actions.shape
        return policy_pb2.InferResponse(
            session_id=request.session_id,
            step=request.step,
            actions=answer.actions.ravel().tolist(),
            action_horizon=horizon,
            action_dim=action_dim,
            tokens_used=answer.tokens_used,
            batch_size=answer.batch_size,
            cloud_flops=answer.cloud_flops,
            load=policy_pb2.LoadHint(
                queue_depth=runtime.batcher.queue_depth, utilization=runtime.batcher.utilization
            ),
            model_fingerprint=runtime.engine.info.fingerprint,
        )

    def _count_arrival(self, request: policy_pb2.InferRequest) -> None:
        """What crossed the link, whatever becomes of it."""
        metrics, payload = self._metrics, request.payload
        metrics.tx_framed_bytes.inc(codec.wire_bytes(request.ByteSize()))
        metrics.tx_encoded_bytes.inc(len(payload))
        if request.HasField("images"):
            metrics.tx_encoded_bytes.inc(request.images.ByteSize())
            metrics.tx_image_bytes.inc(picture_bytes(request.images))
            metrics.tx_payload_bytes.inc(picture_bytes(request.images))
            return
        try:
            header = codec.read_header(payload)
        except CodecError:
            return
        dim, quantization = header.token_dim, header.quantization
        arrived = codec.prefix_tokens(
            len(payload), dim, quantization, num_towers=len(header.tower_dims)
        )
        tokens = min(arrived, header.count)
        metrics.tokens_received.inc(tokens)
        metrics.request_tokens.observe(tokens)
        metrics.tx_payload_bytes.inc(codec.payload_bytes(tokens, dim, quantization))

    def _note_refusal(self, request: policy_pb2.InferRequest, refusal: Refusal) -> None:
        self._metrics.requests_dropped.labels(refusal.reason.value).inc()
        suppressed = self._throttle.allow(refusal.reason.value)
        if suppressed is None:
            return
        _log.info(
            "refused: %s",
            refusal.message,
            extra={
                "reason": refusal.reason.value,
                "session": shown(request.session_id),
                "step": request.step,
                "suppressed": suppressed,
            },
        )
