"""The enforced link lets no byte pass that its control period cannot carry."""

from __future__ import annotations

import itertools
import math
import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from comvla import codec
from comvla.errors import LinkError
from comvla.v1.policy_pb2 import GetModelResponse, ImageCoding, InferRequest, InferResponse
from comvla_client import LinkProfile, TransportError, framed_token_budget
from comvla_client.streaming import PayloadStream
from comvla_sim.channel import ConstantChannel, RayleighChannel
from comvla_sim.link import EnforcedLink

DIM = 96
LINK = LinkProfile(bandwidth_hz=0.88e6, period_s=0.05, efficiency=0.38)
TOKENS = np.random.RandomState(0).standard_normal((512, DIM)).astype(np.float32)


class Receiver:
    """The far end of the radio."""

    def __init__(self) -> None:
        self.arrived: list[InferRequest] = []
        self.closed = False

    def get_model(self, timeout_s: float) -> GetModelResponse:
        return GetModelResponse(model_name="receiver")

    def infer(self, request: InferRequest, timeout_s: float) -> InferResponse:
        self.arrived.append(request)
        return InferResponse(session_id=request.session_id, step=request.step)

    def close(self) -> None:
        self.closed = True


def request_of(count: int) -> InferRequest:
    positions = np.arange(count, dtype=np.int32)[::-1].copy()
    payload = codec.encode(TOKENS[:count], positions, "int8")
    return InferRequest(
        session_id="robot-1",
        step=7,
        instruction="open the drawer",
        proprio=[0.0] * 4,
        payload=payload,
        model_fingerprint="f" * 32,
        snr_db=3.0,
        snr_age_s=0.0,
        protocol_version=1,
    )


def wire_bytes(request: InferRequest) -> int:
    return codec.wire_bytes(request.ByteSize()) + codec.CALL_HEADERS_BYTES


def with_payload(request: InferRequest, length: int) -> InferRequest:
    shorter = InferRequest()
    shorter.CopyFrom(request)
    shorter.payload = request.payload[:length]
    return shorter


@given(count=st.integers(1, 512), snr_db=st.floats(-20, 40))
def test_what_arrives_is_the_longest_prefix_that_fits(count: int, snr_db: float) -> None:
    receiver, request = Receiver(), request_of(count)
    link = EnforcedLink(receiver, ConstantChannel(snr_db), LINK)
    capacity_bytes = LINK.capacity_bits(snr_db) / 8
    if wire_bytes(request_of(1)) > capacity_bytes:  # not even the first token fits
        with pytest.raises(TransportError, match="DEADLINE_EXCEEDED"):
            link.infer(request, 1.0)
        assert not receiver.arrived
    else:
        link.infer(request, 1.0)
        (arrived,) = receiver.arrived
        tokens, positions = codec.decode(arrived.payload)
        assert wire_bytes(arrived) <= capacity_bytes
        assert arrived == with_payload(request, len(arrived.payload))
        assert positions.tolist() == list(range(count))[::-1][: len(tokens)]
        assert link.log[0].delivered_tokens == len(tokens)
        if len(arrived.payload) < len(request.payload):
            longer = with_payload(request, len(arrived.payload) + 1)
            assert wire_bytes(longer) > capacity_bytes
    (record,) = link.log
    assert 8 * record.delivered_bytes <= record.available_bits == record.capacity_bits
    assert record.offered_bytes == wire_bytes(request)
    assert record.offered_tokens == count
    assert 0 <= record.airtime_s <= LINK.period_s


def test_the_request_itself_is_left_alone() -> None:
    request = request_of(500)
    before = request.SerializeToString()
    receiver = Receiver()
    EnforcedLink(receiver, ConstantChannel(10.0), LINK).infer(request, 1.0)
    assert request.SerializeToString() == before
    arrived = receiver.arrived[0]
    assert arrived.payload != request.payload
    arrived.payload = request.payload
    assert arrived == request


def test_drop_loses_a_payload_whole_that_prefix_would_cut() -> None:
    receiver = Receiver()
    link = EnforcedLink(receiver, ConstantChannel(10.0), LINK, mode="drop")
    with pytest.raises(TransportError, match="no token arrived whole"):
        link.infer(request_of(200), 1.0)
    assert not receiver.arrived
    link.advance()
    link.infer(request_of(20), 1.0)
    assert len(receiver.arrived) == 1


