"""H.264 over time, by PyAV: one stream for each view, one access unit for each step.

A picture is coded as a difference to the step before it, so a step that was lost breaks the chain.
Writers begin a new one (a key frame) whenever they are made; who writes makes a new writer after a
loss, who reads a new reader for a key frame.
"""

from __future__ import annotations

import re
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from comvla.errors import CodecError, DependencyError
from comvla.images.stills import check_announced

if TYPE_CHECKING:
    from types import ModuleType

DEFAULT_CRF = 23
"""x264's own default of its constant rate factor: 0 is lossless, 51 is worst."""

# x264 describes itself in a message (SEI, type 6) of some 600 bytes in each key frame.
_START_CODE = re.compile(rb"\x00\x00\x00?\x01")
_SEI = 6


def require_video() -> None:
    """Makes sure that H.264 can be written and read here.

    Raises:
        DependencyError: PyAV is missing, or was built without x264.
    """
    _av()


class VideoWriter:
    """Codes the pictures of one view, each as the difference to the last.

    Args:
        height: of every picture, pixels.
        width: of every picture, pixels.
        crf: x264's constant rate factor, 0 to 51.

    Raises:
        CodecError: a rate factor out of range.
        DependencyError: see :func:`require_video`.
    """

    def __init__(self, height: int, width: int, crf: int = DEFAULT_CRF) -> None:
        if not 0 <= crf <= 51:
            raise CodecError(f"expected an h264 rate factor from 0 to 51, got {crf}")
        self._size = height, width
        self._frames = 0
        self._codec = _av().CodecContext.create("libx264", "w")
        # 4:2:0 halves the colours' resolution, which needs even sides.
        self._codec.height, self._codec.width = height + height % 2, width + width % 2
        self._codec.pix_fmt = "yuv420p"
        self._codec.time_base = Fraction(1, 20)
        self._codec.thread_count = 1
        self._codec.options = {
            "preset": "veryfast",
            "tune": "zerolatency",  # one access unit out for each picture in, no look-ahead
            "crf": str(crf),
            "x264-params": "keyint=infinite:scenecut=0:repeat-headers=1:annexb=1",
        }

    def write(self, image: npt.NDArray[np.uint8]) -> bytes:
        """The access unit of one picture (H, W, 3) RGB; the first one is a key frame.

        Raises:
            CodecError: a picture of another size.
        """
        if image.shape != (*self._size, 3):
            raise CodecError(f"expected a picture of {(*self._size, 3)}, got {image.shape}")
        odd = [(0, side % 2) for side in self._size]
        even = np.pad(image, (*odd, (0, 0)), mode="edge") if any(map(sum, odd)) else image
        frame = _av().VideoFrame.from_ndarray(np.ascontiguousarray(even), format="rgb24")
        frame = frame.reformat(format="yuv420p")
        frame.pts = self._frames
        self._frames += 1
        return _without_messages(b"".join(bytes(packet) for packet in self._codec.encode(frame)))


class VideoReader:
    """Decodes what one :class:`VideoWriter` wrote, in order, from a stranger.

    Args:
        height: announced, pixels; a stream that says another size is refused before it gets memory.
        width: announced, pixels.

    Raises:
        DependencyError: see :func:`require_video`.
    """

    def __init__(self, height: int, width: int) -> None:
        self._size = height, width
        self._codec: Any = _av().CodecContext.create("h264", "r")
        self._codec.thread_count = 1  # threads over frames would hold pictures back
        # The decoder counts its own buffers, whose sides it rounds up to a vector's 64 bytes.
        pixels = (height + 63) // 64 * 64 * ((width + 63) // 64 * 64)
        self._codec.options = {
            "max_pixels": str(pixels),
            "err_detect": "explode",
            "flags": "low_delay",
        }

    def read(self, data: bytes) -> npt.NDArray[np.uint8]:
        """The picture (H, W, 3) RGB of one access unit.

        Raises:
            CodecError: anything but exactly one whole picture of the announced size.
        """
        height, width = self._size
        check_announced(data, height, width)
        av = _av()
        try:
            frames = self._codec.decode(av.Packet(data))
        except av.FFmpegError as error:
            raise CodecError(
                f"expected an h264 picture of {height} x {width} pixels, got {len(data)} bytes that "
                f"do not decode ({error.strerror}): begin with a key frame"
            ) from error
        if len(frames) != 1 or frames[0].is_corrupt:
            raise CodecError(
                f"expected one whole h264 picture in {len(data)} bytes, got {len(frames)}"
                + (", damaged" if frames else "")
            )
        frame = frames[0]
        if (frame.height, frame.width) != (height + height % 2, width + width % 2):
            raise CodecError(
                f"expected an h264 picture of {height} x {width} pixels as announced, got "
                f"{frame.height} x {frame.width}"
            )
        pixels: npt.NDArray[np.uint8] = frame.to_ndarray(format="rgb24")[:height, :width]
        return np.ascontiguousarray(pixels)


def _without_messages(unit: bytes) -> bytes:
    """An Annex B access unit without its SEI messages, which no decoder needs."""
    starts = [match.start() for match in _START_CODE.finditer(unit)]
    parts = [unit[a:b] for a, b in zip(starts, [*starts[1:], len(unit)], strict=True)]
    return b"".join(part for part in parts if part.lstrip(b"\0")[1] & 0x1F != _SEI)


def _av() -> ModuleType:
    try:
        import av
    except ImportError as error:
        raise DependencyError(
            "h264 needs PyAV, which is not installed: pip install 'comvla[video]'"
        ) from error
    if "libx264" not in av.codecs_available:
        raise DependencyError(
            "this PyAV was built without x264: install its wheel, pip install 'comvla[video]'"
        )
    return av
