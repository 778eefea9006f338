"""The paper's bytes are reproduced, and the exact ones are exact."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from comvla import codec
from comvla.errors import CodecError
from comvla.v1 import policy_pb2

KIB = 1024
quantizations = st.sampled_from(codec.QUANTIZATIONS)


@pytest.mark.parametrize(
    ("k", "kib"), [(512, 1088.0), (128, 272.0), (64, 136.0), (48, 102.0), (32, 68.0), (16, 34.0)]
)
def test_payload_bytes_reproduces_the_tx_column_of_table_1(k: int, kib: float) -> None:
    assert codec.payload_bytes(k, 2176, "int8") / KIB == kib


@pytest.mark.parametrize(
    ("quantization", "kib"),
    [("float32", 272.0), ("float16", 136.0), ("int8", 68.0), ("int4", 34.0)],
)
def test_payload_bytes_reproduces_the_tx_column_of_table_4(quantization: str, kib: float) -> None:
    """FP16, INT8 and INT4 are the paper's rows; float32 follows from the same formula."""
    assert codec.payload_bytes(32, 2176, quantization) / KIB == kib


def test_bits_per_value_are_those_of_equation_4() -> None:
    assert [codec.bits_per_value(name) for name in codec.QUANTIZATIONS] == [32, 16, 8, 4]


def test_an_odd_number_of_half_bytes_is_rounded_up() -> None:
    assert codec.payload_bytes(3, 5, "int4") == 8
    assert codec.payload_bytes(2, 5, "int4") == 5


@settings(deadline=None)
@given(st.integers(0, 40), st.lists(st.integers(1, 30), min_size=1, max_size=16), quantizations)
def test_encoded_bytes_is_the_length_of_what_encode_writes(
    k: int, towers: list[int], quantization: str
) -> None:
    token_dim = sum(towers)
    payload = codec.encode(
        np.ones((k, token_dim), np.float32), range(k), quantization, tower_dims=towers
    )
    assert len(payload) == codec.encoded_bytes(k, token_dim, quantization, num_towers=len(towers))


@settings(deadline=None)
@given(st.integers(0, 2_000_000), st.integers(1, 4096), quantizations, st.integers(1, 16))
def test_prefix_tokens_inverts_encoded_bytes(
    nbytes: int, token_dim: int, quantization: str, num_towers: int
) -> None:
    def size(k: int) -> int:
        return codec.encoded_bytes(k, token_dim, quantization, num_towers=num_towers)

    k = codec.prefix_tokens(nbytes, token_dim, quantization, num_towers=num_towers)
    assert size(k) <= max(nbytes, size(0)) < size(k + 1)


texts = st.text(st.characters(exclude_categories=["Cs"]), max_size=200)


@settings(deadline=None)
@given(
    payload=st.integers(0, 40_000),
    session_id=texts,
    step=st.integers(0, 2**64 - 1) | st.integers(0, 300),
    instruction=texts,
    proprio=st.lists(st.floats(width=32), max_size=40),
    fingerprint=texts,
    snr_db=st.none() | st.floats(width=32),
    snr_age_s=st.none() | st.just(0.0),
    protocol_version=st.integers(0, 2**32 - 1),
    model=texts,
)
def test_infer_request_bytes_is_the_serialised_length(
    payload: int,
    session_id: str,
    step: int,
    instruction: str,
    proprio: list[float],
    fingerprint: str,
    snr_db: float | None,
    snr_age_s: float | None,
    protocol_version: int,
    model: str,
) -> None:
    request = policy_pb2.InferRequest(
        session_id=session_id,
        step=step,
        instruction=instruction,
        proprio=proprio,
        payload=bytes(payload),
        model_fingerprint=fingerprint,
        snr_db=snr_db,
        snr_age_s=snr_age_s,
        protocol_version=protocol_version,
        model=model,
    )
    assert len(request.SerializeToString()) == codec.infer_request_bytes(
        payload,
        session_id=session_id,
        step=step,
        instruction=instruction,
        proprio_dim=len(proprio),
        model_fingerprint=fingerprint,
        snr=snr_db is not None,
        snr_age=snr_age_s is not None,
        protocol_version=protocol_version,
        model=model,
    )


