"""What a refusal is on the wire: a gRPC status, and trailing metadata with what may be done about it."""

from __future__ import annotations

import grpc

from comvla.load_hints import LoadHints
from comvla_server.refusals import Reason, Refusal

STATUS = {
    Reason.MALFORMED: grpc.StatusCode.INVALID_ARGUMENT,
    Reason.INVALID: grpc.StatusCode.INVALID_ARGUMENT,
    Reason.CONFLICT: grpc.StatusCode.INVALID_ARGUMENT,
    Reason.UNKNOWN_MODEL: grpc.StatusCode.NOT_FOUND,
    Reason.MISMATCH: grpc.StatusCode.FAILED_PRECONDITION,
    Reason.OVERSIZE: grpc.StatusCode.RESOURCE_EXHAUSTED,
    Reason.OVERLOAD: grpc.StatusCode.RESOURCE_EXHAUSTED,
    Reason.PREDICTED_LATE: grpc.StatusCode.RESOURCE_EXHAUSTED,
    Reason.CONGESTED: grpc.StatusCode.RESOURCE_EXHAUSTED,
    Reason.FAIR_SHARE: grpc.StatusCode.RESOURCE_EXHAUSTED,
    Reason.SHORT: grpc.StatusCode.DEADLINE_EXCEEDED,
    Reason.KEY_FRAME: grpc.StatusCode.ABORTED,
    Reason.SUPERSEDED: grpc.StatusCode.ABORTED,
    Reason.DEADLINE: grpc.StatusCode.DEADLINE_EXCEEDED,
    Reason.CANCELLED: grpc.StatusCode.CANCELLED,
    Reason.LOADING: grpc.StatusCode.UNAVAILABLE,
    Reason.DRAINING: grpc.StatusCode.UNAVAILABLE,
    Reason.MODEL: grpc.StatusCode.INTERNAL,
    Reason.NO_IDENTITY: grpc.StatusCode.UNAUTHENTICATED,
    Reason.NOT_OWNER: grpc.StatusCode.PERMISSION_DENIED,
    Reason.RATE: grpc.StatusCode.RESOURCE_EXHAUSTED,
    Reason.SLOW: grpc.StatusCode.DEADLINE_EXCEEDED,
}


def hints(refusal: Refusal) -> tuple[tuple[str, str], ...]:
    """Trailing metadata of a refusal: what the robot may do about it."""
    return LoadHints(refusal.retry_after_s, refusal.suggested_tokens).to_metadata()
