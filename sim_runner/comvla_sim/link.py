"""A radio link that really withholds what does not fit, in simulated time.

:class:`EnforcedLink` sits between a client and the transport that reaches the server. A period of
the link begins when :meth:`EnforcedLink.advance` says so, not when a clock ticks, so a simulation
may run slower or faster than the robot would and the link stays the same.
"""

from __future__ import annotations

import bisect
from collections.abc import Iterable
from typing import Literal

from comvla import codec
from comvla.errors import LinkError
from comvla.v1.policy_pb2 import GetModelResponse, InferRequest, InferResponse
from comvla_client import LinkProfile, SnrReading
from comvla_client.errors import TransportError
from comvla_client.streaming import PayloadStream, periods_of
from comvla_client.transport_protocol import Transport
from comvla_sim.link_records import LinkRecord, PeriodRecord
from comvla_sim.radio import Radio
from comvla_sim.radio_costs import COUNTS, RadioCosts, whole_tokens

__all__ = ["COUNTS", "MODES", "UNENFORCED", "EnforcedLink", "LinkRecord", "PeriodRecord"]

MODES = ("prefix", "drop", "queue")
UNENFORCED = "none"
"""The mode of a link that withholds nothing."""


class EnforcedLink:
    """A transport whose uplink carries no more than the capacity of each control period.

    A robot that sized its payload by the true SNR loses nothing. One that sent too much, because
    its SNR was old or its accounting left something out, meets the mode. The downlink is free, and
    an answer to what arrived before the link profile's reserve begins counts as there in the same
    period.

    An episode drives it so: one action is one period, and ``step`` may take periods of its own,
    during which the robot holds. The link knows the true SNR; what the client is told may be old::

        link = EnforcedLink(transport, channel, profile, mode="queue")
        robot = ComVLAClient(link, edge=edge, link=profile, sending="margin", deadline_s=600.0)
        while not done:
            hold, asked = robot.hold_action, link.period
            chunk = robot.step(observation, words, link.reading(delay_periods=d))
            for _ in range(link.period - asked):     # the answer took so many periods
                world.advance(hold)
            for action in chunk.actions[: max(1, chunk.planned)]:
                link.advance()
                world.advance(action)

    ``deadline_s`` is on the wall clock, where simulated time stands still while a machine computes:
    make it large. Policies that look at times of readings take ``lambda: link.time_s`` as a clock.

    Args:
        transport: where requests go once they have crossed the radio.
        channel: SNR in dB of each control period (:mod:`comvla_sim.channel`).
        link: bandwidth, period, efficiency and reserve of the radio.
        mode: what happens to a payload that does not fit into its period. ``"prefix"`` cuts it
            after the last byte that does, and what arrived is used; ``"drop"`` loses it whole;
            ``"queue"`` goes on in the next periods while the robot waits, and the answer comes
            late. A payload in pieces is cut in these three when its window ends. ``"none"`` lets
            everything through at once, as the paper's simulation does, and only keeps the records.
        count: what takes up capacity: ``"framed"`` is every byte of the call on the wire (protobuf,
            gRPC, HTTP/2 frames and headers); ``"encoded"`` the coded payload alone.
        patience_periods: with ``"queue"``, periods that the robot waits for an answer, the one in
            which it asks included.
        buffer_bytes: with ``"queue"``, what the robot's network stack holds of a call that was
            given up. It cannot be taken back and crosses before anything newer.

    Attributes:
        log: one record for each request, in order.

    Raises:
        LinkError: an unknown mode or count, a number out of range, or a channel that ends.
    """

    def __init__(
        self,
        transport: Transport,
        channel: Iterable[float],
        link: LinkProfile,
        *,
        mode: Literal["prefix", "drop", "queue", "none"] = "prefix",
        count: Literal["framed", "encoded"] = "framed",
        patience_periods: int = 8,
        buffer_bytes: int = 16_384,
    ) -> None:
        if mode not in (*MODES, UNENFORCED):
            raise LinkError(f"mode must be one of {', '.join((*MODES, UNENFORCED))}, got {mode!r}")
        self._costs = RadioCosts(link, count)
        if patience_periods < 1 or buffer_bytes < 0:
            raise LinkError(
                "expected patience_periods of at least 1 and buffer_bytes of at least 0, got "
                f"{patience_periods} and {buffer_bytes}"
            )
        self._transport = transport
        self._link = link
        self._mode = mode
        self._patience_periods = patience_periods
        # Unless it queues, a modem forgets what did not cross when it should have.
        self._radio = Radio(channel, link, buffer_bytes if mode == "queue" else 0)
        self.log: list[LinkRecord] = []

    @property
    def periods(self) -> list[PeriodRecord]:
        """One record for each control period, the current one last."""
        return self._radio.periods

    @property
    def period(self) -> int:
        """The current control period, from 0."""
        return len(self.periods) - 1

    @property
    def time_s(self) -> float:
        """When the current control period began, in seconds of simulated time."""
        return self.period * self._link.period_s

    @property
    def snr_db(self) -> float:
        """SNR of the current control period in dB; what a perfect modem would report."""
        return self.periods[-1].snr_db

    @property
    def capacity_bits(self) -> float:
        """What the link carries in the current control period, bits."""
        return self.periods[-1].capacity_bits

    @property
    def backlog_bytes(self) -> int:
        """Bytes of given-up requests that have to cross before anything newer."""
        return self._radio.backlog_bytes

    def reading(self, delay_periods: int = 0) -> SnrReading:
        """What a modem reports that is ``delay_periods`` behind, with its age.

        Before the link is that old, the report is of period 0.

        Raises:
            LinkError: a negative delay.
        """
        if delay_periods < 0:
            raise LinkError(f"expected delay_periods of at least 0, got {delay_periods}")
        age = min(delay_periods, self.period)
        return SnrReading(self.periods[-1 - age].snr_db, age * self._link.period_s)

    def advance(self, periods: int = 1) -> None:
        """Lets control periods pass; capacity that nothing waited for is gone.

        Raises:
            ValueError: fewer than one period.
            LinkError: the channel has no value for a new period.
        """
        if periods < 1:
            raise ValueError(f"expected periods >= 1, got {periods}: time does not run backwards")
        for _ in range(periods):
            self._radio.advance()

    def get_model(self, timeout_s: float) -> GetModelResponse:
        """The handshake, which happens before the robot moves and is not limited."""
        response = GetModelResponse()
        response.CopyFrom(self._transport.get_model(timeout_s))
        response.progressive = True  # it is this link that takes the pieces
        return response

    def infer(self, request: InferRequest, timeout_s: float) -> InferResponse:
        """Carries what fits of a request into this period, and the answer back.

        Raises:
            TransportError: ``DEADLINE_EXCEEDED`` when no token arrived whole in time, and whatever
                the wrapped transport raises.
        """
        return self.infer_within(request, timeout_s, self._link.window_s)

    def infer_within(
        self, request: InferRequest, timeout_s: float, window_s: float
    ) -> InferResponse:
        """Carries what fits of a request into a window of some periods, and the answer back.

        Args:
            request: the request.
            timeout_s: for the wrapped transport, on the wall clock.
            window_s: seconds in which the payload has to cross. With ``mode="queue"`` it is the
                robot's patience that counts.

        Raises:
            TransportError: ``DEADLINE_EXCEEDED`` when no token arrived whole in time, and whatever
                the wrapped transport raises.
        """
        if request.HasField("images"):
            return self._infer_pictures(request, timeout_s, window_s)
        length = len(request.payload)
        offered_bytes = self._costs.request_bytes(request, length)
        header = codec.read_header(request.payload)
        periods = self._patience_periods if self._mode == "queue" else self._span(window_s)
        asked = _Asked(self)
        carried_bytes = self._carry(offered_bytes, periods)
        kept_bytes = 0
        if carried_bytes == offered_bytes:
            kept_bytes = length
        elif self._mode == "prefix":
            kept_bytes = self._costs.fitting_payload_bytes(request, carried_bytes)
        tokens = whole_tokens(header, kept_bytes)
        self._radio.give_up()
        self._note(asked, offered_bytes, carried_bytes, header.count, tokens)
        if not tokens:
            raise self._lost(asked, offered_bytes, carried_bytes, "no token arrived whole")
        if kept_bytes < length:
            arrived = InferRequest()
            arrived.CopyFrom(request)
            arrived.payload = request.payload[:kept_bytes]
            request = arrived
        return self._transport.infer(request, timeout_s)

    def _infer_pictures(
        self, request: InferRequest, timeout_s: float, window_s: float
    ) -> InferResponse:
        """Carries pictures whole or not at all: half a file shows nothing."""
        offered_bytes = self._costs.pictures_bytes(request, self.capacity_bits)
        periods = self._patience_periods if self._mode == "queue" else self._span(window_s)
        asked = _Asked(self)
        carried_bytes = self._carry(offered_bytes, periods)
        self._radio.give_up()
        self._note(asked, offered_bytes, carried_bytes, 0, 0)
        if carried_bytes < offered_bytes:
            raise self._lost(asked, offered_bytes, carried_bytes, "no picture is of use in part")
        return self._transport.infer(request, timeout_s)

    def infer_progressive(self, stream: PayloadStream, timeout_s: float) -> InferResponse:
        """Carries a payload piece by piece until its window ends, and the answer back.

        Raises:
            TransportError: ``DEADLINE_EXCEEDED`` when fewer tokens arrived than the robot asks for,
                and whatever the wrapped transport raises.
        """
        costs = self._costs.piece_bytes(stream)
        header = codec.read_header(stream.payload)
        asked = _Asked(self)
        carried_bytes = self._carry(costs[-1], self._span(stream.window_s))
        kept_bytes = self._radio.give_up()
        whole = [*costs[:-1], costs[-1] - self._costs.end_bytes]
        arrived = bisect.bisect_right(whole, carried_bytes)
        stream.taken = min(len(costs), bisect.bisect_right(costs, carried_bytes + kept_bytes) + 1)
        tokens = whole_tokens(header, stream.ends[arrived - 1] if arrived else 0)
        self._note(asked, costs[-1], carried_bytes, header.count, tokens, progressive=True)
        least = max(1, stream.min_tokens)
        if tokens < least:
            found = f"{tokens} whole tokens of at least {least} arrived"
            raise self._lost(asked, costs[-1], carried_bytes, found)
        return self._transport.infer(stream.prefix(arrived), timeout_s)

    def close(self) -> None:
        """Closes the wrapped transport."""
        self._transport.close()

    def _carry(self, offered_bytes: int, periods: int) -> int:
        if self._mode == UNENFORCED:
            return offered_bytes
        return self._radio.carry(offered_bytes, periods)

    def _span(self, window_s: float) -> int:
        return periods_of(window_s, self._link.period_s, self._link.reserve_s)

    def _note(
        self,
        asked: _Asked,
        offered_bytes: int,
        carried_bytes: int,
        offered_tokens: int,
        tokens: int,
        *,
        progressive: bool = False,
    ) -> None:
        self.log.append(
            LinkRecord(
                period=asked.period,
                snr_db=asked.snr_db,
                capacity_bits=asked.capacity_bits,
                available_bits=asked.available_bits,
                offered_bytes=offered_bytes,
                delivered_bytes=carried_bytes,
                offered_tokens=offered_tokens,
                delivered_tokens=tokens,
                airtime_s=self._radio.airtime_s,
                waited_periods=self.period - asked.period,
                backlog_bytes=asked.backlog_bytes,
                progressive=progressive,
            )
        )

    def _lost(
        self, asked: _Asked, offered_bytes: int, carried_bytes: int, found: str
    ) -> TransportError:
        waited = self.period - asked.period
        when = f"in {waited + 1} periods" if waited else "in its period"
        return TransportError(
            "DEADLINE_EXCEEDED",
            f"the link carried {carried_bytes} of {offered_bytes} bytes {when} "
            f"({asked.snr_db:.1f} dB), {found}: send fewer tokens",
        )


class _Asked:
    """The link as a request found it."""

    def __init__(self, link: EnforcedLink) -> None:
        current = link.periods[-1]
        self.period = current.period
        self.snr_db = current.snr_db
        self.capacity_bits = current.capacity_bits
        self.available_bits = current.capacity_bits - 8 * current.delivered_bytes
        self.backlog_bytes = link.backlog_bytes