def test_infer_request_bytes_knows_every_field_and_the_length_of_its_tag() -> None:
    """A new field must be added to the accounting, and a number above 15 takes a longer tag."""
    fields = policy_pb2.InferRequest.DESCRIPTOR.fields
    assert {field.name for field in fields} == {
        "session_id",
        "step",
        "instruction",
        "proprio",
        "payload",
        "model_fingerprint",
        "snr_db",
        "snr_age_s",
        "protocol_version",
        "images",
        "model",
    }
    assert {field.name for field in fields if field.number > 15} == {"model"}


def test_request_wire_bytes_composes_payload_message_and_frames() -> None:
    message = codec.infer_request_bytes(
        codec.encoded_bytes(32, 2176, "int8", num_towers=2), instruction="open the drawer"
    )
    total = codec.request_wire_bytes(32, 2176, "int8", num_towers=2, instruction="open the drawer")
    assert total == codec.wire_bytes(message) + codec.CALL_HEADERS_BYTES


@settings(deadline=None)
@given(st.integers(0, 600), quantizations)
def test_request_wire_bytes_grows_with_every_token(k: int, quantization: str) -> None:
    for tcp_ip in (False, True):
        more = codec.request_wire_bytes(k + 1, 2176, quantization, tcp_ip=tcp_ip)
        assert more > codec.request_wire_bytes(k, 2176, quantization, tcp_ip=tcp_ip)


@pytest.mark.parametrize(
    ("message", "framed"),
    [(0, 5 + 9), (16_379, 16_384 + 9), (16_380, 16_385 + 18), (69_992, 69_997 + 5 * 9)],
)
def test_framing_is_a_prefix_and_a_header_for_each_16_kib(message: int, framed: int) -> None:
    assert codec.wire_bytes(message) == framed


@pytest.mark.parametrize(
    ("message", "segments"), [(0, 1), (1_448 - 14, 1), (1_448 - 13, 2), (2 * 1_448 - 14, 2)]
)
def test_tcp_ip_adds_52_bytes_to_each_segment_of_1448(message: int, segments: int) -> None:
    bare = codec.wire_bytes(message)
    assert codec.wire_bytes(message, tcp_ip=True) == bare + 52 * segments
    assert codec.wire_bytes(message, tcp_ip=True, mtu_bytes=9000) == bare + 52


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: codec.payload_bytes(-1, 8, "int8"), "k of at least 0, got -1"),
        (lambda: codec.payload_bytes(1, 0, "int8"), "token_dim of at least 1, got 0"),
        (lambda: codec.payload_bytes(1, 8, "int5"), "quantization out of"),
        (lambda: codec.payload_bytes(1.5, 8, "int8"), "integer k, got 1.5"),
        (lambda: codec.encoded_bytes(1, 8, "int8", num_towers=0), "num_towers of at least 1"),
        (lambda: codec.encoded_bytes(1, 8, "int8", num_towers=17), "num_towers up to 16, got 17"),
        (lambda: codec.prefix_tokens(-1, 8, "int8"), "nbytes of at least 0"),
        (lambda: codec.wire_bytes(-1), "message_bytes of at least 0"),
        (lambda: codec.wire_bytes(9, tcp_ip=True, mtu_bytes=52), "MTU above 52 bytes, got 52"),
        (lambda: codec.infer_request_bytes(9, step=-1), "at least 0, got 9, -1, 0, 1 and 0"),
        (lambda: codec.request_wire_bytes(-1, 8, "int8"), "k of at least 0"),
    ],
)
def test_sizes_that_cannot_be_are_refused(call, words: str) -> None:
    with pytest.raises(CodecError, match=words):
        call()


def test_the_codec_needs_numpy_alone() -> None:
    """A tool that reads payloads off a capture loads neither gRPC nor protobuf nor torch."""
    probe = "import sys, comvla.codec; print(*sorted(sys.modules))"
    loaded = subprocess.run(
        [sys.executable, "-c", probe], capture_output=True, text=True, check=True
    ).stdout.split()
    assert "numpy" in loaded
    assert not {"grpc", "google.protobuf", "torch"} & set(loaded)
