"""The handshake: what robot and server must agree on before the robot moves."""

from __future__ import annotations

from comvla import codec, handshake
from comvla.errors import HandshakeError
from comvla.model_info import ModelInfo
from comvla.v1.policy_pb2 import GetModelResponse


def check_server(
    response: GetModelResponse,
    edge: ModelInfo,
    *,
    quantization: str,
    most_tokens: int,
    progressive: bool = False,
) -> ModelInfo:
    """Compares the server's model and limits with what this robot is going to send.

    Args:
        response: the server's description of itself.
        edge: the robot's half.
        quantization: how the robot codes token values.
        most_tokens: the most tokens that any of its requests may hold.
        progressive: whether the robot sends its payloads in pieces.

    Returns:
        The model that the server runs.

    Raises:
        HandshakeError: the first difference in words, with its remedy.
    """
    cloud = handshake.from_response(response)
    difference = handshake.mismatch(edge, cloud)
    if difference is not None:
        raise HandshakeError(difference)
    offered = handshake.offered_quantizations(response)
    difference = handshake.quantization_mismatch(quantization, offered)
    if difference is not None:
        raise HandshakeError(difference)
    if progressive and not response.progressive:
        raise HandshakeError(
            f"client sends payloads in pieces, server {response.server_version or 'of no version'} "
            "has no InferProgressive: update the server, or choose sending='margin'"
        )
    largest_bytes = codec.request_wire_bytes(
        most_tokens, edge.token_dim, quantization, num_towers=len(edge.tower_dims)
    )
    if response.max_request_bytes and largest_bytes > response.max_request_bytes:
        raise HandshakeError(
            f"server reads requests of at most {response.max_request_bytes} bytes, {most_tokens} "
            f"{quantization} tokens take {largest_bytes}: raise the server's cap, fix a smaller "
            "budget, or use a coarser quantization"
        )
    return cloud
