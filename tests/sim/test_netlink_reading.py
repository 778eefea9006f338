"""What a capture makes of packets, and what a run makes of a capture. No root needed."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from comvla.v1.policy_pb2 import InferProgressiveHead, InferProgressiveRequest, InferRequest
from comvla_client.budget import LinkProfile
from comvla_sim.netlink import account
from comvla_sim.netlink.capture import Captured, PacketReader
from comvla_sim.netlink.driver import summary_of
from comvla_sim.netlink.flaps import older_after_newer
from comvla_sim.netlink.http2 import Call, CallReader, session_and_step

PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"
HEADERS, DATA, PING = 1, 0, 6


def frame(kind: int, stream: int, body: bytes, *, end: bool = False) -> bytes:
    return len(body).to_bytes(3, "big") + bytes([kind, int(end)]) + stream.to_bytes(4, "big") + body


def call(stream: int, request: InferRequest) -> bytes:
    message = request.SerializeToString()
    body = b"\0" + len(message).to_bytes(4, "big") + message
    return frame(HEADERS, stream, b"h" * 30) + frame(DATA, stream, body, end=True)


def requests(count: int) -> list[InferRequest]:
    return [
        InferRequest(session_id="robot.5eed.0", step=step, payload=bytes(900 + step))
        for step in range(count)
    ]


@given(st.lists(st.integers(1, 700), min_size=1, max_size=30))
@example([1, 378, 700])  # between a step's tag and its value
def test_calls_are_read_however_the_stream_is_cut(cuts: list[int]) -> None:
    sent = requests(3)
    stream = PREFACE + frame(PING, 0, bytes(8))
    stream += b"".join(call(2 * i + 1, request) for i, request in enumerate(sent))
    calls: list[Call] = []
    reader, at = CallReader(calls.append), 0
    for number, cut in enumerate([*cuts, len(stream)]):
        reader.feed(stream[at : at + cut], float(number))
        at += cut
    assert [(c.session, c.step) for c in calls] == [("robot.5eed.0", s) for s in range(3)]
    assert [c.data_bytes for c in calls] == [r.ByteSize() + 5 + 9 for r in sent]
    assert all(c.complete_s is not None and c.complete_s >= c.first_s for c in calls)
    assert reader.other_bytes[PING] == 17


def test_a_call_that_was_cut_off_is_never_complete() -> None:
    calls: list[Call] = []
    CallReader(calls.append).feed(PREFACE + call(1, requests(1)[0])[:-1], 0.0)
    assert calls[0].complete_s is None
    assert calls[0].step == 0


def test_session_and_step_are_found_in_both_kinds_of_requests() -> None:
    request = InferRequest(session_id="robot-7/x.12", step=300, instruction="push")
    assert session_and_step(request.SerializeToString()) == ("robot-7/x.12", 300)
    head = InferProgressiveRequest(head=InferProgressiveHead(request=request, window_s=0.04))
    assert session_and_step(head.SerializeToString()) == ("robot-7/x.12", 300)
    assert session_and_step(b"\x12\x03abc") is None
    assert session_and_step(b"") is None


def packet(seq: int, data: bytes, *, syn: bool = False, port: int = 40_000) -> bytes:
    tcp = port.to_bytes(2, "big") + (50_051).to_bytes(2, "big") + seq.to_bytes(4, "big")
    tcp += bytes(4) + bytes([0x50, 0x02 if syn else 0x10]) + bytes(6)
    length = 20 + len(tcp) + len(data)
    ip = bytes([0x45, 0]) + length.to_bytes(2, "big") + bytes(5) + bytes([6]) + bytes(10)
    return bytes(12) + b"\x08\x00" + ip + tcp + data


def test_packets_out_of_order_and_sent_again_make_one_stream() -> None:
    stream = PREFACE + call(1, requests(1)[0])
    parts = [(at, stream[at : at + 200]) for at in range(0, len(stream), 200)]
    first = (1 << 32) - 300  # sequence numbers wrap
    reader = PacketReader()
    reader.take(packet(first - 1, b"", syn=True), outgoing=True, wall_s=0.0)
    order = [0, 2, 1, 1, *range(3, len(parts)), 0]
    for number in order:
        at, data = parts[number]
        reader.take(packet((first + at) % (1 << 32), data), outgoing=True, wall_s=1.0)
    up = reader.captured.up
    assert reader.captured.calls[0].complete_s is not None
    assert up.repeated_bytes == 2 * 40 + len(parts[1][1]) + len(parts[0][1])
    assert (up.packets, up.empty_packets) == (1 + len(order), 1)
    assert up.bytes == 40 * up.packets + sum(len(parts[n][1]) for n in order)


def test_what_is_no_ip_packet_is_not_counted() -> None:
    reader = PacketReader()
    reader.take(bytes(12) + b"\x88\xb5" + bytes(60), outgoing=True, wall_s=0.0)
    assert reader.captured == Captured()


def record(period: int, **changes: object) -> dict[str, object]:
    plain = {
        "period": period,
        "boundary": 100.0 + 0.05 * period,
        "late_s": 0.0,
        "session": "r.0",
        "step": period,
        "tokens": 32,
        "tokens_used": 32,
        "payload_bytes": 69_632,
        "framed_bytes": 70_000,
        "source": "cloud",
        "reason": None,
        "answered_after_s": 0.045,
    }
    return plain | changes


def test_a_query_is_in_time_by_what_the_capture_saw_and_the_robot_got() -> None:
    records = [
        record(0),
        record(1, answered_after_s=0.051),
        record(2, answered_after_s=None, reason="deadline", tokens_used=0),
        record(3, tokens=0, framed_bytes=0, answered_after_s=None, reason="no_link"),
    ]
    calls = [
        Call(1, 100.0, 100.04, 70_000, 100.04, session="r.0", step=0),
        Call(3, 100.05, 100.06, 10, None, session="r.0", step=1),
        Call(5, 100.05, 100.09, 70_000, 100.09, session="r.0", step=1),  # over another connection
        Call(7, 100.1, 100.2, 70_000, 100.2, session="r.0", step=2),
    ]
    joined = account.join(records, calls, 0.05, stolen_periods=[1])
    assert [q["stolen"] for q in joined] == [False, True, True, False]
    assert [q["payload_in_time"] for q in joined] == [True, True, False, False]
    assert [q["answer_in_time"] for q in joined] == [True, False, False, False]

    profile = LinkProfile()
    captured = Captured(calls=calls, period_bytes=[70_000, 70_000, 0, 400_000])
    summary = account.summarise(joined, captured, profile, [10.0] * 4, 1500)
    assert summary["sent"]["count"] == 3
    assert (summary["answer_in_time"]["count"], summary["answer_in_time"]["of"]) == (1, 4)
    assert summary["backlog"]["late_payloads"]["count"] == 1
    assert summary["backlog"]["late_by_s"]["max"] == pytest.approx(0.05)
    assert summary["link"]["over_capacity"]["count"] == 1
    assert summary["reasons"] == {"answered": 2, "deadline": 1, "no_link": 1}


def test_one_packet_above_capacity_is_the_resolution_of_a_link() -> None:
    honest = account.link_honesty([10_000, 11_400], np.array([10_000.0, 10_000.0]), 1500)
    assert honest["over_capacity"]["count"] == 0
    assert honest["largest_excess_bytes"] == 1400.0


def test_an_older_chunk_after_a_newer_one_is_noticed() -> None:
    assert older_after_newer([1, 1, 2, 0, 0, 3, 3]) == 0
    assert older_after_newer([1, 2, 1, 3, 2]) == 2


def test_the_account_of_a_run_without_queries_has_no_numbers() -> None:
    assert account.percentiles([])["p50"] is None
    assert account.share(0, 0)["share"] is None
    assert summary_of([])["periods"] == 0