@pytest.mark.parametrize("snr_db", [10.0, -20.0, -math.inf])
def test_without_enforcement_everything_arrives_at_once_and_is_written_down(snr_db: float) -> None:
    receiver, request = Receiver(), request_of(200)
    link = EnforcedLink(receiver, ConstantChannel(snr_db), LINK, mode="none")
    link.infer(request, 1.0)
    stream = PayloadStream(with_payload(request, 0), request.payload, [len(request.payload)], 0.05)
    link.infer_progressive(stream, 1.0)
    assert receiver.arrived == [request, request]
    assert stream.taken == 1
    pictures = with_payload(request, 0)
    pictures.images.views.add(data=bytes(90_000), height=16, width=16)
    link.infer(pictures, 1.0)
    assert receiver.arrived[2] == pictures
    assert link.period == 0
    for record in link.log:
        assert record.overrun
        assert record.delivered_tokens == record.offered_tokens
        assert record.delivered_bytes == record.offered_bytes


def test_a_payload_sized_by_all_its_bytes_always_arrives_whole() -> None:
    receiver = Receiver()
    channel = RayleighChannel(8.0, 10.0, LINK.period_s, seed=4)
    link = EnforcedLink(receiver, channel, LINK)
    for _ in range(300):
        budget = framed_token_budget(
            link.snr_db,
            LINK,
            token_dim=DIM,
            quantization="int8",
            session_id="robot-1",
            step=7,
            instruction="open the drawer",
            proprio_dim=4,
            model_fingerprint="f" * 32,
        )
        if budget:
            link.infer(request_of(min(budget, 512)), 1.0)
        link.advance()
    assert len(link.log) > 250
    assert all(r.delivered_tokens == r.offered_tokens for r in link.log)
    assert all(8 * r.offered_bytes <= r.capacity_bits for r in link.log)
    # And not for want of trying: one token more would have been too many.
    assert max(8 * r.offered_bytes / r.capacity_bits for r in link.log) > 0.99


