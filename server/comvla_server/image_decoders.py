"""Who turns a request's bytes into pictures: one decoder for each coding.

To add a coding, give it a number in the contract's ``ImageCoding`` and a class with the methods of
:class:`ImageDecoder`; put it into :data:`DECODERS`, or hand it to ``VisionHalf(edge, decoders=...)``.
Decoders run in one thread of their own, one request after another, so they need no locks.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from comvla.errors import CodecError, DependencyError, KeyFrameNeededError
from comvla.images import stills, video
from comvla.v1.policy_pb2 import InferRequest
from comvla_server.identity import caller

if TYPE_CHECKING:
    from comvla_vla.codecs import TrainedCodec

Picture: TypeAlias = NDArray[np.uint8]

MAX_VIDEO_SESSIONS = 256
"""Robots whose streams are held at once; the least recently seen has to begin anew."""


class ImageDecoder(Protocol):
    """Decodes the pictures of a request from a stranger, whose sizes and number were checked before."""

    def decode(self, request: InferRequest) -> list[Picture]:
        """One uint8 (H, W, 3) RGB per view, of the announced sizes.

        Args:
            request: whole, because a coding may depend on the session, the step or the SNR.

        Raises:
            CodecError: not what this coding writes.
            KeyFrameNeededError: it builds on pictures that are not held here.
        """
        ...


class StillDecoder:
    """Every view a file: JPEG, WebP or AVIF.

    Args:
        coding: a name of :data:`comvla.images.stills.STILL_CODINGS`.

    Raises:
        DependencyError: Pillow is missing, or cannot do this coding.
    """

    def __init__(self, coding: str) -> None:
        stills.require(coding)
        self._coding = coding

    def decode(self, request: InferRequest) -> list[Picture]:
        """The pictures of all views; they stand alone."""
        return [
            stills.decode_still(self._coding, view.data, view.height, view.width)
            for view in request.images.views
        ]


@dataclass
class _Streams:
    """One session's streams after a step: what the next may build on, and the answer to a repeat."""

    step: int
    digest: bytes
    readers: list[video.VideoReader]
    sizes: list[tuple[int, int]]
    pictures: list[Picture]


class VideoDecoder:
    """Every view an H.264 stream, held from step to step for each session of each identity.

    A picture must never build on one that somebody else sent, so the identity is part of the name.

    Args:
        max_sessions: robots whose streams are held at once.

    Raises:
        DependencyError: PyAV is missing.
    """

    def __init__(self, max_sessions: int = MAX_VIDEO_SESSIONS) -> None:
        video.require_video()
        self._max_sessions = max_sessions
        self._held: OrderedDict[tuple[str, str], _Streams] = OrderedDict()

    def decode(self, request: InferRequest) -> list[Picture]:
        """The pictures of all views. A repeat of the last step is answered without decoding it again."""
        images, session = request.images, (caller().name, request.session_id)
        sizes = [(view.height, view.width) for view in images.views]
        digest = hashlib.blake2b(images.SerializeToString(deterministic=True)).digest()
        held = self._held.get(session)
        if held is not None and (held.step, held.digest) == (request.step, digest):
            self._held.move_to_end(session)
            return held.pictures
        if images.HasField("follows_step"):
            readers = _continued(held, images.follows_step, sizes)
        else:
            readers = [video.VideoReader(height, width) for height, width in sizes]
        # Gone until all views are read: a stream that broke half-way must not be built upon.
        self._held.pop(session, None)
        pictures = [
            reader.read(view.data) for reader, view in zip(readers, images.views, strict=True)
        ]
        self._held[session] = _Streams(request.step, digest, readers, sizes, pictures)
        if len(self._held) > self._max_sessions:
            self._held.popitem(last=False)
        return pictures


class SymbolDecoder:
    """Every view the symbols of a learned codec as a receiver handed them on.

    Args:
        codec: ``"deepjscc"``, ``"witt"``, a folder of ``comvla-sim train codec``, or a trained codec.

    Raises:
        CheckpointError: there is no such codec.
    """

    def __init__(self, codec: str | TrainedCodec) -> None:
        from comvla_vla.codecs import load_codec

        self._trained = load_codec(codec) if isinstance(codec, str) else codec

    def decode(self, request: InferRequest) -> list[Picture]:
        """Equalises and decodes the symbols of all views; they stand alone."""
        from comvla_vla.codecs.waveform import decode_waveform

        return [
            decode_waveform(view.data, view.height, view.width, self._trained)
            for view in request.images.views
        ]


def _continued(
    held: _Streams | None, follows_step: int, sizes: list[tuple[int, int]]
) -> list[video.VideoReader]:
    if held is None or held.step != follows_step:
        there = "none" if held is None else f"those of step {held.step}"
        raise KeyFrameNeededError(
            f"key frame needed: expected the pictures of step {follows_step} to build on, this server "
            f"holds {there}; send the next step's pictures as key frames (follows_step not set)"
        )
    if held.sizes != sizes:
        raise CodecError(f"expected pictures of {held.sizes} as before, got {sizes}")
    return held.readers


DECODERS: dict[str, Callable[[], ImageDecoder]] = {
    **{coding: partial(StillDecoder, coding) for coding in stills.STILL_CODINGS},
    "h264": VideoDecoder,
    "deep_jscc": partial(SymbolDecoder, "deepjscc"),
    "witt": partial(SymbolDecoder, "witt"),
}
"""What makes a decoder, by coding."""


def available_decoders() -> dict[str, ImageDecoder]:
    """A decoder for every coding whose packages are installed."""
    found: dict[str, ImageDecoder] = {}
    for coding, make in DECODERS.items():
        try:
            found[coding] = make()
        except DependencyError:
            continue
    return found
