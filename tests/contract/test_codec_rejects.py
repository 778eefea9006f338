"""Nonsense is refused with words that say what was expected, what came, and the remedy."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from comvla import codec
from comvla.errors import CodecError, ComVLAError


def tokens(count: int = 3, token_dim: int = 8) -> NDArray[np.float32]:
    rng = np.random.default_rng(count)
    return rng.standard_normal((count, token_dim)).astype(np.float32)


class Tensor:
    """Stands for a torch tensor, which the codec does not know."""


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (Tensor(), r"NumPy array, got Tensor.*numpy\(\)"),
        (tokens().tolist(), "NumPy array, got list"),
        (tokens().astype(np.float64), "float32, got float64.*astype"),
        (tokens().astype(np.int8), "float32, got int8"),
        (tokens()[0], r"\(K, D\), got \(8,\)"),
        (tokens()[None], r"\(K, D\), got \(1, 3, 8\)"),
        (np.empty((3, 0), np.float32), "1 to 65535 values"),
        (np.empty((3, 65_536), np.float32), "1 to 65535 values"),
        (np.empty((65_536, 1), np.float32), "at most 65535 tokens"),
    ],
)
def test_encode_refuses_tokens_of_the_wrong_kind(wrong: Any, words: str) -> None:
    with pytest.raises(CodecError, match=words):
        codec.encode(wrong, [0, 1, 2])


@pytest.mark.parametrize("quantization", codec.QUANTIZATIONS)
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_encode_refuses_values_that_are_not_finite(quantization: str, bad: float) -> None:
    spoilt = tokens()
    spoilt[1, 5] = bad
    with pytest.raises(CodecError, match="NaN or infinity in token 1"):
        codec.encode(spoilt, [0, 1, 2], quantization, tower_dims=(4, 4))


def test_encode_refuses_what_float16_cannot_hold_and_names_formats_that_can() -> None:
    with pytest.raises(CodecError, match=r"65504.*got 70000: use int8 or float32"):
        codec.encode(np.array([[1, -70_000]], np.float32), [0], "float16")


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ([0, 1], r"shape \(3,\), one per token, got int64 of shape \(2,\)"),
        ([[0, 1, 2]], r"shape \(1, 3\)"),
        ([], r"shape \(3,\), one per token"),
        ([0.0, 1.0, 2.0], "got float64"),
        ([True, False, True], "got bool"),
        (["0", "1", "2"], "integer positions"),
        ([[0], [1, 2]], "integer positions"),
        ([0, 1, 1 << 70], "integer positions"),
        ([0, 5, -1], "from 0 to 65534, got -1"),
        ([0, 5, 65_535], "from 0 to 65534, got 65535"),
        ([4, 9, 4], "got 4 twice"),
        (None, "integer positions"),
    ],
)
def test_encode_refuses_positions(wrong: Any, words: str) -> None:
    with pytest.raises(CodecError, match=words):
        codec.encode(tokens(), wrong)


@pytest.mark.parametrize("wrong", ["int3", "INT8", "", None, 8, ["int8"]])
def test_an_unknown_quantization_is_refused_with_those_known(wrong: Any) -> None:
    with pytest.raises(CodecError, match="float32, float16, int8, int4"):
        codec.encode(tokens(), [0, 1, 2], wrong)
    with pytest.raises(CodecError, match="float32, float16, int8, int4"):
        codec.bits_per_value(wrong)


@pytest.mark.parametrize("wrong", [(4, 3), (8, 0), (9, -1), (), (0.5, 7.5), "4", 8, [1] * 17])
def test_encode_refuses_towers_that_do_not_make_up_the_token(wrong: Any) -> None:
    with pytest.raises(CodecError, match="tower"):
        codec.encode(tokens(token_dim=17 if wrong == [1] * 17 else 8), [0, 1, 2], tower_dims=wrong)


def changed(payload: bytes, at: int, form: str, value: float) -> bytes:
    """The payload with one number overwritten."""
    damaged = bytearray(payload)
    struct.pack_into("<" + form, damaged, at, value)
    return bytes(damaged)


PAYLOAD = codec.encode(tokens(), [7, 0, 400], "int8", tower_dims=(3, 5))  # header 16, record 18
FLOATS = codec.encode(tokens(), [7, 0, 400], "float32")
HALVES = codec.encode(tokens(), [7, 0, 400], "float16")
NIBBLES = codec.encode(tokens(3, 7), [7, 0, 400], "int4")  # header 14, record 10


@pytest.mark.parametrize(
    ("payload", "words"),
    [
        (b"", "got 0 bytes: the payload is empty"),
        (PAYLOAD[:11], "got 11 bytes"),
        (PAYLOAD[:15], "header of 16 bytes, got 15"),
        (b"\x93NUMPY" + PAYLOAD, r"begins with b'CVLT', got b'\\x93NUM'"),
        (changed(PAYLOAD, 4, "B", 2), "version 1, got 2.*same ComVLA"),
        (changed(PAYLOAD, 5, "B", 0), "got 0: .*damaged"),
        (changed(PAYLOAD, 5, "B", 9), "got 9: .*newer"),
        (changed(PAYLOAD, 6, "B", 0), "1 to 16 vision towers"),
        (changed(PAYLOAD, 6, "B", 17), "1 to 16 vision towers"),
        (changed(PAYLOAD, 7, "B", 1), "zero byte"),
        (changed(PAYLOAD, 8, "H", 9), r"sum to token_dim 9, got \[3, 5\]"),
        (changed(PAYLOAD, 12, "H", 4), r"sum to token_dim 8, got \[4, 5\]"),
        (changed(changed(PAYLOAD, 12, "H", 0), 14, "H", 8), r"above 0 .* got \[0, 8\]"),
        (changed(PAYLOAD, 10, "H", 2), "2 tokens of 18 bytes each, got 18 bytes more"),
        (PAYLOAD + b"\0", "got 1 bytes more"),
        (changed(PAYLOAD, 16, "H", 65_535), "positions from 0 to 65534, got 65535"),
        (changed(PAYLOAD, 16, "H", 400), "got 400 twice"),
        (changed(PAYLOAD, 18, "f", np.nan), "positive, finite scales.*nan.*token 0"),
        (changed(PAYLOAD, 36, "f", np.inf), "positive, finite scales.*inf.*token 1"),
        (changed(PAYLOAD, 18, "f", -1), "positive, finite scales"),
        (changed(PAYLOAD, 18, "f", 0), "positive, finite scales"),
        (changed(PAYLOAD, 26, "b", -128), "got -128"),
        (changed(FLOATS, 16, "f", np.nan), "got NaN or infinity in token 0"),
        (changed(FLOATS, 16, "f", -np.inf), "got NaN or infinity in token 0"),
        (changed(HALVES, 16, "e", np.inf), "got NaN or infinity in token 0"),
        (changed(NIBBLES, 16, "f", np.nan), "positive, finite scales"),
        (changed(NIBBLES, 16, "f", -0.5), "positive, finite scales"),
        (changed(NIBBLES, 23, "B", 0x10), "half byte"),
        ("CVLT", "bytes, got str"),
        (None, "bytes, got NoneType"),
        (np.frombuffer(PAYLOAD, np.uint8), "bytes, got ndarray"),
        (memoryview(PAYLOAD + PAYLOAD)[::2], "contiguous"),
    ],
    ids=lambda value: value if isinstance(value, str) else type(value).__name__,
)
def test_decode_refuses_what_encode_does_not_write(payload: Any, words: str) -> None:
    with pytest.raises(CodecError, match=words):
        codec.decode(payload)


def test_decode_refuses_what_does_not_fit_the_model() -> None:
    with pytest.raises(CodecError, match=r"token_dim 2176, got .* 8: load the edge half"):
        codec.decode(PAYLOAD, token_dim=2176)
    with pytest.raises(CodecError, match=r"at most 2 tokens \(max_tokens\), got .* 3"):
        codec.decode(PAYLOAD, max_tokens=2)
    with pytest.raises(CodecError, match=r"at most 2 tokens \(num_tokens\)"):
        codec.decode(PAYLOAD, num_tokens=2)
    with pytest.raises(CodecError, match="from 0 to 399, got 400"):
        codec.decode(PAYLOAD, num_tokens=400)
    decoded, _ = codec.decode(PAYLOAD, max_tokens=3, token_dim=8, num_tokens=401)
    assert decoded.shape == (3, 8)


def test_codec_errors_are_value_errors_and_comvla_errors() -> None:
    assert issubclass(CodecError, ValueError)
    assert issubclass(CodecError, ComVLAError)
