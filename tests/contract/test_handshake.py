"""Robot and server find out before anything moves whether their halves belong together."""

from __future__ import annotations

import dataclasses
import random
from typing import Any

import pytest
from google.protobuf.message import DecodeError

from comvla import codec, handshake
from comvla.errors import HandshakeError
from comvla.model_info import PROTOCOL_VERSION, ModelInfo
from comvla.v1 import policy_pb2

OFT = ModelInfo(
    name="openvla-oft",
    fingerprint="5f" * 32,
    num_tokens=512,
    token_dim=2176,
    tower_dims=(1024, 1152),
    grid=(2, 16, 16),
    image_size=(224, 224),
    action_horizon=8,
    action_dim=7,
    proprio_dim=8,
    max_prompt_tokens=64,
    delta_actions=(True,) * 6 + (False,),
    control_period_s=0.05,
)
MINI = dataclasses.replace(
    OFT,
    name="comvla-mini",
    fingerprint="a0" * 32,
    token_dim=96,
    tower_dims=(96,),
    action_dim=4,
    delta_actions=(True, True, True, False),
    proprio_dim=4,
)


def respond(info: ModelInfo = OFT, **changes: Any) -> policy_pb2.GetModelResponse:
    """What a server of ``info`` answers, with some fields made wrong."""
    response = handshake.to_response(
        info, quantizations=codec.QUANTIZATIONS, max_request_bytes=1 << 21, server_version="0.1.0"
    )
    for name, value in changes.items():
        response.ClearField(name)
        response.MergeFrom(policy_pb2.GetModelResponse(**{name: value}))
    return response


@pytest.mark.parametrize("info", [OFT, MINI], ids=lambda info: info.name)
def test_a_description_survives_the_wire(info: ModelInfo) -> None:
    sent = respond(info).SerializeToString()
    received = policy_pb2.GetModelResponse.FromString(sent)
    assert handshake.from_response(received) == info
    assert received.protocol_version == PROTOCOL_VERSION
    assert received.max_request_bytes == 1 << 21
    assert received.server_version == "0.1.0"


def test_run_options_are_told_and_a_strangers_are_read_with_care() -> None:
    told = ("dtype=bfloat16", handshake.COMPACT_POSITIONS, "fastv=3,0.75")
    response = handshake.to_response(
        OFT,
        quantizations=codec.QUANTIZATIONS,
        max_request_bytes=1 << 21,
        server_version="0.1.0",
        run_options=told,
    )
    assert handshake.run_options(response) == told
    assert handshake.run_options(respond()) == ()
    hostile = respond(run_options=["\x1b[2J", "", "x" * 10_000, "dtype=float16", *["a"] * 99])
    assert handshake.run_options(hostile)[0] == "dtype=float16"
    assert len(handshake.run_options(hostile)) <= 32
    assert handshake.from_response(hostile) == OFT


def test_halves_of_one_checkpoint_match_whatever_they_are_called() -> None:
    assert handshake.mismatch(OFT, OFT) is None
    assert handshake.mismatch(dataclasses.replace(OFT, name="my-copy"), OFT) is None


def test_a_mismatch_is_told_in_words_with_a_remedy() -> None:
    assert handshake.mismatch(MINI, OFT) == (
        "server expects token_dim 2176 (openvla-oft), client sends 96 (comvla-mini): "
        "load the edge half of the same checkpoint"
    )


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("token_dim", 1024, "token_dim 2176 .* sends 1024"),
        ("tower_dims", (1152, 1024), r"tower_dims \[1024, 1152\] .* sends \[1152, 1024\]"),
        ("num_tokens", 256, "num_tokens 512 .* sends 256"),
        ("grid", (1, 16, 32), r"grid \[2, 16, 16\] .* sends \[1, 16, 32\]"),
        ("image_size", (256, 256), r"image_size \[224, 224\] .* sends \[256, 256\]"),
        ("action_dim", 6, "action_dim 7 .* sends 6"),
        ("action_horizon", 16, "action_horizon 8 .* sends 16"),
        ("proprio_dim", 0, "proprio_dim 8 .* sends 0"),
        ("max_prompt_tokens", 32, "max_prompt_tokens 64 .* sends 32"),
        ("delta_actions", (True,) * 7, "delta_actions .* sends"),
        ("control_period_s", 0.1, "control_period_s 0.05 .* sends 0.1"),
        ("fingerprint", "00" * 32, f"fingerprint {'5f' * 32} .*the weights do not"),
    ],
)
def test_every_difference_is_found_and_named(field: str, value: Any, words: str) -> None:
    edge = dataclasses.replace(OFT, **{field: value})
    assert_words = handshake.mismatch(edge, OFT)
    assert assert_words is not None
    with pytest.raises(HandshakeError, match=f"server expects {words}.*same checkpoint"):
        raise HandshakeError(assert_words)


