"""Byte layout of a payload: a header, then one record per token. All numbers are little-endian.

======================  =======================================================================
header                  4 bytes magic ``CVLT``, then uint8 version (1), quantization, number of
                        vision towers M, zero; uint16 D, uint16 number of records; M times uint16
                        tower width (they sum to D): 12 + 2·M bytes
record                  uint16 position; S times float32 scale; ⌈D·B/8⌉ bytes of values
======================  =======================================================================

S is M for INT8, 1 for INT4, 0 for the float formats. The number of records is what was *sent*:
fewer may arrive, and more than that is an error. It is never used to reserve memory.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from itertools import accumulate, pairwise

import numpy as np
from numpy.typing import NDArray

from comvla.codec.quantizers import Quantizer, quantizer_on_wire
from comvla.errors import CodecError

MAX_TOKENS = 65_535
"""Largest N: positions run from 0 to 65 534 and are written as uint16."""
MAX_TOKEN_DIM = 65_535
MAX_TOWERS = 16

_MAGIC = b"CVLT"
_VERSION = 1
_FIXED = struct.Struct("<4s4B2H")
_POSITION_BYTES = 2
_SCALE_BYTES = 4


@dataclass(frozen=True)
class PayloadHeader:
    """What the head of a payload announces.

    Attributes:
        quantization: one of :data:`comvla.codec.QUANTIZATIONS`.
        token_dim: D, values per token.
        tower_dims: widths of the vision towers; they sum to ``token_dim``.
        count: K, tokens that were sent; fewer may have arrived.
    """

    quantization: str
    token_dim: int
    tower_dims: tuple[int, ...]
    count: int


@dataclass(frozen=True)
class Records:
    """Views into a buffer of K records: writing to them writes the payload.

    Attributes:
        positions: (K,) uint16.
        scales: (K, S) float32.
        values: (K, V) uint8.
    """

    positions: NDArray[np.uint16]
    scales: NDArray[np.float32]
    values: NDArray[np.uint8]


def header_bytes(num_towers: int) -> int:
    """Bytes before the first record."""
    return _FIXED.size + 2 * num_towers


def record_bytes(quantizer: Quantizer, token_dim: int, num_towers: int) -> int:
    """Bytes of one token with its position and scales."""
    scales = _SCALE_BYTES * quantizer.num_scales(num_towers)
    return _POSITION_BYTES + scales + quantizer.value_bytes(token_dim)


def tower_slices(tower_dims: tuple[int, ...]) -> list[slice]:
    """Where each tower's features lie within a token."""
    return [slice(start, stop) for start, stop in pairwise(accumulate(tower_dims, initial=0))]


def pack_header(quantizer: Quantizer, tower_dims: tuple[int, ...], count: int) -> bytes:
    """The header of ``count`` tokens; the caller has checked the ranges."""
    fixed = _FIXED.pack(
        _MAGIC, _VERSION, quantizer.wire_id, len(tower_dims), 0, sum(tower_dims), count
    )
    return fixed + struct.pack(f"<{len(tower_dims)}H", *tower_dims)


def read_header(payload: bytes | bytearray | memoryview) -> PayloadHeader:
    """Read what a payload, or a prefix of one, announces; the tokens themselves are not looked at.

    Raises:
        CodecError: these are not the first bytes of a payload.
    """
    data = as_bytes(payload)
    if len(data) < _FIXED.size:
        raise CodecError(
            f"expected a payload header of at least {_FIXED.size} bytes, got {len(data)} bytes: "
            "the payload is empty or was cut inside its header"
        )
    magic, version, wire_id, num_towers, zero, token_dim, count = _FIXED.unpack_from(data)
    if magic != _MAGIC:
        raise CodecError(
            f"expected a token payload that begins with {_MAGIC!r}, got {magic!r}: "
            "send what comvla.codec.encode returns"
        )
    if version != _VERSION:
        raise CodecError(
            f"expected payload version {_VERSION}, got {version}: "
            "install the same ComVLA on robot and server"
        )
    quantizer = quantizer_on_wire(wire_id)
    if not 1 <= num_towers <= MAX_TOWERS or zero != 0:
        raise CodecError(
            f"expected 1 to {MAX_TOWERS} vision towers and a zero byte, got {num_towers} and "
            f"{zero}: the payload is damaged"
        )
    if len(data) < header_bytes(num_towers):
        raise CodecError(
            f"expected a payload header of {header_bytes(num_towers)} bytes, got {len(data)} "
            "bytes: the payload was cut inside its header"
        )
    tower_dims = struct.unpack_from(f"<{num_towers}H", data, _FIXED.size)
    if token_dim == 0 or 0 in tower_dims or sum(tower_dims) != token_dim:
        raise CodecError(
            f"expected tower widths above 0 that sum to token_dim {token_dim}, got "
            f"{list(tower_dims)}: the payload is damaged"
        )
    return PayloadHeader(quantizer.name, token_dim, tower_dims, count)


def record_views(
    buffer: NDArray[np.uint8], quantizer: Quantizer, tower_dims: tuple[int, ...], count: int
) -> Records:
    """Views of the first ``count`` records of a payload; the buffer must hold them."""
    token_dim, num_towers = sum(tower_dims), len(tower_dims)
    stride = record_bytes(quantizer, token_dim, num_towers)
    start = header_bytes(num_towers)
    records = buffer[start : start + count * stride].reshape(count, stride)
    values_at = stride - quantizer.value_bytes(token_dim)
    return Records(
        positions=records[:, :_POSITION_BYTES].view("<u2")[:, 0],
        scales=records[:, _POSITION_BYTES:values_at].view("<f4"),
        values=records[:, values_at:],
    )


def as_bytes(payload: bytes | bytearray | memoryview) -> memoryview:
    """A flat read-only look at ``payload``, without copying it.

    Raises:
        CodecError: it is not bytes, or not contiguous.
    """
    if not isinstance(payload, bytes | bytearray | memoryview):
        raise CodecError(
            f"expected a payload of bytes, got {type(payload).__name__}: "
            "pass the request's payload field as it came"
        )
    view = memoryview(payload)
    if not view.c_contiguous:
        raise CodecError("expected a contiguous payload, got a strided memoryview: copy it first")
    return view.toreadonly().cast("B")