def test_the_papers_accounting_leaves_out_what_then_is_cut() -> None:
    """K·D·B bits fit, but positions, scales and framing come on top."""
    receiver = Receiver()
    link = EnforcedLink(receiver, ConstantChannel(10.0), LINK)
    budget = int(LINK.capacity_bits(10.0) // (DIM * 8))
    link.infer(request_of(budget), 1.0)
    assert 0 < link.log[0].delivered_tokens < budget


def test_counting_the_payload_alone_ignores_the_frame() -> None:
    receiver, request = Receiver(), request_of(40)
    need_bits = 8 * len(request.payload)
    tight = LinkProfile(bandwidth_hz=need_bits / 0.05, period_s=0.05, efficiency=1.0)
    link = EnforcedLink(receiver, ConstantChannel(0.0), tight, count="encoded")  # log2(1 + 1) = 1
    link.infer(request, 1.0)
    assert link.log[0].delivered_tokens == 40
    assert link.log[0].airtime_s == pytest.approx(0.05)


def test_two_requests_share_the_capacity_of_their_period() -> None:
    receiver = Receiver()
    link = EnforcedLink(receiver, ConstantChannel(10.0), LINK)
    link.infer(request_of(40), 1.0)
    link.infer(request_of(40), 1.0)
    first, second = link.log
    assert first.period == second.period == 0
    assert first.delivered_tokens == 40
    assert 0 < second.delivered_tokens < 40
    assert 8 * (first.delivered_bytes + second.delivered_bytes) <= link.capacity_bits
    link.advance()
    link.infer(request_of(40), 1.0)
    assert link.log[2].delivered_tokens == 40
    assert link.log[2].period == 1


def test_periods_follow_the_channel_and_not_a_clock() -> None:
    channel = RayleighChannel(8.0, 10.0, LINK.period_s, seed=4)
    link = EnforcedLink(Receiver(), channel, LINK)
    seen = [link.snr_db]
    for periods in (1, 1, 3):
        link.advance(periods)
        seen.append(link.snr_db)
    expected = channel.snr_db(6)
    assert seen == [expected[0], expected[1], expected[2], expected[5]]
    assert link.period == 5
    assert link.capacity_bits == LINK.capacity_bits(expected[5])


def test_a_link_that_is_down_delivers_nothing() -> None:
    receiver = Receiver()
    link = EnforcedLink(receiver, ConstantChannel(-math.inf), LINK)
    with pytest.raises(TransportError, match="0 of"):
        link.infer(request_of(1), 1.0)
    assert link.log[0].to_dict()["snr_db"] == "-inf"
    assert not receiver.arrived


def test_the_handshake_passes_and_closing_closes() -> None:
    receiver = Receiver()
    link = EnforcedLink(receiver, ConstantChannel(-math.inf), LINK)
    assert link.get_model(1.0).model_name == "receiver"
    link.close()
    assert receiver.closed


def test_senseless_links_are_refused() -> None:
    with pytest.raises(LinkError, match="mode"):
        EnforcedLink(Receiver(), ConstantChannel(0.0), LINK, mode="shrink")  # type: ignore[arg-type]
    with pytest.raises(LinkError, match="count"):
        EnforcedLink(Receiver(), ConstantChannel(0.0), LINK, count="all")  # type: ignore[arg-type]
    with pytest.raises(LinkError, match="channel ends"):
        EnforcedLink(Receiver(), [], LINK)
    link = EnforcedLink(Receiver(), itertools.repeat(3.0, 2), LINK)
    with pytest.raises(ValueError, match="periods"):
        link.advance(0)
    link.advance()
    with pytest.raises(LinkError, match="ends before period 2"):
        link.advance()


@pytest.mark.parametrize("mode", ["prefix", "drop", "queue"])
@pytest.mark.parametrize("count", ["framed", "encoded"])
def test_pictures_cross_whole_or_not_at_all(mode: Any, count: Any) -> None:
    """One byte too many in the period, and nothing of it is of use."""
    request = request_of(1)
    request.payload = b""
    request.images.views.add(data=bytes(900), height=16, width=16)
    cost = wire_bytes(request) if count == "framed" else request.images.ByteSize()
    for room_bytes in (cost, cost - 1):
        # At 0 dB a link carries W · T · η bits a period.
        link = LinkProfile(bandwidth_hz=8 * room_bytes / 0.05, period_s=0.05, efficiency=1.0)
        receiver = Receiver()
        radio = EnforcedLink(
            receiver, ConstantChannel(0.0), link, mode=mode, count=count, patience_periods=1
        )
        if room_bytes == cost:
            radio.infer(request, 1.0)
            assert receiver.arrived == [request]
        else:
            with pytest.raises(TransportError, match="no picture is of use in part"):
                radio.infer(request, 1.0)
            assert not receiver.arrived
        assert radio.log[-1].offered_bytes == cost
        assert radio.log[-1].delivered_bytes == min(cost, room_bytes)


@pytest.mark.parametrize("snr_db", [-5.0, 20.0])
def test_analogue_symbols_are_charged_by_uses_of_the_channel(snr_db: float) -> None:
    """However many bytes stand for them here: a symbol is one of W·T, at any SNR."""
    profile = LinkProfile(bandwidth_hz=1e6, period_s=0.05)
    symbols = 20_000  # of 50 000
    header = struct.pack("<4sBBH8s3f", b"CVAS", 1, 4, 0, bytes(8), 1.0, 0.0, 0.1) + b"witt"
    request = InferRequest(session_id="s")
    request.images.coding = ImageCoding.IMAGE_CODING_WITT
    request.images.views.add(data=header + bytes(8 * symbols), height=64, width=64)
    link = EnforcedLink(Receiver(), itertools.repeat(snr_db), profile, mode="drop", count="encoded")
    link.infer(request, 1.0)
    share = symbols / (profile.bandwidth_hz * profile.period_s)
    (record,) = link.log
    spent = 8 * record.offered_bytes / record.capacity_bits
    assert spent == pytest.approx(share, abs=0.02)
    link.advance()
    request.images.views.add(data=header + bytes(8 * 40_000), height=64, width=64)
    with pytest.raises(TransportError, match="no picture is of use in part"):
        link.infer(request, 1.0)
