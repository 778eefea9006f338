"""JPEG, WebP and AVIF, by Pillow: one file for each view, decoded only where it is what it says."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from comvla.errors import CodecError, DependencyError
from comvla.images.codings import MAX_VIEW_PIXELS, most_data_bytes
from comvla.images.containers import check_extent

if TYPE_CHECKING:
    from types import ModuleType

STILL_CODINGS = ("jpeg", "webp", "avif")

# AVIF's slower settings save few bytes and cost a control period.
_OPTIONS: dict[str, dict[str, int]] = {"jpeg": {}, "webp": {"method": 4}, "avif": {"speed": 9}}


def require(coding: str) -> None:
    """Makes sure that this coding can be written and read here.

    Raises:
        DependencyError: Pillow is missing, or was built without the coding.
    """
    _pillow(coding)


def encode_still(coding: str, image: npt.NDArray[np.uint8], quality: int) -> bytes:
    """One picture as a file.

    Args:
        coding: a name of :data:`STILL_CODINGS`.
        image: uint8 (H, W, 3) RGB.
        quality: 1 to 100, of the coding's own scale.

    Raises:
        CodecError: a quality out of range.
        DependencyError: see :func:`require`.
    """
    if not 1 <= quality <= 100:
        raise CodecError(f"expected a {coding} quality from 1 to 100, got {quality}")
    file = io.BytesIO()
    options = _OPTIONS[coding]
    _pillow(coding).fromarray(image).save(file, coding.upper(), quality=quality, **options)
    return file.getvalue()


def decode_still(coding: str, data: bytes, height: int, width: int) -> npt.NDArray[np.uint8]:
    """The picture (H, W, 3) RGB of a file, from a stranger.

    The announced size bounds work and memory before anything is decoded: a file that says another
    one, brings several pictures or passes, or goes on behind its end is refused.

    Args:
        coding: a name of :data:`STILL_CODINGS`.
        data: the file.
        height: announced, pixels.
        width: announced, pixels.

    Raises:
        CodecError: not such a file.
        DependencyError: see :func:`require`.
    """
    check_announced(data, height, width)
    check_extent(coding, data)
    pillow = _pillow(coding)
    try:
        # One format only: Pillow would otherwise try some forty parsers on a stranger's bytes.
        with pillow.open(io.BytesIO(data), formats=[coding.upper()]) as picture:
            said = (picture.height, picture.width, picture.mode, getattr(picture, "n_frames", 1))
            if said != (height, width, "RGB", 1):
                raise CodecError(
                    f"expected one {coding} picture of {height} x {width} pixels in RGB as announced, "
                    f"got {said[3]} of {said[0]} x {said[1]} in {said[2]}"
                )
            if picture.info.get("progressive"):
                raise CodecError(
                    "expected a baseline jpeg, got a progressive one, whose passes can cost any time"
                )
            pixels = np.asarray(picture)
    except CodecError:
        raise
    except Exception as error:  # Pillow's parsers raise whatever the bytes make them stumble over
        raise CodecError(
            f"expected a {coding} picture of {height} x {width} pixels, got {len(data)} bytes that "
            f"do not decode ({type(error).__name__}: {error})"
        ) from error
    return pixels


def check_announced(data: bytes, height: int, width: int) -> None:
    """Bounds what decoding may cost by what is announced.

    Raises:
        CodecError: too many pixels, none, or more bytes than such a picture can need.
    """
    if min(height, width) < 1 or height * width > MAX_VIEW_PIXELS:
        raise CodecError(
            f"expected a picture of 1 to {MAX_VIEW_PIXELS} pixels, {height} x {width} are announced: "
            "resize it"
        )
    most = most_data_bytes(height, width)
    if not 0 < len(data) <= most:
        raise CodecError(
            f"expected 1 to {most} bytes for a picture of {height} x {width} pixels, got {len(data)}"
        )


def _pillow(coding: str) -> ModuleType:
    try:
        from PIL import Image, features
    except ImportError as error:
        raise DependencyError(
            f"{coding} pictures need Pillow, which is not installed: pip install 'comvla[images]'"
        ) from error
    if coding != "jpeg" and not features.check(coding):
        raise DependencyError(
            f"this Pillow was built without {coding}: pip install 'pillow>=11.3' has it"
        )
    return Image
