"""Tokens survive the codec: within the error each format promises, in order, prefix by prefix."""

from __future__ import annotations

import itertools
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from comvla import codec
from comvla.errors import CodecError

TINY = np.finfo(np.float32).tiny
HALF_STEP = 0.5 + 1e-4  # the rest is float32 rounding, at most 127 units in the last place


@st.composite
def token_sets(
    draw: st.DrawFn, *, largest: float = float(np.finfo(np.float32).max)
) -> tuple[NDArray[np.float32], NDArray[np.int64], tuple[int, ...]]:
    """Any finite tokens, positions in any order, and towers that divide the width anyhow."""
    towers = tuple(draw(st.lists(st.integers(1, 9), min_size=1, max_size=4)))
    count = draw(st.integers(0, 6))
    bound = float(np.float32(largest))
    values = st.floats(-bound, bound, allow_nan=False, width=32) | st.floats(-4, 4, width=32)
    tokens = draw(hnp.arrays(np.float32, (count, sum(towers)), elements=values))
    spots = st.integers(0, codec.MAX_TOKENS - 1)
    positions = draw(st.lists(spots, min_size=count, max_size=count, unique=True))
    return tokens, np.array(positions, np.int64), towers


def tower_columns(tower_dims: tuple[int, ...]) -> list[slice]:
    stops = np.cumsum(tower_dims)
    return [slice(stop - width, stop) for stop, width in zip(stops, tower_dims, strict=True)]


def features(count: int, seed: int = 0) -> NDArray[np.float32]:
    """Like a vision tower's features: two scales, a few massive channels."""
    rng = np.random.default_rng(seed)
    tokens = rng.standard_normal((count, 2176)).astype(np.float32)
    tokens[:, :1024] *= 4
    tokens[:, [7, 1500]] *= 300
    return tokens


@settings(deadline=None)
@given(token_sets())
def test_float32_is_lossless(case: tuple) -> None:
    tokens, positions, towers = case
    decoded, places = codec.decode(codec.encode(tokens, positions, "float32", tower_dims=towers))
    np.testing.assert_array_equal(decoded, tokens)
    np.testing.assert_array_equal(places, positions)
    assert (decoded.dtype, places.dtype) == (np.float32, np.int32)


@settings(deadline=None)
@given(token_sets(largest=65504))
def test_float16_rounds_to_the_nearest_half(case: tuple) -> None:
    tokens, positions, towers = case
    decoded, places = codec.decode(codec.encode(tokens, positions, "float16", tower_dims=towers))
    bound = np.maximum(np.abs(tokens.astype(float)) * 2**-11, 2.0**-25)
    assert (np.abs(decoded.astype(float) - tokens) <= bound).all()
    np.testing.assert_array_equal(places, positions)


@settings(deadline=None)
@given(token_sets())
def test_int8_errs_by_half_a_step_of_each_token_and_tower(case: tuple) -> None:
    tokens, positions, towers = case
    decoded, places = codec.decode(codec.encode(tokens, positions, "int8", tower_dims=towers))
    assert np.isfinite(decoded).all()
    for columns in tower_columns(towers):
        exact = tokens[:, columns].astype(float)
        step = np.abs(exact).max(axis=1, keepdims=True) / 127
        error = np.abs(decoded[:, columns] - exact)
        assert (error <= np.maximum(step, TINY) * HALF_STEP).all()
    np.testing.assert_array_equal(places, positions)


@settings(deadline=None)
@given(token_sets())
def test_int4_errs_by_half_a_step_of_each_token_and_has_16_levels(case: tuple) -> None:
    tokens, positions, towers = case
    decoded, places = codec.decode(codec.encode(tokens, positions, "int4", tower_dims=towers))
    assert np.isfinite(decoded).all()
    exact = tokens.astype(float)
    step = np.maximum(exact.max(axis=1) / 7, exact.min(axis=1) / -8)[:, None]
    assert (np.abs(decoded - exact) <= np.maximum(step, TINY) * HALF_STEP).all()
    assert all(len(np.unique(token)) <= 16 for token in decoded)
    np.testing.assert_array_equal(places, positions)


def test_int4_uses_all_of_its_16_levels() -> None:
    ramp = np.linspace(-8, 7, 3000, dtype=np.float32)[None]
    decoded, _ = codec.decode(codec.encode(ramp, [0], "int4"))
    np.testing.assert_allclose(np.unique(decoded), np.arange(-8, 8), atol=1e-5)


