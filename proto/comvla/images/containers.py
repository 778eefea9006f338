"""Where a picture file ends, so that nothing can hide behind it."""

from __future__ import annotations

from comvla.errors import CodecError

_JPEG_END = b"\xff\xd9"
_JPEG_SCAN = 0xDA


def check_extent(coding: str, data: bytes) -> None:
    """Refuses a file that is cut off or is followed by anything.

    Args:
        coding: ``"jpeg"``, ``"webp"`` or ``"avif"``.
        data: the file.

    Raises:
        CodecError: what was expected and what came.
    """
    ends = {"jpeg": _jpeg_end, "webp": _webp_end, "avif": _avif_end}[coding](data)
    if ends != len(data):
        raise CodecError(
            f"expected a {coding} picture of {ends} bytes by its own account, got {len(data)}: send "
            "one whole file for each view, and nothing behind it"
        )


def _jpeg_end(data: bytes) -> int:
    """Offset behind the end marker, which cannot occur inside entropy-coded data."""
    if data[:2] != b"\xff\xd8":
        raise _not("jpeg", data)
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF:
        marker, length = data[at + 1], int.from_bytes(data[at + 2 : at + 4], "big")
        at += 2 + max(2, length)
        if marker == _JPEG_SCAN:
            found = data.find(_JPEG_END, at)
            return len(data) + 1 if found < 0 else found + 2
    raise _not("jpeg", data)


def _webp_end(data: bytes) -> int:
    if data[:4] != b"RIFF" or data[8:12] != b"WEBP":
        raise _not("webp", data)
    return 8 + int.from_bytes(data[4:8], "little")


def _avif_end(data: bytes) -> int:
    """Offset behind the three boxes that a picture consists of."""
    if data[4:8] != b"ftyp" or data[8:12] not in (b"avif", b"mif1"):
        raise _not("avif", data)
    at, missing = 0, {b"ftyp", b"meta", b"mdat"}
    while missing:
        size, box = int.from_bytes(data[at : at + 4], "big"), data[at + 4 : at + 8]
        # Sizes 0 (to the end) and 1 (64 bits) are legal and never needed for a picture this small.
        if size < 8 or box not in missing:
            raise _not("avif", data)
        missing.remove(box)
        at += size
    return at


def _not(coding: str, data: bytes) -> CodecError:
    return CodecError(
        f"expected a {coding} picture, got {len(data)} bytes that begin with {data[:8].hex()}"
    )
