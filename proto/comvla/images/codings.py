"""Names, limits and sizes of coded pictures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

from comvla.codec.wire import varint_bytes
from comvla.errors import CodecError
from comvla.v1 import policy_pb2

_ENUM_PREFIX = "IMAGE_CODING_"

IMAGE_CODINGS: tuple[str, ...] = tuple(
    name.removeprefix(_ENUM_PREFIX).lower()
    for name, number in policy_pb2.ImageCoding.items()
    if number
)
"""Picture codings of the contract, by name: jpeg, webp, avif, h264, deep_jscc, witt."""

MAX_VIEW_PIXELS = 2**22
"""Most pixels of one view that anybody decodes: 2048 × 2048."""

_HEADROOM_BYTES = 2**16


def coding_number(name: str) -> policy_pb2.ImageCoding:
    """The contract's number of a coding.

    Raises:
        CodecError: no coding of that name.
    """
    if name not in IMAGE_CODINGS:
        raise CodecError(
            f"expected a picture coding among {', '.join(IMAGE_CODINGS)}, got {name!r}"
        )
    # The stubs make a class of an enum whose values are plain integers.
    return cast("policy_pb2.ImageCoding", policy_pb2.ImageCoding.Value(_ENUM_PREFIX + name.upper()))


def coding_name(number: int) -> str | None:
    """The name of a coding, None for a number that this side does not know."""
    try:
        name = policy_pb2.ImageCoding.Name(number)
    except ValueError:
        return None
    return name.removeprefix(_ENUM_PREFIX).lower() if number else None


def most_data_bytes(height: int, width: int) -> int:
    """Most bytes that a coded picture of this size may have: the raw picture, and room for headers.

    More is no compression, and its decoding could take time that the size does not bound.
    """
    return 3 * height * width + _HEADROOM_BYTES


def picture_bytes(images: policy_pb2.CodedImages) -> int:
    """Bytes of the pictures alone: what the field is called in a table of TX bytes."""
    return sum(len(view.data) for view in images.views)


def images_bytes(
    data_lengths: Sequence[int], height: int, width: int, follows_step: int | None = None
) -> int:
    """Exact length of a serialised ``CodedImages``, without building it.

    Args:
        data_lengths: bytes of each view's picture.
        height: of every view, pixels.
        width: of every view, pixels.
        follows_step: as in the message; None for pictures that stand alone.

    Raises:
        CodecError: a negative length, or a picture without pixels.
    """
    if min(data_lengths, default=0) < 0 or min(height, width) < 1:
        raise CodecError(
            "expected lengths of at least 0 and pictures of at least 1 x 1 pixels, got "
            f"{list(data_lengths)} and {height} x {width}"
        )
    size = 2  # the coding: every number is below 128
    for length in data_lengths:
        view = 2 + varint_bytes(height) + varint_bytes(width)
        view += 1 + varint_bytes(length) + length if length else 0
        size += 1 + varint_bytes(view) + view
    return size + (0 if follows_step is None else 1 + varint_bytes(follows_step))
