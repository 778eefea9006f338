"""A radio link that really withholds what does not fit, in simulated time.

:class:`EnforcedLink` sits between a client and the transport that reaches the server. A period of
the link begins when :meth:`EnforcedLink.advance` says so, not when a clock ticks, so a simulation
may run slower or faster than the robot would and the link stays the same.
"""

from __future__ import annotations

import bisect
import itertools
import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any, Literal

from comvla import codec
from comvla.errors import LinkError
from comvla.v1.policy_pb2 import GetModelResponse, InferRequest, InferResponse
from comvla_client import LinkProfile
from comvla_client.errors import TransportError
from comvla_client.transport import Transport

MODES = ("prefix", "drop")
COUNTS = ("framed", "encoded")


@dataclass(frozen=True)
class LinkRecord:
    """What became of one request on the radio link.

    Attributes:
        period: control period in which it was sent, from 0.
        snr_db: true SNR of that period, dB.
        capacity_bits: C_link, what the link carries in the whole period (Eq. (1)).
        available_bits: what earlier requests of the same period left of it.
        offered_bytes: what the robot wanted to send.
        delivered_bytes: what crossed; never more than ``available_bits / 8``.
        offered_tokens: tokens that the robot wanted to send.
        delivered_tokens: tokens that arrived whole, 0 where the request was lost.
        airtime_s: share of the control period that the delivered bytes took, in seconds.
    """

    period: int
    snr_db: float
    capacity_bits: float
    available_bits: float
    offered_bytes: int
    delivered_bytes: int
    offered_tokens: int
    delivered_tokens: int
    airtime_s: float

    def to_dict(self) -> dict[str, Any]:
        """Plain values for ``json.dumps``; an SNR of −inf becomes the string "-inf"."""
        plain = asdict(self)
        if math.isinf(self.snr_db):
            plain["snr_db"] = "-inf"
        return plain


class EnforcedLink:
    """A transport whose uplink carries no more than the capacity of the current control period.

    A robot that sized its payload by the true SNR loses nothing. One that sent too much, because
    its SNR was old or its accounting left something out, loses the excess: the bytes that arrive
    are a prefix of the payload, which decodes to its most important tokens. The downlink is free.

    Args:
        transport: where requests go once they have crossed the radio.
        channel: SNR in dB of each control period (:mod:`comvla_sim.channel`).
        link: bandwidth, period and efficiency of the radio.
        mode: what happens to a payload that does not fit: ``"prefix"`` cuts it after the last byte
            that does, ``"drop"`` loses it whole.
        count: what takes up capacity: ``"framed"`` is every byte of the call on the wire (protobuf,
            gRPC, HTTP/2 frames and headers); ``"encoded"`` the coded payload alone.

    Attributes:
        log: one record for each request, in order.

    Raises:
        LinkError: an unknown mode or count, or a channel that ends.
    """

    def __init__(
        self,
        transport: Transport,
        channel: Iterable[float],
        link: LinkProfile,
        *,
        mode: Literal["prefix", "drop"] = "prefix",
        count: Literal["framed", "encoded"] = "framed",
    ) -> None:
        if mode not in MODES:
            raise LinkError(f"mode must be one of {', '.join(MODES)}, got {mode!r}")
        if count not in COUNTS:
            raise LinkError(f"count must be one of {', '.join(COUNTS)}, got {count!r}")
        self._transport = transport
        self._values = iter(channel)
        self._link = link
        self._mode = mode
        self._count = count
        self._period = -1
        self.log: list[LinkRecord] = []
        self.advance()

    @property
    def period(self) -> int:
        """The current control period, from 0."""
        return self._period

    @property
    def snr_db(self) -> float:
        """SNR of the current control period in dB; what a perfect modem would report."""
        return self._snr_db

    @property
    def capacity_bits(self) -> float:
        """What the link carries in the current control period, bits."""
        return self._capacity_bits

    def advance(self, periods: int = 1) -> None:
        """Lets control periods pass; whatever capacity was left in them is gone.

        Raises:
            ValueError: fewer than one period.
            LinkError: the channel has no value for the new period.
        """
        if periods < 1:
            raise ValueError(f"expected periods >= 1, got {periods}: time does not run backwards")
        value = next(itertools.islice(self._values, periods - 1, None), None)
        if value is None:
            raise LinkError(
                f"the channel ends before period {self._period + periods}: use one without end "
                "(all of comvla_sim.channel are), or a longer trace"
            )
        self._capacity_bits = self._link.capacity_bits(value)
        self._snr_db = float(value)
        self._period += periods
        self._used_bytes = 0

    def get_model(self, timeout_s: float) -> GetModelResponse:
        """The handshake, which happens before the robot moves and is not limited."""
        return self._transport.get_model(timeout_s)

    def infer(self, request: InferRequest, timeout_s: float) -> InferResponse:
        """Carries what fits of a request, and the answer back.

        Raises:
            TransportError: ``DEADLINE_EXCEEDED`` when no token arrived whole in this period, and
                whatever the wrapped transport raises.
        """
        available_bits = self._capacity_bits - 8 * self._used_bytes
        room_bytes = max(0, int(available_bits // 8))
        offered_bytes = self._cost_bytes(request, len(request.payload))
        kept_bytes = self._fitting_payload_bytes(request, room_bytes)
        header = codec.read_header(request.payload)
        delivered_tokens = min(
            header.count,
            codec.prefix_tokens(
                kept_bytes,
                header.token_dim,
                header.quantization,
                num_towers=len(header.tower_dims),
            ),
        )
        # A request cut before its first whole token still took the air until the period ended.
        delivered_bytes = min(offered_bytes, room_bytes)
        if delivered_tokens:
            delivered_bytes = self._cost_bytes(request, kept_bytes)
        self._used_bytes += delivered_bytes
        share = 8 * delivered_bytes / self._capacity_bits if self._capacity_bits else 1.0
        self.log.append(
            LinkRecord(
                period=self._period,
                snr_db=self._snr_db,
                capacity_bits=self._capacity_bits,
                available_bits=available_bits,
                offered_bytes=offered_bytes,
                delivered_bytes=delivered_bytes,
                offered_tokens=header.count,
                delivered_tokens=delivered_tokens,
                airtime_s=share * self._link.period_s,
            )
        )
        if not delivered_tokens:
            raise TransportError(
                "DEADLINE_EXCEEDED",
                f"the link carried {delivered_bytes} of {offered_bytes} bytes in its period "
                f"({self._snr_db:.1f} dB), no token arrived whole: send fewer tokens",
            )
        if kept_bytes < len(request.payload):
            arrived = InferRequest()
            arrived.CopyFrom(request)
            arrived.payload = request.payload[:kept_bytes]
            request = arrived
        return self._transport.infer(request, timeout_s)

    def close(self) -> None:
        """Closes the wrapped transport."""
        self._transport.close()

    def _fitting_payload_bytes(self, request: InferRequest, room_bytes: int) -> int:
        """Length of the longest prefix of the payload that fits; 0 where not even the rest does."""
        length = len(request.payload)
        if self._cost_bytes(request, length) <= room_bytes:
            return length
        if self._mode == "drop":
            return 0
        fitting = bisect.bisect_right(
            range(length), room_bytes, key=lambda kept: self._cost_bytes(request, kept)
        )
        return max(0, fitting - 1)

    def _cost_bytes(self, request: InferRequest, payload_length: int) -> int:
        """Bytes on the radio for this request with that much of its payload."""
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
        )
        return codec.wire_bytes(message) + codec.CALL_HEADERS_BYTES
