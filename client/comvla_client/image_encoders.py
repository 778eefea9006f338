"""Who turns a robot's pictures into bytes: files, video, and what others add.

An encoder of another kind (a trained one) is one class with the methods of :class:`ImageEncoder`, a number
in the contract's ``ImageCoding``, and a decoder of the same coding in the server.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

from comvla.images import stills, video

Pictures: TypeAlias = Sequence[npt.NDArray[np.uint8]]
"""One uint8 (H, W, 3) RGB per view, in the model's order."""

ADJUSTABLE = tuple(range(5, 100, 5))
"""Qualities that an encoder of files chooses from, where none is fixed."""


@dataclass(frozen=True)
class CodedViews:
    """What an encoder made of one observation.

    Attributes:
        data: bytes of each view.
        follows_step: the step that these pictures build on; None where they stand alone.
        flops: operations that coding took; 0 for codecs that nobody counts in FLOPs.
    """

    data: list[bytes]
    follows_step: int | None = None
    flops: float = 0.0


class ImageEncoder(Protocol):
    """Codes the views of one observation after another. One object serves one client.

    Attributes:
        coding: a name of :data:`comvla.images.IMAGE_CODINGS`.
        qualities: what :meth:`encode` may be asked for, rising in size; one where nothing can be chosen.
    """

    @property
    def coding(self) -> str: ...

    @property
    def qualities(self) -> Sequence[int]: ...

    def encode(self, images: Pictures, quality: int) -> CodedViews:
        """Codes all views. Where :attr:`qualities` has several, it may be called several times a step."""
        ...

    def settle(self, step: int, answered: bool) -> None:
        """Learns what became of the pictures that were coded last; see ``UplinkForm.settle``."""
        ...

    def reset(self) -> None:
        """Begins a new episode."""
        ...


class StillEncoder:
    """Every view a file of its own: JPEG, WebP or AVIF.

    Args:
        coding: a name of :data:`comvla.images.stills.STILL_CODINGS`.
        quality: 1 to 100; None leaves it to the link.

    Raises:
        DependencyError: Pillow is missing, or cannot do this coding.
        ValueError: a quality out of range.
    """

    def __init__(self, coding: str, quality: int | None = None) -> None:
        if quality is not None and not 1 <= quality <= 100:
            raise ValueError(f"expected a {coding} quality from 1 to 100, got {quality}")
        stills.require(coding)
        # The first picture of a coding loads its library; no step shall wait for that.
        stills.encode_still(coding, np.zeros((16, 16, 3), np.uint8), 50)
        self.coding = coding
        self.qualities = ADJUSTABLE if quality is None else (quality,)

    def encode(self, images: Pictures, quality: int) -> CodedViews:
        """Codes all views at one quality."""
        return CodedViews([stills.encode_still(self.coding, image, quality) for image in images])

    def settle(self, step: int, answered: bool) -> None:
        """Files stand alone."""

    def reset(self) -> None:
        """Files stand alone."""


class VideoEncoder:
    """Every view an H.264 stream: a key frame first and after any loss, differences in between.

    A difference is sent only when the server answered the step before it, so it surely has that picture.

    Args:
        crf: x264's constant rate factor, 0 (lossless) to 51.

    Raises:
        DependencyError: PyAV is missing.
        ValueError: a rate factor out of range.
    """

    coding = "h264"

    def __init__(self, crf: int = video.DEFAULT_CRF) -> None:
        if not 0 <= crf <= 51:
            raise ValueError(f"expected an h264 rate factor from 0 to 51, got {crf}")
        video.require_video()
        self.qualities = (crf,)
        self.reset()

    def reset(self) -> None:
        """The next pictures are key frames."""
        self._writers: list[video.VideoWriter] = []
        self._shapes: list[tuple[int, ...]] = []
        self._answered: int | None = None
        self._unsettled = False

    def encode(self, images: Pictures, quality: int) -> CodedViews:
        """Codes all views, as differences where the server has the pictures before."""
        shapes = [image.shape for image in images]
        if self._unsettled or shapes != self._shapes:
            self.reset()
        if self._answered is None:
            self._writers = [video.VideoWriter(shape[0], shape[1], quality) for shape in shapes]
            self._shapes = shapes
        self._unsettled = True
        data = [writer.write(image) for writer, image in zip(self._writers, images, strict=True)]
        return CodedViews(data, self._answered)

    def settle(self, step: int, answered: bool) -> None:
        """Goes on from an answered step, begins anew after any other."""
        if answered:
            self._answered, self._unsettled = step, False
        else:
            self.reset()
