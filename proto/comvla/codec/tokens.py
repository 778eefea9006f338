"""Tokens to payload and back: :func:`encode` on the robot, :func:`decode` in the cloud."""

from __future__ import annotations

import operator
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from comvla.codec.layout import (
    MAX_TOKEN_DIM,
    MAX_TOKENS,
    MAX_TOWERS,
    as_bytes,
    header_bytes,
    pack_header,
    read_header,
    record_bytes,
    record_views,
    tower_slices,
)
from comvla.codec.quantizers import quantizer_named
from comvla.errors import CodecError


def encode(
    tokens: NDArray[np.float32],
    positions: ArrayLike,
    quantization: str = "int8",
    *,
    tower_dims: Sequence[int] | None = None,
) -> bytes:
    """Write tokens as one payload, in the order given: most important first.

    Args:
        tokens: (K, D) float32, finite; K may be 0.
        positions: (K,) integers, each token's index in the unpruned sequence, 0 to 65 534, no two
            alike.
        quantization: one of :data:`comvla.codec.QUANTIZATIONS`.
        tower_dims: widths of the vision towers whose features are concatenated, summing to D;
            INT8 gives each its own scale. By default one tower of width D.

    Returns:
        A payload of exactly ``encoded_bytes(K, D, quantization, num_towers=len(tower_dims))``
        bytes.

    Raises:
        CodecError: wrong type, shape, dtype or range, repeated positions, values that are not
            finite or do not fit the quantization.
    """
    quantizer = quantizer_named(quantization)
    _check_tokens(tokens)
    count, token_dim = tokens.shape
    places = _checked_positions(positions, count)
    towers = _checked_towers(tower_dims, token_dim)

    head = pack_header(quantizer, towers, count)
    payload = np.empty(len(head) + count * record_bytes(quantizer, token_dim, len(towers)), "u1")
    payload[: len(head)] = np.frombuffer(head, "u1")
    if count:
        records = record_views(payload, quantizer, towers, count)
        records.positions[...] = places
        with np.errstate(all="ignore"):
            quantizer.quantize(tokens, tower_slices(towers), records.scales, records.values)
    return payload.tobytes()


def decode(
    payload: bytes | bytearray | memoryview,
    *,
    max_tokens: int | None = None,
    token_dim: int | None = None,
    num_tokens: int | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Read a payload, or any prefix of one, as the tokens that arrived whole.

    The payload is not trusted. Nothing it announces reserves memory: what is allocated is at most
    about sixteen times the bytes that came (INT4 becomes float32).

    Args:
        payload: what :func:`encode` wrote, whole or cut anywhere after the header.
        max_tokens: refuse payloads that announce more tokens than this.
        token_dim: D that the model expects; refuse others.
        num_tokens: N of the model; refuse positions of N and above, and more than N tokens.

    Returns:
        Tokens (K, D) float32 and positions (K,) int32, in the order sent, both freshly allocated.
        K is 0 where no token arrived whole.

    Raises:
        CodecError: anything else.
    """
    data = as_bytes(payload)
    header = read_header(data)
    if token_dim is not None and header.token_dim != token_dim:
        raise CodecError(
            f"expected token_dim {token_dim}, got a payload of token_dim {header.token_dim}: "
            "load the edge half of the same checkpoint"
        )
    for name, limit in (("max_tokens", max_tokens), ("num_tokens", num_tokens)):
        if limit is not None and header.count > limit:
            raise CodecError(
                f"expected at most {limit} tokens ({name}), got a payload of {header.count}: "
                "lower the token budget"
            )

    quantizer = quantizer_named(header.quantization)
    record = record_bytes(quantizer, header.token_dim, len(header.tower_dims))
    arrived = len(data) - header_bytes(len(header.tower_dims))
    if arrived > header.count * record:
        raise CodecError(
            f"expected {header.count} tokens of {record} bytes each, got "
            f"{arrived - header.count * record} bytes more: the payload is damaged"
        )
    count = arrived // record
    if count == 0:
        return np.empty((0, header.token_dim), np.float32), np.empty(0, np.int32)

    records = record_views(np.frombuffer(data, "u1"), quantizer, header.tower_dims, count)
    positions = records.positions.astype(np.int32)
    _require_places(positions, MAX_TOKENS if num_tokens is None else min(num_tokens, MAX_TOKENS))
    with np.errstate(all="ignore"):
        towers = tower_slices(header.tower_dims)
        tokens = quantizer.dequantize(records.scales, records.values, towers)
    return tokens, positions


def _check_tokens(tokens: NDArray[np.float32]) -> None:
    if not isinstance(tokens, np.ndarray):
        raise CodecError(
            f"expected tokens as a NumPy array, got {type(tokens).__name__}: "
            "convert first, e.g. tensor.detach().cpu().numpy()"
        )
    if tokens.dtype != np.float32:
        raise CodecError(
            f"expected tokens of dtype float32, got {tokens.dtype}: use tokens.astype(np.float32)"
        )
    if tokens.ndim != 2:
        raise CodecError(f"expected tokens of shape (K, D), got {tokens.shape}")
    count, token_dim = tokens.shape
    if count > MAX_TOKENS or not 1 <= token_dim <= MAX_TOKEN_DIM:
        raise CodecError(
            f"expected at most {MAX_TOKENS} tokens of 1 to {MAX_TOKEN_DIM} values, got "
            f"{tokens.shape}"
        )


def _checked_positions(positions: ArrayLike, count: int) -> NDArray[np.integer]:
    try:
        places = np.asarray(positions)
    except (ValueError, TypeError, OverflowError, RuntimeError) as error:
        raise CodecError(f"expected integer positions of shape ({count},): {error}") from error
    if places.size == 0:
        places = places.astype(np.int64)  # an empty list is float64 to NumPy
    if places.shape != (count,) or not np.issubdtype(places.dtype, np.integer):
        raise CodecError(
            f"expected integer positions of shape ({count},), one per token, got {places.dtype} "
            f"of shape {places.shape}"
        )
    _require_places(places, MAX_TOKENS)
    return places


def _require_places(positions: NDArray[np.integer], num_tokens: int) -> None:
    """Positions are within 0..N-1 and no two alike."""
    if positions.size == 0:
        return
    ordered = np.sort(positions)
    if ordered[0] < 0 or ordered[-1] >= num_tokens:
        wrong = ordered[0] if ordered[0] < 0 else ordered[-1]
        raise CodecError(
            f"expected positions from 0 to {num_tokens - 1}, got {wrong}: positions are indices "
            "into the unpruned token sequence of the same model"
        )
    repeated = ordered[1:] == ordered[:-1]
    if repeated.any():
        raise CodecError(
            f"expected each position once, got {ordered[1:][repeated][0]} twice: "
            "select tokens without repetition"
        )


def _checked_towers(tower_dims: Sequence[int] | None, token_dim: int) -> tuple[int, ...]:
    if tower_dims is None:
        return (token_dim,)
    try:
        towers = tuple(operator.index(width) for width in tower_dims)
    except TypeError as error:
        raise CodecError(f"expected tower_dims as integers, got {tower_dims!r}") from error
    if not 1 <= len(towers) <= MAX_TOWERS or min(towers) < 1 or sum(towers) != token_dim:
        raise CodecError(
            f"expected 1 to {MAX_TOWERS} tower widths above 0 that sum to the tokens' width "
            f"{token_dim}, got {list(towers)}: pass ModelInfo.tower_dims of the model that made "
            "the tokens"
        )
    return towers