def test_rounding_past_the_end_of_float32_comes_back_to_it() -> None:
    """The scale that holds 3.4e38 puts level -8 beyond float32; so does a damaged scale."""
    tokens = np.array([[3.4e38, -3.4e38, 1e38]], np.float32)
    decoded, _ = codec.decode(codec.encode(tokens, [0], "int4"))
    np.testing.assert_allclose(decoded.astype(float), tokens.astype(float), atol=3.4e38 / 14)
    damaged = bytearray(codec.encode(tokens, [0], "int8"))
    damaged[19] = 0x7F  # the scale's highest byte
    assert np.abs(codec.decode(damaged)[0]).max() == np.finfo(np.float32).max


def test_a_quiet_tower_keeps_its_resolution_beside_a_loud_one() -> None:
    loud_and_quiet = np.array([[1000, -500, 0.001, -0.002]], np.float32)
    split, _ = codec.decode(codec.encode(loud_and_quiet, [0], "int8", tower_dims=(2, 2)))
    whole, _ = codec.decode(codec.encode(loud_and_quiet, [0], "int8"))
    np.testing.assert_allclose(split[0, 2:], loud_and_quiet[0, 2:], atol=0.002 / 127)
    np.testing.assert_array_equal(whole[0, 2:], 0)


@pytest.mark.parametrize(
    ("quantization", "extreme"),
    [
        *itertools.product(("float32", "int8", "int4"), (np.finfo(np.float32).max, 3e38)),
        *itertools.product(codec.QUANTIZATIONS, (65504, 1e-38, 1e-45, 0)),
    ],
)
def test_the_ends_of_the_float_range_are_no_special_case(quantization: str, extreme: float) -> None:
    tokens = np.array([[extreme, -extreme, extreme / 3, 0]], np.float32)
    with np.errstate(all="raise"):  # a caller's own settings do not matter either
        decoded, _ = codec.decode(codec.encode(tokens, [0], quantization))
    atol = {"float32": 0, "float16": extreme / 2048, "int8": extreme / 250, "int4": extreme / 13}
    np.testing.assert_allclose(
        decoded.astype(float), tokens.astype(float), rtol=0, atol=atol[quantization] + 2.0**-25
    )


@pytest.mark.parametrize("quantization", codec.QUANTIZATIONS)
def test_any_prefix_gives_the_tokens_that_arrived_whole(quantization: str) -> None:
    rng = np.random.default_rng(1)
    tokens = rng.standard_normal((7, 11)).astype(np.float32)
    positions = rng.permutation(500)[:7]
    payload = codec.encode(tokens, positions, quantization, tower_dims=(4, 7))
    whole, places = codec.decode(payload)
    head = codec.encoded_bytes(0, 11, quantization, num_towers=2)
    for length in range(len(payload) + 1):
        if length < head:
            with pytest.raises(CodecError, match="header"):
                codec.decode(payload[:length])
            continue
        some, some_places = codec.decode(payload[:length])
        kept = codec.prefix_tokens(length, 11, quantization, num_towers=2)
        assert some.shape == (kept, 11)
        np.testing.assert_array_equal(some, whole[:kept])
        np.testing.assert_array_equal(some_places, places[:kept])


@pytest.mark.parametrize("quantization", codec.QUANTIZATIONS)
def test_tokens_do_not_influence_each_other(quantization: str) -> None:
    tokens = features(9)
    together, _ = codec.decode(
        codec.encode(tokens, range(9), quantization, tower_dims=(1024, 1152))
    )
    for index in range(9):
        alone, _ = codec.decode(
            codec.encode(tokens[index : index + 1], [index], quantization, tower_dims=(1024, 1152))
        )
        np.testing.assert_array_equal(alone[0], together[index])


@settings(max_examples=30, deadline=None)
@given(st.permutations(range(8)), st.sampled_from(codec.QUANTIZATIONS))
def test_order_is_kept(order: list[int], quantization: str) -> None:
    tokens = np.arange(8, dtype=np.float32)[order, None] * np.ones((1, 3), np.float32)
    decoded, positions = codec.decode(codec.encode(tokens, order, quantization))
    assert positions.tolist() == order
    np.testing.assert_allclose(decoded[:, 0], order, rtol=1e-6)


