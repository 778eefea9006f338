"""A payload in pieces costs on the socket what the accounting says, up to every cut."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent import futures

import grpc
import numpy as np
import pytest
from http2_tap import DATA, HEADERS, WINDOW_UPDATE, Tap
from hypothesis import given, settings
from hypothesis import strategies as st

from comvla import codec
from comvla.errors import CodecError
from comvla.v1 import policy_pb2, policy_pb2_grpc
from comvla.v1.policy_pb2 import InferProgressiveHead, InferProgressiveRequest, InferRequest

TOWER_DIMS = (1024, 1152)
DIM = sum(TOWER_DIMS)


class Reading(policy_pb2_grpc.PolicyServiceServicer):
    """Reads all that comes and says how many bytes that were."""

    def InferProgressive(
        self, request_iterator: Iterator[InferProgressiveRequest], context: grpc.ServicerContext
    ) -> policy_pb2.InferProgressiveResponse:
        total = sum(len(message.piece) for message in request_iterator)
        answer = policy_pb2.InferResponse(step=total)
        return policy_pb2.InferProgressiveResponse(response=answer)


@pytest.fixture(scope="module")
def server_port() -> Iterator[int]:
    server = grpc.server(futures.ThreadPoolExecutor(2), options=codec.GRPC_OPTIONS)
    policy_pb2_grpc.add_PolicyServiceServicer_to_server(Reading(), server)
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    yield port
    server.stop(None).wait()


def messages(
    k: int, quantization: str, ends: list[int], window_s: float = 0.05
) -> list[InferProgressiveRequest]:
    rng = np.random.default_rng(k)
    tokens = rng.standard_normal((k, DIM)).astype(np.float32)
    payload = codec.encode(tokens, rng.permutation(512)[:k], quantization, tower_dims=TOWER_DIMS)
    request = InferRequest(
        session_id="robot-7/episode-12",
        step=k,
        instruction="pull the green drawer open",
        proprio=[0.25] * 8,
        model_fingerprint="0f" * 32,
        snr_db=7.5,
        snr_age_s=0.0,
        protocol_version=1,
    )
    head = InferProgressiveHead(request=request, window_s=window_s, min_tokens=4)
    starts = [0, *ends]
    return [
        InferProgressiveRequest(head=head),
        *(
            InferProgressiveRequest(piece=payload[start:end])
            for start, end in zip(starts, ends, strict=False)
        ),
    ]


def one_by_one(
    tap: Tap, number: int, sent: list[InferProgressiveRequest]
) -> Iterator[InferProgressiveRequest]:
    """Each message when the one before has passed the tap, so that none share a frame."""
    pause = threading.Event()

    def passed() -> int:
        call = [frame for frames in tap.calls("up")[number:] for frame in frames]
        return sum(frame.wire_bytes for frame in call if frame.kind == DATA)

    expected = 0
    for message in sent:
        yield message
        expected += codec.wire_bytes(message.ByteSize())
        while passed() < expected:
            pause.wait(0.001)


@pytest.mark.parametrize("quantization", codec.QUANTIZATIONS)
def test_every_prefix_costs_what_was_promised(server_port: int, quantization: str) -> None:
    with (
        Tap(server_port) as tap,
        grpc.insecure_channel(tap.target, options=codec.GRPC_OPTIONS) as channel,
    ):
        stub = policy_pb2_grpc.PolicyServiceStub(channel)
        cuts = ((1, 1, 1), (9, 4, 1), (20, 4, 3), (7, 7, 2))
        for number, (k, first, piece) in enumerate(cuts):
            ends = codec.piece_ends(
                k, DIM, quantization, num_towers=2, first_tokens=first, piece_tokens=piece
            )
            sent = messages(k, quantization, ends)
            answer = stub.InferProgressive(one_by_one(tap, number, sent), timeout=20)
            assert answer.response.step == ends[-1]
            up = tap.calls("up")[-1]
            data = [frame.wire_bytes for frame in up if frame.kind == DATA]
            promised = codec.progressive_wire_bytes(sent[0].ByteSize(), ends)
            # A message above 16 KiB takes several frames; each piece ends with one.
            reached = {*promised[:-1], promised[-1] - codec.HTTP2_END_BYTES}
            assert reached <= set(np.cumsum(data).tolist())
            assert sum(data) == promised[-1]
            others = sum(frame.wire_bytes for frame in up if frame.kind != DATA)
            assert {frame.kind for frame in up} <= {HEADERS, DATA, WINDOW_UPDATE}
            assert others <= (codec.CALL_HEADERS_BYTES if number else 300)


def test_messages_in_a_hurry_cost_no_more(server_port: int) -> None:
    with (
        Tap(server_port) as tap,
        grpc.insecure_channel(tap.target, options=codec.GRPC_OPTIONS) as channel,
    ):
        stub = policy_pb2_grpc.PolicyServiceStub(channel)
        ends = codec.piece_ends(40, DIM, "int8", num_towers=2)
        sent = messages(40, "int8", ends)
        assert stub.InferProgressive(iter(sent), timeout=20).response.step == ends[-1]
        data = sum(frame.wire_bytes for frame in tap.calls("up")[-1] if frame.kind == DATA)
    promised = codec.progressive_wire_bytes(sent[0].ByteSize(), ends)[-1]
    assert promised - 9 * (len(sent) + 1) <= data <= promised


@settings(deadline=None)
@given(
    k=st.integers(1, 300),
    dim=st.integers(1, 3000),
    quantization=st.sampled_from(codec.QUANTIZATIONS),
    first=st.integers(1, 40),
    piece=st.integers(1, 40),
)
def test_pieces_end_between_tokens_and_cover_the_payload(
    k: int, dim: int, quantization: str, first: int, piece: int
) -> None:
    ends = codec.piece_ends(k, dim, quantization, first_tokens=first, piece_tokens=piece)
    tokens = [codec.prefix_tokens(end, dim, quantization) for end in ends]
    assert [codec.encoded_bytes(n, dim, quantization) for n in tokens] == ends
    assert tokens[0] == min(first, k)
    assert tokens[-1] == k
    steps = np.diff(tokens)
    assert all(steps[:-1] == piece)
    assert all((steps > 0) & (steps <= piece))


@settings(deadline=None)
@given(
    request_bytes=st.integers(0, 40_000),
    window_s=st.sampled_from([0.0, 0.05, 2.5]),
    min_tokens=st.integers(0, 2**32 - 1),
    length=st.integers(1, 70_000),
)
def test_message_sizes_are_exact(
    request_bytes: int, window_s: float, min_tokens: int, length: int
) -> None:
    head = InferProgressiveHead(window_s=window_s, min_tokens=min_tokens)
    head.request.SetInParent()
    if request_bytes > 4:
        head.request.payload = bytes(request_bytes - 4)
    inner = head.request.ByteSize()
    message = InferProgressiveRequest(head=head)
    expected = codec.progressive_head_bytes(inner, window_s=window_s, min_tokens=min_tokens)
    assert message.ByteSize() == expected
    piece = InferProgressiveRequest(piece=bytes(length))
    assert piece.ByteSize() == codec.progressive_piece_bytes(length)


@settings(deadline=None)
@given(link_bytes=st.floats(0, 1e7), dim=st.integers(1, 4096))
def test_pieces_balance_their_overhead_against_what_a_cut_costs(
    link_bytes: float, dim: int
) -> None:
    record = codec.encoded_bytes(1, dim, "int8") - codec.encoded_bytes(0, dim, "int8")

    def cost(tokens: int) -> float:
        size = tokens * record
        return codec.streaming.PIECE_OVERHEAD_BYTES * link_bytes / size + size / 2

    best = codec.tokens_per_piece(link_bytes, dim, "int8")
    assert best >= 1
    assert cost(best) <= 1.1 * min(cost(max(1, best - 1)), cost(best + 1))


def test_a_payload_of_nothing_has_no_pieces() -> None:
    with pytest.raises(CodecError, match="at least 1"):
        codec.piece_ends(0, 8, "int8")
    with pytest.raises(CodecError, match="at least 1"):
        codec.piece_ends(3, 8, "int8", piece_tokens=0)
