"""Bytes over simulated periods: what crosses never exceeds the capacity, and nothing gets lost."""

from __future__ import annotations

import contextlib
import math
from collections import deque
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_enforced_link import DIM, LINK, Receiver, request_of, wire_bytes

from comvla import codec
from comvla.errors import LinkError
from comvla.v1.policy_pb2 import InferRequest
from comvla_client import LinkProfile, SnrReading, TransportError
from comvla_client.streaming import PayloadStream
from comvla_sim.channel import ConstantChannel, RayleighChannel
from comvla_sim.link import MODES, EnforcedLink
from comvla_sim.radio import Radio

RESERVED = LinkProfile(bandwidth_hz=0.88e6, period_s=0.05, efficiency=0.38, reserve_s=0.02)

CALLS = st.lists(
    st.tuples(
        st.integers(1, 400),  # tokens
        st.booleans(),  # in pieces
        st.integers(0, 3),  # periods that pass afterwards
    ),
    max_size=12,
)


def stream_of(count: int, *, window_s: float = 0.05, min_tokens: int = 1) -> PayloadStream:
    request = request_of(count)
    head = InferRequest()
    head.CopyFrom(request)
    head.payload = b""
    ends = codec.piece_ends(count, DIM, "int8", piece_tokens=3)
    return PayloadStream(head, request.payload, ends, window_s, min_tokens)


def drive(link: EnforcedLink, calls: list[tuple[int, bool, int]], window_s: float) -> None:
    for tokens, progressive, pause in calls:
        with contextlib.suppress(TransportError):
            if progressive:
                link.infer_progressive(stream_of(tokens, window_s=window_s), 1.0)
            else:
                link.infer(request_of(tokens), 1.0)
        if pause:
            link.advance(pause)


@settings(deadline=None)
@given(
    calls=CALLS,
    mode=st.sampled_from(MODES),
    profile=st.sampled_from([LINK, RESERVED]),
    mean_snr_db=st.floats(-10, 20),
    seed=st.integers(0, 1000),
    patience=st.integers(1, 5),
    buffer_bytes=st.sampled_from([0, 700, 16_384]),
)
def test_no_period_carries_more_than_it_can_and_all_bytes_are_accounted_for(
    calls: list[tuple[int, bool, int]],
    mode: Any,
    profile: LinkProfile,
    mean_snr_db: float,
    seed: int,
    patience: int,
    buffer_bytes: int,
) -> None:
    channel = RayleighChannel(mean_snr_db, 10.0, 0.05, seed)
    link = EnforcedLink(
        Receiver(),
        channel,
        profile,
        mode=mode,
        patience_periods=patience,
        buffer_bytes=buffer_bytes,
    )
    drive(link, calls, profile.window_s)
    assert len(link.log) == len(calls)
    for period in link.periods:
        assert 8 * period.delivered_bytes <= period.capacity_bits
        assert period.capacity_bits == profile.capacity_bits(period.snr_db)
        assert period.backlog_bytes <= len(calls) * buffer_bytes or mode == "queue"
    offered = sum(p.offered_bytes for p in link.periods)
    assert offered == sum(record.offered_bytes for record in link.log)
    delivered = sum(p.delivered_bytes for p in link.periods)
    discarded = sum(p.discarded_bytes for p in link.periods)
    assert offered == delivered + discarded + link.backlog_bytes
    if mode != "queue":
        assert link.backlog_bytes == 0
        assert all(record.waited_periods == 0 for record in link.log)
        for record in link.log:
            window = profile.window_bits(record.snr_db)
            assert 8 * record.delivered_bytes <= min(record.available_bits, window)
    for record in link.log:
        assert record.waited_periods < patience or record.waited_periods == 0
        assert 0.0 <= record.airtime_s <= (record.waited_periods + 1) * 0.05 + 1e-9
        assert record.delivered_tokens <= record.offered_tokens
    assert [p.period for p in link.periods] == list(range(link.period + 1))


