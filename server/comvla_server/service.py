"""``comvla.v1.PolicyService``: from a message to a status or a chunk of actions."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import AbstractContextManager
from typing import Any

import grpc

from comvla import codec, handshake
from comvla.v1 import policy_pb2, policy_pb2_grpc
from comvla_server.accounts import Answered, CallAccounts
from comvla_server.answering import Answering
from comvla_server.calls import CallRecord
from comvla_server.fleet import Fleet
from comvla_server.lifecycle import Lifecycle
from comvla_server.memory import BytesInFlight, Lease
from comvla_server.metrics import Metrics
from comvla_server.models import Models, Runtime
from comvla_server.piecewise import PieceReader
from comvla_server.refusals import Reason, Refusal
from comvla_server.screening import Screening
from comvla_server.settings import ServerSettings
from comvla_server.statuses import STATUS, hints
from comvla_server.tracing import Tracing
from comvla_server.traffic import Traffic
from comvla_server.validation import content_digest
from comvla_server.version import server_version


class PolicyService(policy_pb2_grpc.PolicyServiceServicer):
    """Validates, queues, answers. One instance lives on one event loop.

    Args:
        lifecycle: whether calls are welcome.
        metrics: where calls are counted.
        settings: limits and the default deadline.
        fleet: where people see calls.
        clock: monotonic seconds.
        tracing: makes traces; None makes none.

    Attributes:
        models: what answers, by name; empty while loading.
        screening: whether calls are worth reading.
        fleet: what robots did lately.
    """

    def __init__(
        self,
        lifecycle: Lifecycle,
        metrics: Metrics,
        settings: ServerSettings,
        fleet: Fleet | None = None,
        clock: Callable[[], float] = time.monotonic,
        tracing: Tracing | None = None,
    ) -> None:
        self._tracing = tracing
        self.models = Models()
        self._lifecycle = lifecycle
        self._metrics = metrics
        self._traffic = Traffic(metrics)
        self._settings = settings
        self._clock = clock
        self.screening = Screening(self.models, settings.admission, clock)
        self.fleet = fleet or Fleet()
        self._accounts = CallAccounts(metrics, self.fleet, settings.default_deadline_s, clock)
        self._answering = Answering(metrics, clock)
        self._in_flight = BytesInFlight(settings.max_bytes_in_flight)
        metrics.watch_bytes(lambda: self._in_flight.held)

    @property
    def runtime(self) -> Runtime | None:
        """The default model behind its queue, None while loading."""
        return self.models.default

    @property
    def idle(self) -> asyncio.Event:
        """Set while no call for actions is open."""
        return self._accounts.idle

    async def GetModel(
        self, request: policy_pb2.GetModelRequest, context: grpc.aio.ServicerContext[Any, Any]
    ) -> policy_pb2.GetModelResponse:
        """Describes the model, to any protocol version: the robot says what differs."""
        try:
            runtime = self._find(request.model)
        except Refusal as refusal:
            await context.abort(STATUS[refusal.reason], refusal.message)
        return handshake.to_response(
            runtime.engine.info,
            quantizations=codec.QUANTIZATIONS,
            max_request_bytes=self._settings.max_request_bytes,
            server_version=server_version(),
            progressive=True,
            image_codings=runtime.engine.image_codings,
            run_options=runtime.engine.run_options,
            edge_fingerprints=sorted(runtime.validator.also),
        )

    async def Infer(
        self, request: policy_pb2.InferRequest, context: grpc.aio.ServicerContext[Any, Any]
    ) -> policy_pb2.InferResponse:
        """Actions for one observation, or a status that says why not."""
        try:
            with self._traced("Infer", context):
                return await self.infer(request, context.time_remaining())
        except Refusal as refusal:
            await context.abort(STATUS[refusal.reason], refusal.message, hints(refusal))

    async def InferProgressive(
        self, messages: AsyncIterator[Any], context: grpc.aio.ServicerContext[Any, Any]
    ) -> policy_pb2.InferProgressiveResponse:
        """Actions for as much of one observation as came in time, or a status that says why not."""
        try:
            with self._traced("InferProgressive", context):
                response = await self.infer_progressive(messages, context.time_remaining())
        except Refusal as refusal:
            await context.abort(STATUS[refusal.reason], refusal.message, hints(refusal))
        return policy_pb2.InferProgressiveResponse(response=response)

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

        async def work(started_s: float, deadline_s: float) -> Answered:
            self._traffic.count_message(request.ByteSize())
            self._traffic.count_content(request)
            with self._in_flight.lease() as lease:
                lease.take(request.ByteSize())
                runtime = self._find(request.model)
                with self._using(runtime):
                    return await self._answering.answer(
                        runtime, request, lease, started_s, deadline_s
                    )

        answer = self._accounts.run(request, time_remaining_s, work)
        return await self.screening.watched(answer, request, time_remaining_s)

    async def infer_progressive(
        self, messages: AsyncIterator[Any], time_remaining_s: float | None
    ) -> policy_pb2.InferResponse:
        """:meth:`InferProgressive` without a transport.

        A repeat is known by its head, whatever prefix of its payload came the first time: it is
        answered from the record, and its pieces are not waited for.

        Args:
            messages: parsed messages in order.
            time_remaining_s: seconds until the caller gives up, None where it did not say.

        Raises:
            Refusal: no actions, and why.
        """
        request = policy_pb2.InferRequest()  # becomes the one that Infer would have got

        async def work(started_s: float, deadline_s: float) -> Answered:
            with self._in_flight.lease() as lease:
                return await self._answer_stream(request, messages, lease, started_s, deadline_s)

        answer = self._accounts.run(request, time_remaining_s, work)
        return await self.screening.watched(answer, request, time_remaining_s)

    def _traced(
        self, method: str, context: grpc.aio.ServicerContext[Any, Any]
    ) -> AbstractContextManager[None]:
        if self._tracing is None:
            return contextlib.nullcontext()
        return self._tracing.call(method, context.invocation_metadata())

    def note_malformed(self, size_bytes: int) -> Refusal:
        """Counts bytes that are no InferRequest, and says so."""
        refusal = Refusal(
            Reason.MALFORMED,
            f"expected a comvla.v1.InferRequest, got {size_bytes} bytes that do not parse as one: "
            "build requests from the contract's generated code",
        )
        self._traffic.count_message(size_bytes)
        nobodys = policy_pb2.InferRequest()
        self._accounts.note_refusal(nobodys, refusal)
        call = CallRecord(wire_bytes=codec.wire_bytes(size_bytes))
        self.fleet.note(nobodys, call, refusal.reason.value, None)
        return refusal

    def _find(self, model: str) -> Runtime:
        """The model that a call asks for. While it is at work it is one of its users."""
        self._lifecycle.require_ready()
        return self.models.find(model)

    @contextlib.contextmanager
    def _using(self, runtime: Runtime) -> Iterator[None]:
        """Around the work of a model for one call."""
        with runtime.users.one():
            try:
                yield
            except BaseException:
                self._metrics.model_requests.labels(runtime.label, "refused").inc()
                raise

    async def _answer_stream(
        self,
        request: policy_pb2.InferRequest,
        messages: AsyncIterator[Any],
        lease: Lease,
        started_s: float,
        deadline_s: float,
    ) -> Answered:
        self._lifecycle.require_ready()

        def note(message: policy_pb2.InferProgressiveRequest) -> None:
            size = message.ByteSize()
            self._traffic.count_message(size)
            lease.take(size)

        reader = PieceReader(messages, note, self._clock)
        with contextlib.ExitStack() as held:
            try:
                patience_s = min(deadline_s - started_s, self._settings.default_deadline_s)
                head = await reader.head(patience_s)
                request.CopyFrom(head.request)
                runtime = self._find(request.model)
                held.enter_context(self._using(runtime))
                reader.expect(runtime.engine.info, head.min_tokens)
                runtime.validator.check_head(request)
                digest = content_digest(request)
                if runtime.batcher.find(request.session_id, request.step, digest) is not None:
                    reader.ending = "repeat"
                else:
                    headed_s = self._clock()
                    window_s = min(head.window_s, deadline_s - headed_s)
                    request.payload = await reader.collect(window_s)
                    self._metrics.step_phase.labels("collect").observe(self._clock() - headed_s)
            finally:
                self._traffic.count_payload(reader.payload)
                self._metrics.streams.labels(reader.ending).inc()
            return await self._answering.answer(
                runtime, request, lease, started_s, deadline_s, digest
            )
