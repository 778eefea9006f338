"""What the server refuses before it costs compute, and how it says so."""

from __future__ import annotations

import dataclasses
import math
import string
from typing import Any
from urllib.parse import quote

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from server_stubs import STUB_INFO, StubCloud, message

from comvla import codec
from comvla_server.engine import Engine
from comvla_server.refusals import Reason, Refusal
from comvla_server.validation import Validator, content_digest
from comvla_server.wording import MAX_ENCODED_BYTES, MAX_MESSAGE_CHARS, one_line, shown

# What gRPC leaves as it is in a status message.
PRINTABLE = "".join(c for c in string.printable if " " <= c <= "~" and c != "%")
VALIDATOR = Validator(Engine(StubCloud()), max_request_bytes=4096)


def refusal(**changes: Any) -> Refusal:
    """Why a request with these changes is not read."""
    request = message(**changes)

    def check() -> None:
        VALIDATOR.check_identity(request)
        VALIDATOR.read(request)

    with pytest.raises(Refusal) as caught:
        check()
    return caught.value


def payload(tokens: Any = None, positions: Any = (0, 1), **options: Any) -> bytes:
    if tokens is None:
        tokens = np.ones((len(positions), STUB_INFO.token_dim), np.float32)
    return codec.encode(np.asarray(tokens, np.float32), positions, "float32", **options)


def nan_payload(value: float) -> bytes:
    """A float32 payload in which one value was replaced on the wire."""
    encoded = bytearray(payload())
    encoded[-4:] = np.float32(value).tobytes()
    return bytes(encoded)


def test_a_valid_request_becomes_what_the_model_needs() -> None:
    request = VALIDATOR.read(message(k=5, name=0.25))
    assert request.tokens.shape == (5, STUB_INFO.token_dim)
    assert request.tokens.dtype == np.float32
    assert request.positions.shape == (5,)
    assert request.instruction == "open it"
    np.testing.assert_array_equal(request.proprio, np.float32([0.25, 0.0]))


@pytest.mark.parametrize("quantization", codec.QUANTIZATIONS)
def test_every_quantization_is_read(quantization: str) -> None:
    assert len(VALIDATOR.read(message(quantization=quantization)).positions) == 3


def test_a_payload_cut_on_the_link_is_read_as_the_tokens_that_arrived() -> None:
    whole = message(k=4)
    cut = message(k=4, payload=whole.payload[:-1])
    np.testing.assert_array_equal(VALIDATOR.read(cut).tokens, VALIDATOR.read(whole).tokens[:3])