@settings(deadline=None)
@given(
    offers=st.lists(
        st.tuples(st.integers(0, 6000), st.integers(1, 4), st.integers(0, 2)), max_size=15
    ),
    seed=st.integers(0, 1000),
    buffer_bytes=st.sampled_from([0, 500, 10_000]),
)
def test_the_queue_is_first_in_first_out(
    offers: list[tuple[int, int, int]], seed: int, buffer_bytes: int
) -> None:
    """Against a queue of single bytes, each with the number of its call."""
    channel = RayleighChannel(0.0, 10.0, 0.05, seed)
    radio = Radio(channel, LINK, buffer_bytes)
    capacities = [int(LINK.capacity_bits(snr) // 8) for snr in channel.snr_db(200)]
    queue: deque[int] = deque()
    left, period = capacities[0], 0

    def drain() -> list[int]:
        nonlocal left
        crossed = [queue.popleft() for _ in range(min(left, len(queue)))]
        left -= len(crossed)
        return crossed

    def begin() -> None:
        nonlocal left, period
        period += 1
        left = capacities[period]

    for number, (offered, periods, pause) in enumerate(offers):
        queue.extend([number] * offered)
        mine = drain().count(number)
        for _ in range(periods - 1):
            if mine == offered:
                break
            begin()
            mine += drain().count(number)
        assert radio.carry(offered, periods) == mine
        assert len(radio.periods) - 1 == period
        kept = radio.give_up()
        rest = offered - mine
        assert kept == min(rest, buffer_bytes)
        for _ in range(rest - kept):
            queue.pop()
        drain()
        assert radio.backlog_bytes == len(queue)
        for _ in range(pause):
            begin()
            drain()
            radio.advance()
        assert radio.backlog_bytes == len(queue)


def test_a_late_payload_goes_on_in_the_next_periods_and_is_answered_late() -> None:
    receiver, request = Receiver(), request_of(250)
    link = EnforcedLink(receiver, ConstantChannel(10.0), LINK, mode="queue")
    needed = math.ceil(8 * wire_bytes(request) / link.capacity_bits)
    assert needed > 2
    link.infer(request, 1.0)
    assert receiver.arrived == [request]
    assert link.period == needed - 1
    (record,) = link.log
    assert record.waited_periods == needed - 1
    assert record.overrun
    assert record.delivered_tokens == 250
    assert [p.late for p in link.periods] == [1] * (needed - 1) + [0]
    assert link.periods[0].backlog_bytes == wire_bytes(request) - link.periods[0].delivered_bytes


def test_what_was_given_up_delays_what_comes_next() -> None:
    receiver = Receiver()
    link = EnforcedLink(
        receiver, ConstantChannel(10.0), LINK, mode="queue", patience_periods=1, buffer_bytes=9000
    )
    with pytest.raises(TransportError, match="in its period"):
        link.infer(request_of(400), 1.0)
    backlog = link.backlog_bytes
    assert backlog == 9000
    assert link.periods[0].discarded_bytes > 0
    link.advance()
    with pytest.raises(TransportError, match="DEADLINE_EXCEEDED"):
        link.infer(request_of(20), 1.0)  # would fit, if the link were free
    link.advance(3)
    assert link.backlog_bytes == 0
    link.infer(request_of(20), 1.0)
    assert [len(codec.decode(r.payload)[0]) for r in receiver.arrived] == [20]


def test_pieces_are_cut_when_their_window_ends_in_every_mode() -> None:
    arrived = []
    for mode in MODES:
        receiver = Receiver()
        link = EnforcedLink(receiver, ConstantChannel(10.0), LINK, mode=mode, buffer_bytes=2000)
        stream = stream_of(300)
        link.infer_progressive(stream, 1.0)
        (request,) = receiver.arrived
        tokens, positions = codec.decode(request.payload)
        assert positions.tolist() == list(range(300))[::-1][: len(tokens)]
        assert link.period == 0
        assert link.log[0].progressive
        assert link.log[0].delivered_tokens == len(tokens)
        spent = codec.CALL_HEADERS_BYTES + stream.costs()[(len(tokens) + 1) // 3]
        assert 8 * spent <= link.capacity_bits
        assert link.backlog_bytes == (2000 if mode == "queue" else 0)
        assert stream.taken_tokens >= len(tokens)
        arrived.append(len(tokens))
    assert len(set(arrived)) == 1
    assert 0 < arrived[0] < 300


def test_a_window_of_two_periods_carries_twice_as_much() -> None:
    counts = []
    for window_s in (0.05, 0.1):
        receiver = Receiver()
        link = EnforcedLink(receiver, ConstantChannel(5.0), LINK)
        link.infer_progressive(stream_of(300, window_s=window_s), 1.0)
        counts.append(link.log[0].delivered_tokens)
        assert link.period == round(window_s / 0.05) - 1
        again = EnforcedLink(Receiver(), ConstantChannel(5.0), LINK)
        again.infer_within(request_of(300), 1.0, window_s)
        assert again.log[0].delivered_tokens >= counts[-1]
        assert again.period == link.period
    assert 1.8 < counts[1] / counts[0] < 2.4


def test_what_arrives_after_the_reserve_began_is_answered_a_period_later() -> None:
    """It fits into the period, and its answer does not."""
    receiver = Receiver()
    link = EnforcedLink(receiver, ConstantChannel(10.0), RESERVED, mode="queue")
    fits = [k for k in range(1, 300) if 8 * wire_bytes(request_of(k)) <= link.capacity_bits]
    link.infer(request_of(fits[-1]), 1.0)
    assert (link.period, link.log[0].waited_periods) == (1, 1)
    in_time = [k for k in fits if 8 * wire_bytes(request_of(k)) <= RESERVED.window_bits(10.0)]
    link.advance()
    link.infer(request_of(in_time[-1]), 1.0)
    assert link.log[1].waited_periods == 0
    cut = EnforcedLink(Receiver(), ConstantChannel(10.0), RESERVED)
    cut.infer(request_of(fits[-1]), 1.0)
    assert cut.log[0].delivered_tokens == in_time[-1]


def test_too_few_tokens_in_pieces_are_lost() -> None:
    receiver = Receiver()
    link = EnforcedLink(receiver, ConstantChannel(0.0), LINK)
    with pytest.raises(TransportError, match="of at least 40 arrived"):
        link.infer_progressive(stream_of(100, min_tokens=40), 1.0)
    assert receiver.arrived == []
    down = EnforcedLink(receiver, ConstantChannel(-math.inf), LINK, mode="queue")
    with pytest.raises(TransportError, match="0 of"):
        down.infer_progressive(stream_of(10), 1.0)
    assert down.periods[0].to_dict()["snr_db"] == "-inf"


def test_a_modem_that_is_behind_reports_an_older_period_and_its_age() -> None:
    channel = RayleighChannel(8.0, 10.0, LINK.period_s, seed=4)
    link = EnforcedLink(Receiver(), channel, LINK)
    assert link.reading(3) == SnrReading(link.snr_db, 0.0), "there was nothing before"
    link.advance(5)
    seen = channel.snr_db(6)
    assert link.reading() == SnrReading(float(seen[5]), 0.0)
    assert link.reading(2) == SnrReading(float(seen[3]), 0.1)
    assert link.time_s == pytest.approx(0.25)
    with pytest.raises(LinkError, match="delay"):
        link.reading(-1)


def test_the_link_takes_pieces_for_any_server() -> None:
    assert EnforcedLink(Receiver(), ConstantChannel(0.0), LINK).get_model(1.0).progressive


def test_senseless_queues_are_refused() -> None:
    for wrong in ({"patience_periods": 0}, {"buffer_bytes": -1}):
        with pytest.raises(LinkError, match="patience_periods"):
            EnforcedLink(Receiver(), ConstantChannel(0.0), LINK, **wrong)  # type: ignore[arg-type]


def test_counting_the_payload_alone_leaves_out_what_pieces_cost() -> None:
    link = EnforcedLink(Receiver(), ConstantChannel(10.0), LINK, count="encoded")
    link.infer_progressive(stream_of(300), 1.0)
    framed = EnforcedLink(Receiver(), ConstantChannel(10.0), LINK)
    framed.infer_progressive(stream_of(300), 1.0)
    assert link.log[0].delivered_tokens > framed.log[0].delivered_tokens
