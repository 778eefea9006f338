"""Whatever bytes arrive: tokens that make sense, or CodecError, and memory in proportion."""

from __future__ import annotations

import random
import struct
import tracemalloc
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from comvla import codec
from comvla.errors import CodecError


def tokens(count: int, token_dim: int) -> NDArray[np.float32]:
    rng = np.random.default_rng(count)
    return rng.standard_normal((count, token_dim)).astype(np.float32)


def flip(rng: random.Random, payload: bytes) -> bytes:
    damaged = bytearray(payload)
    for _ in range(rng.randint(1, 4)):
        damaged[rng.randrange(len(damaged))] ^= 1 << rng.randrange(8)
    return bytes(damaged)


def overwrite(rng: random.Random, payload: bytes) -> bytes:
    at = rng.randrange(len(payload))
    size = rng.randint(1, 8)
    return payload[:at] + rng.choice((b"\xff", b"\0", b"\x7f")) * size + payload[at + size :]


def overwrite_header(rng: random.Random, payload: bytes) -> bytes:
    at = rng.randrange(4, 18)
    return payload[:at] + rng.randbytes(rng.randint(1, 4)) + payload[at + 2 :]


def truncate(rng: random.Random, payload: bytes) -> bytes:
    return payload[: rng.randrange(len(payload))]


def extend(rng: random.Random, payload: bytes) -> bytes:
    return payload + rng.randbytes(rng.randint(1, 64))


def splice(rng: random.Random, payload: bytes) -> bytes:
    start, stop = sorted(rng.sample(range(len(payload) + 1), 2))
    return payload[:start] + payload[stop:] + payload[start:stop]


def random_records(rng: random.Random, payload: bytes) -> bytes:
    return payload[:16] + rng.randbytes(rng.randrange(200))


def random_bytes(rng: random.Random, payload: bytes) -> bytes:
    return rng.randbytes(rng.randrange(200))


def announce_more(rng: random.Random, payload: bytes) -> bytes:
    """A header that promises up to 65 535 tokens of 65 535 values, with little behind it."""
    dim = rng.choice((1, 8, 2176, 65_535))
    head = struct.pack("<4s4B3H", b"CVLT", 1, rng.randint(1, 4), 1, 0, dim, 65_535, dim)
    return head + rng.randbytes(rng.randrange(300))


MUTATIONS: tuple[Callable[[random.Random, bytes], bytes], ...] = (
    flip,
    overwrite,
    overwrite_header,
    truncate,
    extend,
    splice,
    random_records,
    random_bytes,
    announce_more,
)


def mutated(number: int, seed: int) -> Iterator[bytes]:
    rng = random.Random(seed)
    originals = [
        codec.encode(
            tokens(count, sum(towers)), rng.sample(range(512), count), q, tower_dims=towers
        )
        for q in codec.QUANTIZATIONS
        for count, towers in ((1, (4,)), (3, (3, 5)), (6, (2, 2, 3)))
    ]
    for _ in range(number):
        payload = rng.choice(originals)
        for _ in range(rng.choice((1, 1, 2))):
            payload = rng.choice(MUTATIONS)(rng, payload) or payload
        yield payload


def test_forty_thousand_mutated_payloads_decode_soundly_or_raise_codec_error() -> None:
    outcomes = {"decoded": 0, "refused": 0}
    with np.errstate(all="raise"):
        for payload in mutated(40_000, seed=20):
            try:
                values, positions = codec.decode(payload)
            except CodecError:
                outcomes["refused"] += 1
                continue
            outcomes["decoded"] += 1
            assert values.shape == (len(positions), codec.read_header(payload).token_dim)
            assert np.isfinite(values).all()
            assert len(set(positions.tolist())) == len(positions)
            assert not len(positions) or 0 <= positions.min() <= positions.max() < 65_535
    assert min(outcomes.values()) > 5_000, outcomes  # the mutations reach both sides


def test_decoding_allocates_in_proportion_to_what_came_not_to_what_is_announced() -> None:
    payloads = list(mutated(2_000, seed=21))
    tracemalloc.start()
    try:
        for payload in payloads:
            tracemalloc.reset_peak()
            before, _ = tracemalloc.get_traced_memory()
            try:
                decoded = codec.decode(payload)
                del decoded
            except CodecError:
                pass
            _, peak = tracemalloc.get_traced_memory()
            assert peak - before < 16 * len(payload) + 20_000  # the rest: objects, error text
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("quantization", codec.QUANTIZATIONS)
def test_a_full_size_payload_needs_at_most_sixteen_times_its_bytes(quantization: str) -> None:
    payload = codec.encode(tokens(256, 2176), range(256), quantization, tower_dims=(1024, 1152))
    tracemalloc.start()
    try:
        codec.decode(payload)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 16 * len(payload)
