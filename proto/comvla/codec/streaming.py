"""A payload in pieces: where ``InferProgressive`` cuts it, and what the stream costs on the wire.

Each piece is a message of its own, about :data:`PIECE_OVERHEAD_BYTES` more than its bytes, and is
lost whole where the link ends inside it. Small pieces pay for many messages, large ones for what
the last, unfinished one held; :func:`tokens_per_piece` balances the two.
"""

from __future__ import annotations

import math
from itertools import pairwise

from comvla.codec.accounting import encoded_bytes
from comvla.codec.wire import HTTP2_END_BYTES, varint_bytes, wire_bytes
from comvla.errors import CodecError

PIECE_OVERHEAD_BYTES = 18
"""Frame header, gRPC prefix, and tag and length of the ``piece`` field, up to 16 KiB."""

_TAG_BYTES = 1  # every field number of both messages is below 16
_FLOAT_BYTES = 4


def tokens_per_piece(
    link_bytes: float, token_dim: int, quantization: str, *, num_towers: int = 1
) -> int:
    """Tokens in a piece for a link that is expected to carry ``link_bytes`` before it is cut.

    A cut costs half a piece of p bytes on average, and C/p pieces cost their overhead h each; the
    sum is least at p = √(2·h·C).

    Raises:
        CodecError: see :func:`comvla.codec.encoded_bytes`.
    """
    start = encoded_bytes(0, token_dim, quantization, num_towers=num_towers)
    record = encoded_bytes(1, token_dim, quantization, num_towers=num_towers) - start
    best = math.sqrt(2.0 * PIECE_OVERHEAD_BYTES * max(0.0, link_bytes))
    return max(1, round(best / record))


def piece_ends(
    k: int,
    token_dim: int,
    quantization: str,
    *,
    num_towers: int = 1,
    first_tokens: int = 1,
    piece_tokens: int = 1,
) -> list[int]:
    """Where the pieces of a payload of ``k`` tokens end, each after a whole token, in bytes.

    Args:
        k: tokens in the payload, at least one.
        token_dim: D.
        quantization: a name of :data:`comvla.codec.QUANTIZATIONS`.
        num_towers: vision towers whose features are concatenated.
        first_tokens: tokens of the first piece, which also holds the payload's header: what is
            useless in part need not be cut.
        piece_tokens: tokens of each further piece.

    Raises:
        CodecError: numbers below 1, or see :func:`comvla.codec.encoded_bytes`.
    """
    if min(k, first_tokens, piece_tokens) < 1:
        raise CodecError(
            f"expected k, first_tokens and piece_tokens of at least 1, got {k}, {first_tokens} and "
            f"{piece_tokens}"
        )
    start = encoded_bytes(0, token_dim, quantization, num_towers=num_towers)
    record = encoded_bytes(1, token_dim, quantization, num_towers=num_towers) - start
    return [start + n * record for n in (*range(min(k, first_tokens), k, piece_tokens), k)]


def progressive_head_bytes(request_bytes: int, *, window_s: float, min_tokens: int) -> int:
    """Exact serialised length of the first message of a stream.

    Args:
        request_bytes: length of its ``InferRequest``, which has no payload.
        window_s: as in the head.
        min_tokens: as in the head.
    """
    head = _TAG_BYTES + varint_bytes(request_bytes) + request_bytes
    head += (_TAG_BYTES + _FLOAT_BYTES) * (window_s != 0.0)
    head += (_TAG_BYTES + varint_bytes(min_tokens)) * (min_tokens != 0)
    return _TAG_BYTES + varint_bytes(head) + head


def progressive_piece_bytes(length: int) -> int:
    """Exact serialised length of a message that holds ``length`` bytes of the payload."""
    return _TAG_BYTES + varint_bytes(length) + length


def progressive_wire_bytes(head_bytes: int, ends: list[int]) -> list[int]:
    """Bytes of DATA frames up to the end of each piece.

    gRPC writes every message of a stream in frames of its own, and the end of the stream in an
    empty one, which the last figure includes. Messages that wait for the socket together may share
    a frame: the truth is then lower by up to 9 bytes each.

    Args:
        head_bytes: length of the first message, see :func:`progressive_head_bytes`.
        ends: where pieces end in the payload, see :func:`piece_ends`.

    Returns:
        As many numbers as ``ends`` has, increasing.
    """
    spent, costs = wire_bytes(head_bytes), []
    for start, end in pairwise([0, *ends]):
        spent += wire_bytes(progressive_piece_bytes(end - start))
        costs.append(spent)
    if costs:
        costs[-1] += HTTP2_END_BYTES
    return costs
