"""What a request takes up on the radio, in bytes, and what of it is left where fewer cross."""

from __future__ import annotations

import bisect

from comvla import codec
from comvla.errors import LinkError
from comvla.v1.policy_pb2 import ImageCoding, InferRequest
from comvla_client import LinkProfile
from comvla_client.streaming import PayloadStream

COUNTS = ("framed", "encoded")
"""Every byte of a call on the wire (protobuf, gRPC, HTTP/2 frames and headers); the coded payload alone."""

_ANALOGUE = (ImageCoding.IMAGE_CODING_DEEP_JSCC, ImageCoding.IMAGE_CODING_WITT)


class RadioCosts:
    """Counts bytes that take up capacity.

    Args:
        link: bandwidth and period of the radio, by which analogue symbols are charged.
        count: what is counted, one of :data:`COUNTS`.

    Raises:
        LinkError: an unknown count.
    """

    def __init__(self, link: LinkProfile, count: str) -> None:
        if count not in COUNTS:
            raise LinkError(f"count must be one of {', '.join(COUNTS)}, got {count!r}")
        self._link = link
        self._count = count

    @property
    def end_bytes(self) -> int:
        """Bytes on the radio that end a stream of pieces and carry nothing of them."""
        return codec.HTTP2_END_BYTES * (self._count == "framed")

    def request_bytes(self, request: InferRequest, payload_length: int) -> int:
        """Bytes on the radio for a request with tokens.

        Args:
            request: the request; its frame is counted.
            payload_length: bytes that are sent of its payload.
        """
        if self._count == "encoded":
            return payload_length
        message = codec.infer_request_bytes(
            payload_length,
            session_id=request.session_id,
            step=request.step,
            instruction=request.instruction,
            proprio_dim=len(request.proprio),
            model_fingerprint=request.model_fingerprint,
            snr=request.HasField("snr_db"),
            snr_age=request.HasField("snr_age_s"),
            protocol_version=request.protocol_version,
            model=request.model,
        )
        return codec.wire_bytes(message) + codec.CALL_HEADERS_BYTES

    def piece_bytes(self, stream: PayloadStream) -> list[int]:
        """Bytes on the radio up to the end of each piece."""
        if self._count == "encoded":
            return list(stream.ends)
        return [codec.CALL_HEADERS_BYTES + cost for cost in stream.costs()]

    def fitting_payload_bytes(self, request: InferRequest, room_bytes: int) -> int:
        """Length of the longest prefix of the payload that fits; 0 where not even the rest does."""
        fitting = bisect.bisect_right(
            range(len(request.payload)),
            room_bytes,
            key=lambda kept: self.request_bytes(request, kept),
        )
        return max(0, fitting - 1)

    def pictures_bytes(self, request: InferRequest, capacity_bits: float) -> int:
        """Bytes on the radio for a request with pictures.

        An analogue symbol is one use of the channel, W·T of which make a period: it is charged as the
        bytes that would take as long at the SNR of the period, everything else as it is.

        Args:
            request: the request.
            capacity_bits: what the link carries in the period.
        """
        images = request.images
        cost = images.ByteSize()
        if self._count == "framed":
            cost = codec.wire_bytes(request.ByteSize()) + codec.CALL_HEADERS_BYTES
        if images.coding not in _ANALOGUE:
            return cost
        from comvla_vla.codecs.waveform import channel_uses

        uses = sum(channel_uses(view.data) for view in images.views)
        share = uses / (self._link.bandwidth_hz * self._link.period_s)
        digital = cost - sum(len(view.data) for view in images.views)
        return digital + int(share * capacity_bits / 8)


def whole_tokens(header: codec.PayloadHeader, length: int) -> int:
    """Tokens that arrived whole.

    Args:
        header: of the payload.
        length: bytes that arrived of it.
    """
    arrived = codec.prefix_tokens(
        length, header.token_dim, header.quantization, num_towers=len(header.tower_dims)
    )
    return min(header.count, arrived)
