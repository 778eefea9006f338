"""A whole request answered by a model: screened, read, queued, and put into a message."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from comvla.v1 import policy_pb2
from comvla_server.accounts import Answered
from comvla_server.calls import this_call
from comvla_server.memory import Lease
from comvla_server.metrics import Metrics
from comvla_server.models import Runtime
from comvla_server.refusals import Reason, Refusal
from comvla_server.tickets import Answer
from comvla_server.tracing import current_trace
from comvla_server.traffic import announced_tokens, decoded_bytes
from comvla_server.validation import content_digest
from comvla_vla.request import AnyRequest


class Answering:
    """Answers requests with a model. Used from one event loop only.

    Args:
        metrics: where phases and answers are counted.
        clock: monotonic seconds.
    """

    def __init__(self, metrics: Metrics, clock: Callable[[], float]) -> None:
        self._metrics = metrics
        self._clock = clock

    async def answer(
        self,
        runtime: Runtime,
        request: policy_pb2.InferRequest,
        lease: Lease,
        started_s: float,
        deadline_s: float,
        digest: bytes | None = None,
    ) -> Answered:
        """Actions for one observation, from the record where the same was asked before.

        Args:
            runtime: the model; the call is one of its users.
            request: with all of the payload that came.
            lease: of the call, for what its content takes when it is decoded.
            started_s: monotonic time at which the call came.
            deadline_s: monotonic time after which the answer is of no use.
            digest: fingerprint of the content, by which a repeat is known; None computes it.

        Raises:
            Refusal: no actions, and why.
        """
        if deadline_s <= started_s:
            raise Refusal(
                Reason.DEADLINE,
                "the deadline had passed when the request arrived: expected time to compute, none "
                "was left; allow more time or send fewer tokens",
            )
        runtime.validator.check_identity(request)
        batcher = runtime.batcher
        pictures = request.HasField("images")
        most = runtime.engine.info.num_tokens
        tokens = most if pictures else min(most, announced_tokens(request.payload))
        if tokens:  # else it is no observation, and will be told so
            batcher.screen(request.session_id, request.step, tokens, deadline_s, pictures=pictures)
        if digest is None:
            digest = content_digest(request)
        ticket = batcher.find(request.session_id, request.step, digest)
        decode_began_s, decode_s = self._clock(), 0.0
        policy_request: AnyRequest | None = None
        if ticket is None:
            lease.take(decoded_bytes(request))
            policy_request = await self._read(runtime, request, deadline_s)
            this_call().note_read(policy_request, runtime.engine.info)
            decode_s = self._clock() - decode_began_s
            self._metrics.step_phase.labels("decode").observe(decode_s)
            # While pictures were decoded, a repeat of this step or a newer one may have come.
            ticket = batcher.find(request.session_id, request.step, digest)
        repeat = ticket is not None
        on_record = ticket is not None and ticket.outcome.done()
        if ticket is None:
            assert policy_request is not None
            if request.HasField("snr_db"):
                self._metrics.reported_snr_db.observe(request.snr_db)
            ticket = batcher.admit(
                request.session_id, request.step, policy_request, digest, deadline_s
            )
        answer = await batcher.wait(ticket, deadline_s)
        finished_s = self._clock()
        self._metrics.model_requests.labels(runtime.label, "repeat" if repeat else "ok").inc()
        response = _response(request, runtime, answer)
        response.timings.decode_s = decode_s
        if not on_record:  # phases of this call, so that they never exceed its total
            response.timings.queue_s = answer.queue_s
            response.timings.predict_s = answer.predict_s
        response.timings.total_s = self._clock() - started_s
        if (trace := current_trace()) is not None:
            trace.answered(
                request,
                answer,
                model=runtime.label,
                decoded_s=(decode_began_s, decode_began_s + decode_s),
                admitted_s=ticket.admitted_s,
                finished_s=finished_s,
                encoded_s=self._clock(),
                repeat=repeat,
            )
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
    request: policy_pb2.InferRequest, runtime: Runtime, answer: Answer
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
            queue_depth=runtime.batcher.queue_depth,
            utilization=runtime.batcher.utilization,
            suggested_tokens=runtime.batcher.suggested_tokens,
        ),
        # Checked: the model's own, or that of one with the same edge half.
        model_fingerprint=request.model_fingerprint,
    )
