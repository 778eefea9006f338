"""What the doctor sends: uploads that are refused without costing compute, and a few real queries."""

from __future__ import annotations

import os
import secrets
import time

import numpy as np

from comvla import codec
from comvla.model_info import PROTOCOL_VERSION, ModelInfo
from comvla.v1.policy_pb2 import InferRequest, InferResponse
from comvla_client.errors import TransportError
from comvla_client.transport_protocol import Transport

SESSION = "comvla-doctor"

# A server that is busy or asks who calls may answer before it has read the upload, so only these
# tell that all of it arrived.
_READ_AND_REFUSED = ("FAILED_PRECONDITION", "INVALID_ARGUMENT")


def upload_request(size_bytes: int) -> InferRequest:
    """A request of about so many bytes that every server refuses, once it has read it.

    Its fingerprint is that of no model, which is compared before anything costs compute. The payload
    is random, so nothing on the way can shrink it.
    """
    return InferRequest(
        session_id=SESSION,
        protocol_version=PROTOCOL_VERSION,
        model_fingerprint=SESSION,
        payload=os.urandom(size_bytes),
    )


def upload_s(transport: Transport, request: InferRequest, timeout_s: float) -> float:
    """Seconds until a server has read an upload and its refusal is back.

    Raises:
        TransportError: it was not read, or not in time.
    """
    began = time.perf_counter()
    try:
        transport.infer(request, timeout_s)
    except TransportError as error:
        if error.code not in _READ_AND_REFUSED:
            raise
    return time.perf_counter() - began


def wire_bytes(request: InferRequest) -> int:
    """What an upload puts on the socket."""
    return codec.wire_bytes(request.ByteSize())


def query_request(
    model: ModelInfo, instruction: str, quantization: str, step: int = 0
) -> InferRequest:
    """A real query: one token of zeros. The answer means nothing; its timings do."""
    tokens = np.zeros((1, model.token_dim), np.float32)
    return InferRequest(
        session_id=f"{SESSION}.{secrets.token_hex(4)}",
        step=step,
        instruction=instruction,
        proprio=[0.0] * model.proprio_dim,
        payload=codec.encode(tokens, [0], quantization, tower_dims=model.tower_dims),
        model_fingerprint=model.fingerprint,
        protocol_version=PROTOCOL_VERSION,
    )


def query(
    transport: Transport, request: InferRequest, timeout_s: float
) -> tuple[InferResponse, float]:
    """The answer to a query, and the seconds that it took.

    Raises:
        TransportError: no answer, and why.
    """
    began = time.perf_counter()
    answer = transport.infer(request, timeout_s)
    return answer, time.perf_counter() - began
