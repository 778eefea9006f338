"""The token codec: visual tokens to bytes and back, and exactly what those bytes cost.

Tokens are laid out most important first, each with its position in the unpruned sequence and,
where values are quantised, its own scales. A record depends on no other record, so every prefix of
a payload is a valid, smaller payload: what a fading link lets through can be used.

* :func:`encode`, :func:`decode`, :func:`read_header`: the payload itself (:mod:`.layout` has the
  byte layout, :mod:`.quantizers` the number formats and their error bounds);
* :func:`payload_bytes`: the paper's accounting, ``K * D * B / 8``;
* :func:`encoded_bytes`, :func:`prefix_tokens`: the size of what :func:`encode` writes, and its
  inverse for a cut payload;
* :func:`infer_request_bytes`, :func:`wire_bytes`, :func:`request_wire_bytes`: the same up to the
  socket and, where asked, the IP layer;
* :func:`piece_ends`, :func:`progressive_wire_bytes`: where a stream of pieces is cut, and what it
  costs up to each cut;
* :data:`GRPC_OPTIONS`: channel options under which the framing is the one accounted for.
"""

from comvla.codec.accounting import encoded_bytes, payload_bytes, prefix_tokens
from comvla.codec.layout import MAX_TOKENS, MAX_TOWERS, PayloadHeader, read_header
from comvla.codec.quantizers import QUANTIZATIONS, bits_per_value
from comvla.codec.streaming import (
    piece_ends,
    progressive_head_bytes,
    progressive_piece_bytes,
    progressive_wire_bytes,
    tokens_per_piece,
)
from comvla.codec.tokens import decode, encode
from comvla.codec.wire import (
    CALL_HEADERS_BYTES,
    GRPC_OPTIONS,
    HTTP2_END_BYTES,
    HTTP2_FRAME_BYTES,
    infer_request_bytes,
    request_wire_bytes,
    wire_bytes,
)

__all__ = [
    "CALL_HEADERS_BYTES",
    "GRPC_OPTIONS",
    "HTTP2_END_BYTES",
    "HTTP2_FRAME_BYTES",
    "MAX_TOKENS",
    "MAX_TOWERS",
    "QUANTIZATIONS",
    "PayloadHeader",
    "bits_per_value",
    "decode",
    "encode",
    "encoded_bytes",
    "infer_request_bytes",
    "payload_bytes",
    "piece_ends",
    "prefix_tokens",
    "progressive_head_bytes",
    "progressive_piece_bytes",
    "progressive_wire_bytes",
    "read_header",
    "request_wire_bytes",
    "tokens_per_piece",
    "wire_bytes",
]