@pytest.mark.parametrize("quantization", codec.QUANTIZATIONS)
def test_no_tokens_are_a_header_and_decode_to_none(quantization: str) -> None:
    payload = codec.encode(np.empty((0, 2176), np.float32), [], quantization)
    tokens, positions = codec.decode(payload)
    assert len(payload) == 14
    assert tokens.shape == (0, 2176)
    assert positions.shape == (0,)


@pytest.mark.parametrize("quantization", codec.QUANTIZATIONS)
def test_a_slice_of_a_larger_array_encodes_like_its_copy(quantization: str) -> None:
    large = features(20)
    strided = large[::2, 100:300]
    assert codec.encode(strided, range(10), quantization) == codec.encode(
        strided.copy(), range(10), quantization
    )


def test_decoded_arrays_are_the_callers_own() -> None:
    payload = codec.encode(features(2), [4, 2], "float32")
    tokens, positions = codec.decode(payload)
    tokens[...], positions[...] = 0, 0  # writable, and the payload does not notice
    assert codec.decode(payload)[1].tolist() == [4, 2]


@pytest.mark.parametrize("wrap", [bytes, bytearray, memoryview])
def test_any_bytes_like_payload_decodes(wrap: type) -> None:
    payload = codec.encode(features(2), [4, 2])
    assert codec.decode(wrap(payload))[1].tolist() == [4, 2]


def test_the_header_tells_what_was_sent_even_when_less_arrived() -> None:
    payload = codec.encode(features(6), range(6), "int4", tower_dims=(1024, 1152))
    header = codec.read_header(payload[:20])
    assert header == codec.PayloadHeader("int4", 2176, (1024, 1152), 6)


@pytest.mark.parametrize("quantization", codec.QUANTIZATIONS)
def test_the_layout_is_the_documented_one(quantization: str) -> None:
    """Read a payload with nothing but ``struct`` and the table in the layout's documentation."""
    tokens, positions, towers = features(5), [9, 3, 511, 0, 44], (1024, 1152)
    payload = codec.encode(tokens, positions, quantization, tower_dims=towers)
    expected, _ = codec.decode(payload)

    assert struct.unpack_from("<4s4B2H2H", payload) == (
        b"CVLT", 1, 1 + codec.QUANTIZATIONS.index(quantization), 2, 0, 2176, 5, 1024, 1152,
    )  # fmt: skip
    scales = {"int8": 2, "int4": 1}.get(quantization, 0)
    coded = {"float32": "2176f", "float16": "2176e", "int8": "2176b", "int4": "1088B"}[quantization]
    record = struct.Struct(f"<H{scales}f{coded}")
    assert len(payload) == 16 + 5 * record.size
    for index, fields in enumerate(record.iter_unpack(payload[16:])):
        values = np.array(fields[1 + scales :])
        if quantization == "int4":
            halves = np.stack([values & 15, values >> 4], axis=1).reshape(-1)
            values = np.where(halves < 8, halves, halves - 16)
        if scales:
            values = values * np.repeat(fields[1 : 1 + scales], towers if scales == 2 else 2176)
        assert fields[0] == positions[index]
        np.testing.assert_allclose(values, expected[index], rtol=1e-6)


# The bytes themselves: robots in the field must be understood by servers that come later.
GOLDEN = {
    "float32": "43564c54 01010100 0300 0200 0300 0500 0000803f 000000c0 0000003f"
    "                                     ff01 00000000 00000040 000080bf",
    "float16": "43564c54 01020100 0300 0200 0300 0500 003c 00c0 0038 ff01 0000 0040 00bc",
    "int8": "43564c54 01030100 0300 0200 0300 0500 0402813c 4081 20 ff01 0402813c 007fc0",
    "int4": "43564c54 01040100 0300 0200 0300 0500 0000803e 8402 ff01 2549923e 700d",
}


@pytest.mark.parametrize("quantization", codec.QUANTIZATIONS)
def test_the_bytes_never_change(quantization: str) -> None:
    tokens = np.array([[1, -2, 0.5], [0, 2, -1]], np.float32)
    payload = codec.encode(tokens, [5, 511], quantization)
    assert payload == bytes.fromhex(GOLDEN[quantization])
