"""What a receiver hands on for one picture: the symbols as they came in, and how the period was.

One block of bytes for each view, little-endian::

    4s  magic "CVAS"      B  version    B  length of the name    H  reserved, 0
    8s  first bytes of the codec's fingerprint
    3f  gain h (real, imaginary) and noise power N0 of a complex symbol
    name of the codec in ASCII, then k complex64 symbols y = h s + n

The symbols are analogue: how many bytes their numbers take here says nothing about the air, where
each is one channel use.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from comvla.errors import CodecError
from comvla_vla.codecs.files import TrainedCodec
from comvla_vla.codecs.image_codec import check_size, rate

_HEADER = struct.Struct("<4sBBH8s3f")
_MAGIC, _VERSION = b"CVAS", 1


@dataclass(frozen=True)
class Waveform:
    """One picture's symbols at the receiver.

    Attributes:
        symbols: (k,) complex64.
        gain: h. noise: N0.
        codec: name. fingerprint: first eight bytes of the codec's.
    """

    symbols: npt.NDArray[np.complex64]
    gain: complex
    noise: float
    codec: str
    fingerprint: bytes


def channel_uses(data: bytes) -> int:
    """How often the channel is used for one picture that :func:`write_waveform` wrote: once for each symbol."""
    _, _, name_length, *_ = _HEADER.unpack_from(data)
    return int((len(data) - _HEADER.size - name_length) // np.dtype(np.complex64).itemsize)


def write_waveform(
    symbols: npt.NDArray[np.complex64], gain: complex, noise: float, trained: TrainedCodec
) -> bytes:
    """The bytes of one picture.

    Args:
        symbols: (k,) received.
        gain: h of the period. noise: N0.
        trained: the codec that made them.
    """
    name = trained.name.encode("ascii")
    mark = bytes.fromhex(trained.fingerprint)[:8]
    header = _HEADER.pack(_MAGIC, _VERSION, len(name), 0, mark, gain.real, gain.imag, noise)
    return header + name + np.ascontiguousarray(symbols, "<c8").tobytes()


def read_waveform(data: bytes) -> Waveform:
    """What the bytes say, from a stranger.

    Raises:
        CodecError: not such a block, or numbers that no receiver has.
    """
    if len(data) < _HEADER.size:
        raise CodecError(f"expected received symbols, got {len(data)} bytes")
    magic, version, length, reserved, mark, real, imaginary, noise = _HEADER.unpack_from(data)
    if magic != _MAGIC or version != _VERSION or reserved:
        raise CodecError(
            f"expected received symbols of version {_VERSION}, got bytes that begin with "
            f"{data[:5].hex()}: use one release on both sides"
        )
    start = _HEADER.size + length
    body = data[start:]
    if len(data) < start or not body or len(body) % 8:
        raise CodecError(f"received symbols are cut off: {len(body)} bytes of complex64 values")
    symbols = np.frombuffer(body, "<c8")
    if not (math.isfinite(real) and math.isfinite(imaginary) and 0 < noise < math.inf):
        raise CodecError(
            f"expected a finite gain and a noise power above 0, got {real}+{imaginary}j and {noise}"
        )
    if not np.isfinite(symbols.view(np.float32)).all():
        raise CodecError("received symbols hold values that are not finite: drop the period")
    name = data[_HEADER.size : start].decode("ascii", "replace")
    return Waveform(symbols, complex(real, imaginary), noise, name, mark)


def decode_waveform(
    data: bytes, height: int, width: int, trained: TrainedCodec
) -> npt.NDArray[np.uint8]:
    """The picture (H, W, 3) of one block.

    Args:
        data: from :func:`write_waveform`.
        height: announced, pixels. width: announced, pixels.
        trained: the decoder.

    Raises:
        CodecError: damaged, of another codec, or of another size.
    """
    check_size(trained.codec.config, height, width)
    waveform = read_waveform(data)
    ours = trained.name, bytes.fromhex(trained.fingerprint)[:8]
    if (waveform.codec, waveform.fingerprint) != ours:
        raise CodecError(
            f"expected symbols of the codec {ours[0]} {ours[1].hex()}, got {waveform.codec} "
            f"{waveform.fingerprint.hex()}: load the same trained codec on both sides"
        )
    expected = rate(trained.codec.config, height, width).channel_uses
    if len(waveform.symbols) != expected:
        raise CodecError(
            f"expected {expected} symbols for a picture of {height}×{width} pixels, got "
            f"{len(waveform.symbols)}"
        )
    with torch.inference_mode():
        images = trained.codec.receive(
            torch.from_numpy(waveform.symbols.copy())[None],
            (height, width),
            torch.tensor([waveform.gain], dtype=torch.complex64),
            torch.tensor([waveform.noise]),
        )
    picture: npt.NDArray[np.uint8] = float_to_uint8(images)[0]
    return picture


def uint8_to_float(pictures: npt.NDArray[np.uint8]) -> torch.Tensor:
    """(n, H, W, 3) uint8 to (n, 3, H, W) float32 in [0, 1]."""
    return torch.from_numpy(np.ascontiguousarray(pictures.transpose(0, 3, 1, 2))).float() / 255


def float_to_uint8(images: torch.Tensor) -> npt.NDArray[np.uint8]:
    """(n, 3, H, W) float in [0, 1] to (n, H, W, 3) uint8."""
    rounded = (images.clamp(0, 1) * 255).round().to(torch.uint8).permute(0, 2, 3, 1)
    pictures: npt.NDArray[np.uint8] = np.ascontiguousarray(rounded.numpy())
    return pictures