@pytest.mark.parametrize(
    ("changes", "reason", "words"),
    [
        ({"protocol_version": 9}, Reason.MISMATCH, ("version 1", "9", "same comvla release")),
        ({"protocol_version": 0}, Reason.MISMATCH, ("version 1", "0", "same comvla release")),
        (
            {"model_fingerprint": "beef"},
            Reason.MISMATCH,
            ("f00d", "beef", "edge half of the same checkpoint"),
        ),
        ({"model_fingerprint": ""}, Reason.MISMATCH, ("f00d", "''", "edge half")),
        ({"payload": b"x" * 5000}, Reason.OVERSIZE, ("at most 4096 bytes", "fewer tokens")),
        ({"session": ""}, Reason.INVALID, ("session_id of 1 to 128", "''", "UUID")),
        ({"session": "s" * 129}, Reason.INVALID, ("1 to 128", "129 characters", "UUID")),
        ({"session": "a\nERROR forged"}, Reason.INVALID, ("session_id", r"a\nERROR forged")),
        ({"session": "робот"}, Reason.INVALID, ("session_id", r"\u0440")),
        ({"instruction": ""}, Reason.INVALID, ("instruction is empty", "say what")),
        ({"instruction": "  "}, Reason.INVALID, ("instruction is empty", "say what")),
        ({"instruction": "a zebra"}, Reason.INVALID, ("'a zebra'", "never saw")),
        ({"instruction": "x" * 2001}, Reason.INVALID, ("at most 2000", "2001", "fewer words")),
        ({"proprio": [0.0]}, Reason.INVALID, ("expected 2", "got 1", "raw vector")),
        ({"proprio": []}, Reason.INVALID, ("expected 2", "got 0", "raw vector")),
        ({"proprio": [0.0, math.nan]}, Reason.INVALID, ("finite proprioception", "nan")),
        ({"proprio": [0.0, -math.inf]}, Reason.INVALID, ("finite proprioception", "inf")),
        ({"proprio": [0.0, 1e30]}, Reason.INVALID, ("proprioception", "65504", "1e+30")),
        ({"snr_db": math.nan}, Reason.INVALID, ("finite snr_db", "nan", "unset")),
        ({"snr_db": math.inf}, Reason.INVALID, ("finite snr_db", "inf", "unset")),
        ({"snr_age_s": -1.0}, Reason.INVALID, ("snr_age_s of at least 0", "-1", "monotonic")),
        ({"snr_age_s": math.nan}, Reason.INVALID, ("finite snr_age_s", "nan", "monotonic")),
        ({"payload": b""}, Reason.INVALID, ("payload", "0 bytes")),
        ({"payload": b"junk" * 10}, Reason.INVALID, ("payload", "junk")),
        ({"k": 0}, Reason.INVALID, ("expected 1 to 16 tokens", "got none", "last chunk")),
        (
            {"payload": payload(positions=range(17))},
            Reason.INVALID,
            ("at most 16", "17"),
        ),
        ({"payload": payload(positions=(0, 16))}, Reason.INVALID, ("from 0 to 15", "16")),
        (
            {"payload": payload(np.ones((2, 6)))},
            Reason.INVALID,
            ("token_dim 8", "token_dim 6", "edge half of the same checkpoint"),
        ),
        ({"payload": nan_payload(math.nan)}, Reason.INVALID, ("finite",)),
        ({"payload": nan_payload(-math.inf)}, Reason.INVALID, ("finite",)),
        ({"payload": nan_payload(1e30)}, Reason.INVALID, ("65504", "1e+30", "overflow")),
    ],
)
def test_a_refusal_names_what_was_expected_what_came_and_the_remedy(
    changes: dict[str, Any], reason: Reason, words: tuple[str, ...]
) -> None:
    refused = refusal(**changes)
    assert refused.reason is reason
    for word in words:
        assert word in refused.message


def test_repeated_positions_are_refused() -> None:
    encoded = bytearray(payload(positions=(0, 1)))
    record = (len(encoded) - len(payload(positions=()))) // 2
    encoded[-record : -record + 2] = (0).to_bytes(2, "little")
    assert "each position once" in refusal(payload=bytes(encoded)).message


def test_an_unknown_quantization_is_refused() -> None:
    encoded = bytearray(payload())
    encoded[5] = 77
    assert "77" in refusal(payload=bytes(encoded)).message


def test_a_model_without_proprioception_takes_none() -> None:
    info = dataclasses.replace(STUB_INFO, proprio_dim=0)
    validator = Validator(Engine(StubCloud(info)), max_request_bytes=4096)
    without = message(proprio=[])
    validator.check_identity(without)
    assert validator.read(without).proprio is None
    with pytest.raises(Refusal, match="expected no proprioception, got 1 values"):
        validator.check_identity(message(proprio=[0.5]))


def test_a_missing_link_report_is_fine() -> None:
    request = message()
    request.ClearField("snr_db")
    request.ClearField("snr_age_s")
    assert len(VALIDATOR.read(request).positions) == 3


@given(st.text(max_size=20), st.lists(st.floats(width=32), max_size=4), st.binary(max_size=40))
def test_the_digest_is_over_the_content_alone(
    instruction: str, proprio: list[float], content: bytes
) -> None:
    fields: dict[str, Any] = {"proprio": proprio, "payload": content}
    one = message(instruction=instruction, snr_age_s=0.1, **fields)
    two = message(instruction=instruction, snr_age_s=0.2, session="other", step=7, **fields)
    assert content_digest(one) == content_digest(two)
    assert content_digest(one) != content_digest(message(instruction=instruction + "x", **fields))
    fields["payload"] = content + b"x"
    assert content_digest(one) != content_digest(message(instruction=instruction, **fields))


@given(st.text())
def test_text_from_strangers_stays_on_one_printable_line(text: str) -> None:
    assert shown(text).isprintable()
    assert len(shown(text)) < 10 * 64 + 40
    line = one_line(text)
    assert len(line) <= MAX_MESSAGE_CHARS
    assert all(c.isprintable() for c in line)
    message = Refusal(Reason.INVALID, text * 50).message
    assert len(message) <= MAX_MESSAGE_CHARS
    assert len(quote(message, safe=PRINTABLE, errors="replace")) <= MAX_ENCODED_BYTES
