"""Pictures of requests: checked by what they announce, decoded in a thread of their own."""

from __future__ import annotations

import asyncio
import contextvars
import time
from collections.abc import Callable
from typing import Any, TypeVar

from comvla.errors import CodecError, KeyFrameNeededError
from comvla.images import MAX_VIEW_PIXELS, coding_name, most_data_bytes
from comvla.model_info import ModelInfo
from comvla.v1.policy_pb2 import InferRequest
from comvla_server.image_decoders import Picture
from comvla_server.inference_thread import InferenceThread
from comvla_server.refusals import Reason, Refusal
from comvla_server.vision import Vision

_T = TypeVar("_T")


def read_pictures(request: InferRequest, info: ModelInfo, vision: Vision | None) -> list[Picture]:
    """The pictures of a request (H, W, 3) uint8, one per view.

    What is announced is checked first, and bounds what decoding may cost.

    Args:
        request: with ``images`` set.
        info: the model.
        vision: who will look at them; None on a server that reads tokens only.

    Raises:
        Refusal: mismatch (no vision half here, or not this coding), invalid, or key frame.
    """
    images = request.images
    if request.payload:
        raise _invalid("expected tokens or pictures, got both: leave payload or images unset")
    if vision is None:
        raise Refusal(
            Reason.MISMATCH,
            "expected tokens, got pictures: this server has no vision half; start it with "
            "comvla-server serve --vision on, or give the robot an edge model",
        )
    coding = coding_name(images.coding)
    if coding is None or coding not in vision.decoders:
        raise Refusal(
            Reason.MISMATCH,
            f"expected pictures coded as {', '.join(vision.decoders) or 'none'}, got "
            f"{coding or images.coding}: choose one that the handshake offers",
        )
    _check_announced(request, info, vision.any_image_size)
    try:
        return vision.decoders[coding].decode(request)
    except KeyFrameNeededError as error:
        raise Refusal(Reason.KEY_FRAME, str(error)) from error
    except CodecError as error:
        raise _invalid(f"picture: {error}") from error


def _check_announced(request: InferRequest, info: ModelInfo, any_size: bool) -> None:
    images, (rows, columns) = request.images, info.image_size
    if len(images.views) != info.grid[0]:
        raise _invalid(
            f"expected {info.grid[0]} pictures, one per view of {info.name}, got {len(images.views)}"
        )
    if images.HasField("follows_step") and images.follows_step >= request.step:
        raise _invalid(
            f"expected pictures that follow a step before {request.step}, got {images.follows_step}"
        )
    for index, view in enumerate(images.views):
        height, width = view.height, view.width
        fits = min(height, width) > 0 and height * width <= MAX_VIEW_PIXELS
        if not fits if any_size else (height, width) != (rows, columns):
            wanted = f"up to {MAX_VIEW_PIXELS} pixels" if any_size else f"{rows} x {columns} pixels"
            raise _invalid(
                f"expected picture {index} of {wanted} ({info.name}), {height} x {width} are announced: "
                "resize it"
            )
        if not 0 < len(view.data) <= most_data_bytes(height, width):
            raise _invalid(
                f"expected 1 to {most_data_bytes(height, width)} bytes for picture {index} of "
                f"{height} x {width} pixels, got {len(view.data)}"
            )


class Decoding:
    """Reads requests with pictures off the event loop, in order of arrival.

    Args:
        thread: where decoders run, one request at a time.
        most_waiting: requests that may wait for it.
        clock: monotonic seconds.
    """

    def __init__(
        self,
        thread: InferenceThread,
        most_waiting: int,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._thread = thread
        self._most_waiting = most_waiting
        self._waiting = 0
        self._clock = clock

    async def run(self, read: Callable[[], _T], deadline_s: float) -> _T:
        """The result of ``read()``.

        Args:
            read: decodes a request.
            deadline_s: monotonic time after which it is of no use.

        Raises:
            Refusal: overload, too late, or what ``read`` raises.
        """
        if self._waiting >= self._most_waiting:
            raise Refusal(
                Reason.OVERLOAD,
                f"{self._waiting} requests wait for their pictures to be decoded, expected fewer than "
                f"{self._most_waiting}: ask less often, send smaller pictures, or add a replica",
            )

        context = contextvars.copy_context()  # decoders may ask who calls

        def in_time() -> _T:
            # Whoever waited in line until nobody waits for the answer costs nothing.
            if self._clock() >= deadline_s:
                raise _too_late()
            return context.run(read)

        self._waiting += 1
        job = asyncio.ensure_future(self._thread.run(in_time))
        job.add_done_callback(self._done)
        finished, _ = await asyncio.wait([job], timeout=max(0.0, deadline_s - self._clock()))
        if not finished:
            raise _too_late()
        return job.result()

    def _done(self, job: asyncio.Future[Any]) -> None:
        self._waiting -= 1
        if not job.cancelled():
            job.exception()  # retrieved, even where nobody waits any more


def _too_late() -> Refusal:
    return Refusal(
        Reason.DEADLINE,
        "the pictures were not decoded within the deadline: expected an answer before it, none came; "
        "allow more time, send smaller pictures, or add a replica",
    )


def _invalid(message: str) -> Refusal:
    return Refusal(Reason.INVALID, message)