def test_every_field_but_the_name_is_compared() -> None:
    for field in dataclasses.fields(ModelInfo):
        other = dataclasses.replace(OFT, **{field.name: object()})
        assert (handshake.mismatch(other, OFT) is None) == (field.name == "name"), field.name


@pytest.mark.parametrize("version", [0, 2, 4_000_000_000])
def test_another_protocol_version_stops_the_handshake(version: int) -> None:
    with pytest.raises(HandshakeError, match=f"version 1, server answers with {version}: install"):
        handshake.from_response(respond(protocol_version=version))


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("model_name", "", "model_name as printable text, got ''"),
        ("model_name", "mini\x1b[2J", "model_name as printable text"),
        ("model_name", "x" * 201, "model_name as printable text"),
        ("model_fingerprint", "", "model_fingerprint as printable text"),
        ("num_tokens", 0, "num_tokens as 1 to 65535, got 0"),
        ("num_tokens", 65_536, "num_tokens as 1 to 65535, got 65536"),
        ("token_dim", 0, "token_dim as 1 to 65535, got 0"),
        ("action_horizon", 0, "action_horizon as 1 to"),
        ("action_dim", 4_000_000_000, "action_dim as 1 to"),
        ("max_prompt_tokens", 0, "max_prompt_tokens as 1 to"),
        ("proprio_dim", 70_000, "proprio_dim as 0 to"),
        ("control_period_s", 0.0, "control_period_s as a positive time, got 0.0"),
        ("control_period_s", float("nan"), "control_period_s as a positive time, got nan"),
        ("control_period_s", float("inf"), "control_period_s as a positive time, got inf"),
        ("tower_dims", [], "tower_dims as 1 to 16 widths that sum to token_dim 2176"),
        ("tower_dims", [1024, 1024], r"sum to token_dim 2176, got \(1024, 1024\)"),
        ("tower_dims", [2176, 0], "tower_dims"),
        ("tower_dims", [128] * 17, "tower_dims"),
        ("grid", [2, 16], "product is num_tokens 512"),
        ("grid", [2, 16, 15], r"product is num_tokens 512, got \(2, 16, 15\)"),
        ("grid", [1 << 31] * 50_000, "grid"),
        ("image_size", [224], "image_size as height and width"),
        ("image_size", [224, 0], "image_size as height and width"),
        ("delta_actions", [True] * 6, "one for each of 7 action dimensions"),
    ],
)
def test_a_description_that_contradicts_itself_is_refused(
    field: str, value: Any, words: str
) -> None:
    with pytest.raises(HandshakeError, match=words) as caught:
        handshake.from_response(respond(**{field: value}))
    assert len(str(caught.value)) < 500  # a stranger does not get to fill the log


def test_quantizations_are_offered_by_name_and_newer_ones_are_left_out() -> None:
    response = respond()
    assert handshake.offered_quantizations(response) == codec.QUANTIZATIONS
    response.quantizations.extend([0, 99])
    assert handshake.offered_quantizations(response) == codec.QUANTIZATIONS


def test_a_quantization_that_the_server_does_not_read_is_told_in_words() -> None:
    assert handshake.quantization_mismatch("int8", ("float16", "int8")) is None
    assert handshake.quantization_mismatch("int4", ("float16", "int8")) == (
        "server reads quantization float16, int8, client sends int4: choose one that the server "
        "reads"
    )
    assert "none known here" in str(handshake.quantization_mismatch("int4", ()))


def test_a_server_cannot_offer_a_quantization_that_the_protocol_does_not_know() -> None:
    with pytest.raises(ValueError, match="INT3"):
        handshake.to_response(
            OFT, quantizations=("int3",), max_request_bytes=1, server_version="0.1.0"
        )


def test_ten_thousand_damaged_answers_are_read_or_refused() -> None:
    rng = random.Random(3)
    sound = respond().SerializeToString()
    outcomes = {"read": 0, "refused": 0}
    for _ in range(10_000):
        damaged = bytearray(sound)
        for _ in range(rng.randint(1, 3)):
            damaged[rng.randrange(len(damaged))] = rng.randrange(256)
        try:
            response = policy_pb2.GetModelResponse.FromString(bytes(damaged))
        except DecodeError:
            continue
        try:
            info = handshake.from_response(response)
        except HandshakeError:
            outcomes["refused"] += 1
        else:
            outcomes["read"] += 1
            assert sum(info.tower_dims) == info.token_dim
            handshake.mismatch(OFT, info)
            handshake.offered_quantizations(response)
    assert min(outcomes.values()) > 500, outcomes
