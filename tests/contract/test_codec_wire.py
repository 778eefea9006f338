"""What the accounting promises is what a socket carries: a real server behind a counting proxy."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent import futures

import grpc
import numpy as np
import pytest
from http2_tap import DATA, HEADERS, WINDOW_UPDATE, Frame, Tap

from comvla import codec
from comvla.codec.wire import WRITE_BYTES
from comvla.v1 import policy_pb2, policy_pb2_grpc

TOKEN_DIM, TOWER_DIMS = 2176, (1024, 1152)
FIRST_CALL_BYTES = 300  # path, authority and user agent, spelled out once per connection


class Answering(policy_pb2_grpc.PolicyServiceServicer):
    """Answers with as many actions as the step number says."""

    def Infer(
        self, request: policy_pb2.InferRequest, context: grpc.ServicerContext
    ) -> policy_pb2.InferResponse:
        return policy_pb2.InferResponse(step=request.step, actions=[0.5] * request.step)


@pytest.fixture(scope="module")
def server_port() -> Iterator[int]:
    server = grpc.server(
        futures.ThreadPoolExecutor(2),
        options=[*codec.GRPC_OPTIONS, ("grpc.max_receive_message_length", 8 << 20)],
    )
    policy_pb2_grpc.add_PolicyServiceServicer_to_server(Answering(), server)
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    yield port
    server.stop(None).wait()


def request(k: int, quantization: str, seed: int, *, step: int = 1) -> policy_pb2.InferRequest:
    rng = np.random.default_rng(seed)
    tokens = rng.standard_normal((k, TOKEN_DIM)).astype(np.float32)
    payload = codec.encode(tokens, rng.permutation(512)[:k], quantization, tower_dims=TOWER_DIMS)
    return policy_pb2.InferRequest(
        session_id="robot-7/episode-12",
        step=step,
        instruction="pull the green drawer open",
        proprio=[0.25] * 8,
        payload=payload,
        model_fingerprint="0f" * 32,
        snr_db=7.5,
        snr_age_s=0.0,
        protocol_version=1,
    )


def call_all(
    port: int, requests: list[policy_pb2.InferRequest]
) -> tuple[list[list[Frame]], list[list[Frame]], list[policy_pb2.InferResponse]]:
    """Make the calls over one connection; frames up, frames down, answers."""
    with Tap(port) as tap, grpc.insecure_channel(tap.target, options=codec.GRPC_OPTIONS) as channel:
        stub = policy_pb2_grpc.PolicyServiceStub(channel)
        answers = [stub.Infer(request, timeout=20) for request in requests]
        return tap.calls("up"), tap.calls("down"), answers


def data_bytes(call: list[Frame]) -> int:
    return sum(frame.wire_bytes for frame in call if frame.kind == DATA)


@pytest.mark.parametrize("quantization", codec.QUANTIZATIONS)
def test_wire_bytes_is_what_the_socket_carried(server_port: int, quantization: str) -> None:
    room = WRITE_BYTES - FIRST_CALL_BYTES
    requests = [request(k, quantization, seed=k) for k in range(120)]
    requests = [r for r in requests if codec.wire_bytes(r.ByteSize()) <= room]
    assert len(requests) >= 15

    up, _, _ = call_all(server_port, requests)

    assert [data_bytes(call) for call in up] == [codec.wire_bytes(r.ByteSize()) for r in requests]


def test_wire_bytes_is_exact_around_every_frame_boundary(server_port: int) -> None:
    sizes = [
        frames * codec.HTTP2_FRAME_BYTES + off for frames in (1, 2, 7) for off in range(-16, 3)
    ]
    requests = [policy_pb2.InferRequest(payload=bytes(size)) for size in sizes]
    up, _, _ = call_all(server_port, requests)
    assert [data_bytes(call) for call in up] == [codec.wire_bytes(r.ByteSize()) for r in requests]


def test_answers_are_framed_the_same_way(server_port: int) -> None:
    requests = [policy_pb2.InferRequest(step=step) for step in (1, 56, 2048, 4093, 4096, 10_000)]
    _, down, answers = call_all(server_port, requests)
    assert [data_bytes(call) for call in down] == [codec.wire_bytes(a.ByteSize()) for a in answers]


def test_beyond_one_write_the_socket_carries_at_most_a_frame_header_more_per_write(
    server_port: int,
) -> None:
    requests = [request(k, q, seed=k) for k in (64, 128, 300, 512) for q in ("int8", "float32")]
    up, _, _ = call_all(server_port, requests)
    for call, sent in zip(up, requests, strict=True):
        promised = codec.wire_bytes(sent.ByteSize())
        writes = -(-promised // WRITE_BYTES)
        assert promised <= data_bytes(call) <= promised + 9 * writes


def test_request_wire_bytes_covers_a_whole_call_on_a_connection_in_use(server_port: int) -> None:
    tokens = [0, 1, 16, 32, 48, 59]
    requests = [request(k, "int8", seed=k, step=300) for k in tokens]
    up, _, _ = call_all(server_port, [requests[0], *requests])

    for k, call in zip(tokens, up[1:], strict=True):
        carried = sum(frame.wire_bytes for frame in call)
        promised = codec.request_wire_bytes(
            k,
            TOKEN_DIM,
            "int8",
            num_towers=2,
            session_id="robot-7/episode-12",
            step=300,
            instruction="pull the green drawer open",
            proprio_dim=8,
            model_fingerprint="0f" * 32,
        )
        assert carried <= promised <= carried + codec.CALL_HEADERS_BYTES
        assert {frame.kind for frame in call} == {HEADERS, DATA, WINDOW_UPDATE}


def test_the_first_call_of_a_connection_costs_a_few_hundred_bytes_more(server_port: int) -> None:
    up, _, _ = call_all(server_port, [request(1, "int8", seed=1)] * 2)
    first, second = (sum(f.wire_bytes for f in call if f.kind == HEADERS) for call in up)
    assert second <= codec.CALL_HEADERS_BYTES < first <= FIRST_CALL_BYTES
