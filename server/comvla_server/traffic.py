"""What calls bring: counted, and read off a payload's header before anything is decoded."""

from __future__ import annotations

from comvla import codec
from comvla.errors import CodecError
from comvla.images import MAX_VIEW_PIXELS, coding_name, picture_bytes
from comvla.v1 import policy_pb2
from comvla_server.calls import this_call
from comvla_server.metrics import Metrics


class Traffic:
    """Counts bytes and tokens, in the metrics and in the record of the call.

    Args:
        metrics: where they are counted.
    """

    def __init__(self, metrics: Metrics) -> None:
        self._metrics = metrics

    def count_message(self, size_bytes: int) -> None:
        """What crossed the link, whatever becomes of it."""
        wire_bytes = codec.wire_bytes(size_bytes)
        self._metrics.tx_framed_bytes.inc(wire_bytes)
        this_call().wire_bytes += wire_bytes

    def count_content(self, request: policy_pb2.InferRequest) -> None:
        """Tokens or pictures of a whole request."""
        self.count_payload(request.payload)
        if request.HasField("images"):
            file_bytes = picture_bytes(request.images)
            self._metrics.tx_encoded_bytes.inc(request.images.ByteSize())
            self._metrics.tx_image_bytes.inc(file_bytes)
            self._metrics.tx_payload_bytes.inc(file_bytes)
            this_call().note_content(file_bytes, coding_name(request.images.coding) or "")

    def count_payload(self, payload: bytes | bytearray) -> None:
        """A payload of tokens, or as much of it as came."""
        metrics = self._metrics
        metrics.tx_encoded_bytes.inc(len(payload))
        announced = _announced(payload)
        if announced is None:
            return
        header, tokens = announced
        metrics.tokens_received.inc(tokens)
        metrics.request_tokens.observe(tokens)
        paper_bytes = codec.payload_bytes(tokens, header.token_dim, header.quantization)
        metrics.tx_payload_bytes.inc(paper_bytes)
        this_call().note_content(paper_bytes, header.quantization)


def announced_tokens(payload: bytes) -> int:
    """Tokens that a payload holds, by its header; 0 where it is no payload."""
    announced = _announced(payload)
    return 0 if announced is None else announced[1]


def decoded_bytes(request: policy_pb2.InferRequest) -> int:
    """What tokens take as float32, and what pictures that may be decoded take."""
    pixels = sum(min(v.height * v.width, MAX_VIEW_PIXELS) for v in request.images.views)
    announced = _announced(request.payload)
    values = 0 if announced is None else announced[1] * announced[0].token_dim
    return 3 * pixels + 4 * values


def _announced(payload: bytes | bytearray) -> tuple[codec.PayloadHeader, int] | None:
    """Header, and whole tokens that came; None where it is no payload."""
    try:
        header = codec.read_header(payload)
    except CodecError:
        return None
    arrived = codec.prefix_tokens(
        len(payload), header.token_dim, header.quantization, num_towers=len(header.tower_dims)
    )
    return header, min(arrived, header.count)
