"""Number formats of token values on the wire: float32, float16, INT8 and INT4.

A quantizer turns ``(K, D)`` float32 tokens into ``(K, S)`` float32 scales and ``(K, V)`` bytes and
back. It works on all tokens at once and writes straight into the payload, so that no token is
touched by a Python loop and none is copied twice. Both directions run with NumPy's floating-point
warnings off and check what comes out. Adding a format is one class and one entry in
``_QUANTIZERS``; its ``wire_id`` also becomes a value of the ``Quantization`` enumeration in
``comvla/v1/policy.proto``.

Scales are float32, although float16 would save two bytes per tower and token (0.18 % of an INT8
token of 2176 values). The features are un-normalised: massive channels reach hundreds, other
checkpoints may go further, and near-silent towers fall below float16's normal range (6e-5), where
its steps are coarser than the error bound promises. With float32 every finite token can be coded
and the bounds below hold for all of them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from comvla.errors import CodecError

FloatArray = NDArray[np.float32]
ByteArray = NDArray[np.uint8]

# Scales stay normal numbers: 1 / scale is then finite, and a token of zeros needs no special case.
_SMALLEST_SCALE = np.finfo(np.float32).tiny
_FLOAT32_MAX = np.finfo(np.float32).max


class Quantizer(ABC):
    """One number format.

    Attributes:
        name: what callers write, e.g. ``"int8"``.
        wire_id: the byte that stands for it in a payload header.
        bits: B, bits per value without scales, as the paper counts.
    """

    name: ClassVar[str]
    wire_id: ClassVar[int]
    bits: ClassVar[int]

    def num_scales(self, num_towers: int) -> int:
        """Scales that each token carries, S."""
        return 0

    def value_bytes(self, token_dim: int) -> int:
        """Bytes of one token's values, V = ⌈D·B/8⌉."""
        return -(-token_dim * self.bits // 8)

    @abstractmethod
    def quantize(
        self, tokens: FloatArray, towers: Sequence[slice], scales: FloatArray, values: ByteArray
    ) -> None:
        """Write ``tokens`` (K, D) into ``scales`` (K, S) and ``values`` (K, V).

        Raises:
            CodecError: a value is NaN, infinite, or beyond the format's range.
        """

    @abstractmethod
    def dequantize(
        self, scales: FloatArray, values: ByteArray, towers: Sequence[slice]
    ) -> FloatArray:
        """Read ``scales`` (K, S) and ``values`` (K, V) back as tokens (K, D), a new array.

        Raises:
            CodecError: the bytes are not what :meth:`quantize` writes.
        """


class Float32(Quantizer):
    """Little-endian IEEE single precision: lossless."""

    name = "float32"
    wire_id = 1
    bits = 32

    def quantize(
        self, tokens: FloatArray, towers: Sequence[slice], scales: FloatArray, values: ByteArray
    ) -> None:
        _require_finite(tokens)
        values.view("<f4")[...] = tokens

    def dequantize(
        self, scales: FloatArray, values: ByteArray, towers: Sequence[slice]
    ) -> FloatArray:
        tokens = values.view("<f4").astype(np.float32)
        _require_finite(tokens)
        return tokens


class Float16(Quantizer):
    """Little-endian IEEE half precision.

    ``|error| <= max(2**-11 * |value|, 2**-25)``. Magnitudes above 65 504 do not fit: refused.
    """

    name = "float16"
    wire_id = 2
    bits = 16

    def quantize(
        self, tokens: FloatArray, towers: Sequence[slice], scales: FloatArray, values: ByteArray
    ) -> None:
        halves = tokens.astype("<f2")
        if not np.isfinite(halves).all():
            _require_finite(tokens)
            raise CodecError(
                f"expected magnitudes up to 65504, which is what float16 holds, got "
                f"{np.abs(tokens).max():g}: use int8 or float32"
            )
        values.view("<f2")[...] = halves

    def dequantize(
        self, scales: FloatArray, values: ByteArray, towers: Sequence[slice]
    ) -> FloatArray:
        tokens = values.view("<f2").astype(np.float32)
        _require_finite(tokens)
        return tokens


class Int8(Quantizer):
    """Symmetric INT8, one scale per token and vision tower: ``value = scale * q``, |q| <= 127.

    The towers differ in scale; a common one would cost the quieter tower its resolution.
    ``|error| <= scale / 2`` with ``scale = max|token in tower| / 127``, up to float32 rounding.
    """

    name = "int8"
    wire_id = 3
    bits = 8
    _LEVELS = 127

    def num_scales(self, num_towers: int) -> int:
        return num_towers

    def quantize(
        self, tokens: FloatArray, towers: Sequence[slice], scales: FloatArray, values: ByteArray
    ) -> None:
        work = np.abs(tokens)
        peaks = np.stack([work[:, tower].max(axis=1) for tower in towers], axis=1)
        _require_finite(peaks)  # a NaN or an infinity anywhere shows in its tower's peak
        steps = np.maximum(peaks / np.float32(self._LEVELS), _SMALLEST_SCALE)
        scales[...] = steps
        inverse = np.float32(1) / steps
        for index, tower in enumerate(towers):
            np.multiply(tokens[:, tower], inverse[:, index, None], out=work[:, tower])
        np.rint(work, out=values.view(np.int8), casting="unsafe")

    def dequantize(
        self, scales: FloatArray, values: ByteArray, towers: Sequence[slice]
    ) -> FloatArray:
        _require_scales(scales)
        levels = values.view(np.int8)
        if levels.min(initial=0) < -self._LEVELS:
            raise CodecError(
                "expected INT8 levels from -127 to 127, got -128: the payload is damaged"
            )
        tokens = levels.astype(np.float32)
        for index, tower in enumerate(towers):
            tokens[:, tower] *= scales[:, index, None]
        return _saturated(tokens)


class Int4(Quantizer):
    """INT4 as the paper's Table IV means it: one scale per token, 16 levels from -8 to 7.

    Two values share a byte, the even-numbered one in the low half. The scale is the smallest that
    holds both ends, ``max(max / 7, -min / 8)``, so no value is clipped: ``|error| <= scale / 2``,
    up to float32 rounding. A few massive channels set the scale of all 2176 values, which is why
    the paper sees success collapse.
    """

    name = "int4"
    wire_id = 4
    bits = 4

    def num_scales(self, num_towers: int) -> int:
        return 1

    def quantize(
        self, tokens: FloatArray, towers: Sequence[slice], scales: FloatArray, values: ByteArray
    ) -> None:
        ends = np.stack([tokens.max(axis=1) / 7, tokens.min(axis=1) / -8], axis=1)
        _require_finite(ends)  # a NaN or an infinity anywhere shows at one end
        steps = np.maximum(ends.max(axis=1, keepdims=True), _SMALLEST_SCALE)
        scales[...] = steps
        count, token_dim = tokens.shape
        levels = np.zeros((count, 2 * values.shape[1]), np.int8)  # an odd D leaves a zero behind
        work = tokens * (np.float32(1) / steps)
        np.rint(work, out=levels[:, :token_dim], casting="unsafe")
        pairs = levels.view("<u2")
        values[...] = (pairs & 0xF) | ((pairs >> 4) & 0xF0)

    def dequantize(
        self, scales: FloatArray, values: ByteArray, towers: Sequence[slice]
    ) -> FloatArray:
        _require_scales(scales)
        token_dim = towers[-1].stop
        if token_dim % 2 and (values[:, -1] >> 4).any():
            raise CodecError("expected an empty half byte after an odd number of INT4 values")
        pairs = values.astype("<u2")  # each byte becomes two, one for each half
        pairs |= pairs << 4
        pairs &= 0x0F0F
        levels = pairs.view(np.int8)
        levels ^= 8  # with the next line: two's complement of four bits, widened to eight
        levels -= 8
        tokens = levels[:, :token_dim].astype(np.float32)
        tokens *= scales
        return _saturated(tokens)


_QUANTIZERS: dict[str, Quantizer] = {
    quantizer.name: quantizer for quantizer in (Float32(), Float16(), Int8(), Int4())
}
_BY_WIRE_ID = {quantizer.wire_id: quantizer for quantizer in _QUANTIZERS.values()}

QUANTIZATIONS: tuple[str, ...] = tuple(_QUANTIZERS)
"""Names that :func:`comvla.codec.encode` accepts, widest first."""


def quantizer_named(name: str) -> Quantizer:
    """The quantizer called ``name``.

    Raises:
        CodecError: there is none of that name.
    """
    quantizer = _QUANTIZERS.get(name) if isinstance(name, str) else None
    if quantizer is None:
        raise CodecError(f"expected a quantization out of {', '.join(_QUANTIZERS)}, got {name!r}")
    return quantizer


def quantizer_on_wire(wire_id: int) -> Quantizer:
    """The quantizer that a payload header calls ``wire_id``.

    Raises:
        CodecError: this version knows none of that number.
    """
    quantizer = _BY_WIRE_ID.get(wire_id)
    if quantizer is None:
        known = ", ".join(f"{number} ({q.name})" for number, q in _BY_WIRE_ID.items())
        raise CodecError(
            f"expected a quantization out of {known}, got {wire_id}: the payload is damaged, or "
            "written by a newer ComVLA"
        )
    return quantizer


def bits_per_value(quantization: str) -> int:
    """B of Eq. (4): bits per value, without scales. 32, 16, 8 or 4.

    Raises:
        CodecError: unknown quantization.
    """
    return quantizer_named(quantization).bits


def _require_finite(values: NDArray[Any]) -> None:
    finite = np.isfinite(values)
    if not finite.all():
        token = int(np.argwhere(~finite)[0][0])
        raise CodecError(
            f"expected finite token values, got NaN or infinity in token {token}: "
            "check the vision towers' input and dtype"
        )


def _require_scales(scales: FloatArray) -> None:
    sound = (scales >= _SMALLEST_SCALE) & (scales <= _FLOAT32_MAX)  # False for NaN, too
    if not sound.all():
        token = int(np.argwhere(~sound)[0][0])
        raise CodecError(
            f"expected positive, finite scales, got {scales[token].tolist()} in token {token}: "
            "the payload is damaged"
        )


def _saturated(tokens: FloatArray) -> FloatArray:
    """Products that rounding carried past the end of float32 come back to it, in place."""
    return np.clip(tokens, -_FLOAT32_MAX, _FLOAT32_MAX, out=tokens)
