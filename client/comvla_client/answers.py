"""What a server's answer, or its refusal, means for the robot: act, fall back, or stop and say why."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from comvla.errors import (
    CodecError,
    ComVLAError,
    HandshakeError,
    InstructionError,
    ModelChangedError,
    ObservationError,
)
from comvla.model_info import ModelInfo
from comvla.v1.policy_pb2 import InferRequest, InferResponse
from comvla_client.errors import TransportError
from comvla_client.report import FallbackReason, Load, StepReport

# A link or a server that may be better at the next step.
_FALLBACKS: dict[str, FallbackReason] = {
    "UNAVAILABLE": "unavailable",
    "DEADLINE_EXCEEDED": "deadline",
    "RESOURCE_EXHAUSTED": "overloaded",
    "ABORTED": "rejected",
    "INTERNAL": "rejected",
    "UNKNOWN": "rejected",
    "CANCELLED": "rejected",
    "DATA_LOSS": "rejected",
    # At the start these raise. Later a token was revoked, or is being renewed: the robot holds, and
    # goes on by itself when it is let in again.
    "UNAUTHENTICATED": "unauthorized",
    "PERMISSION_DENIED": "unauthorized",
}
# gRPC's words and the server's for a message that is too large, which no waiting makes smaller.
_OVERSIZE = ("larger than max", "request of at most")
# The server's words for what it could not accept, most telling first.
_INVALID: tuple[tuple[str, type[ComVLAError]], ...] = (
    ("propriocep", ObservationError),
    ("picture", ObservationError),
    ("instruction", InstructionError),
    ("payload", CodecError),
    ("token", CodecError),
)


def fallback_reason(error: TransportError) -> FallbackReason:
    """Why the robot goes on without an answer.

    Args:
        error: how the call ended.

    Raises:
        HandshakeError: the server runs another protocol, or none of ours: no later step can succeed,
            so holding would be for ever. ModelChangedError: another model.
        ObservationError, InstructionError, CodecError: the server found the request invalid.
    """
    if any(words in error.message for words in _OVERSIZE):
        raise HandshakeError(
            f"the message cap on the way to the server is too small ({error.message}): raise it on "
            "the server, send fewer tokens, or use a coarser quantization"
        ) from error
    if error.code in _FALLBACKS:
        return _FALLBACKS[error.code]
    if error.code == "INVALID_ARGUMENT":
        words = error.message.lower()
        wrong = next((kind for word, kind in _INVALID if word in words), HandshakeError)
        raise wrong(f"the server refused the request: {error.message}") from error
    kind = ModelChangedError if error.code == "FAILED_PRECONDITION" else HandshakeError
    raise kind(
        f"the server cannot serve this robot any more ({error.code}): {error.message}. "
        "It may have been restarted with another model: load the edge half of the checkpoint that "
        "it runs, and make a new client"
    ) from error


def read_actions(
    response: InferResponse, request: InferRequest, info: ModelInfo
) -> npt.NDArray[np.float32]:
    """The chunk (H, A) float32 of an answer that a robot may execute.

    Raises:
        HandshakeError: the answer comes from another model.
        TransportError: the answer belongs to another step or holds values that are not finite; a
            later one may be good.
    """
    if response.model_fingerprint and response.model_fingerprint != info.fingerprint:
        raise ModelChangedError(
            f"expected an answer of {info.name} (fingerprint {info.fingerprint}), got one of "
            f"fingerprint {response.model_fingerprint}: load the edge half of the checkpoint that "
            "the server runs"
        )
    if (response.session_id, response.step) != (request.session_id, request.step):
        raise TransportError(
            "DATA_LOSS",
            f"expected the answer to step {request.step} of {request.session_id}, got step "
            f"{response.step} of {response.session_id}: is a proxy mixing calls?",
        )
    shape = (response.action_horizon, response.action_dim)
    expected = (info.action_horizon, info.action_dim)
    if shape != expected or len(response.actions) != shape[0] * shape[1]:
        raise HandshakeError(
            f"expected a chunk of {expected} actions ({info.name}), got {len(response.actions)} "
            f"values of shape {shape}: the server's model does not match its own description"
        )
    actions = np.array(response.actions, dtype=np.float32).reshape(shape)
    if not np.isfinite(actions).all():
        raise TransportError("DATA_LOSS", "the answer holds actions that are not finite")
    return actions


def answered(report: StepReport, response: InferResponse) -> StepReport:
    """The report of a step with what the server says of its answer.

    Args:
        report: of the step, closed.
        response: the answer to it.
    """
    timings, load = response.timings, response.load
    return replace(
        report,
        source="cloud",
        tokens_used=response.tokens_used,
        server_timings_s={
            "decode": timings.decode_s,
            "queue": timings.queue_s,
            "predict": timings.predict_s,
            "total": timings.total_s,
        },
        batch_size=response.batch_size,
        cloud_flops=response.cloud_flops,
        load=Load(
            queue_depth=load.queue_depth,
            utilization=load.utilization,
            suggested_tokens=load.suggested_tokens,
        ),
    )
