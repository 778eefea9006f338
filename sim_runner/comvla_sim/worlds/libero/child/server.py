"""Answers the parent's requests, one at a time, until the pipe closes.

Requests and the arrays and fields of their answers:

| request | carries | answer |
|---|---|---|
| ``reset`` | fields ``task``, ``init_state`` | a reading and a scene |
| ``step`` | array ``action`` (7,) | reading |
| ``draw`` | | ``frames`` (2, S, S, 3) uint8 as the simulator gives them |
| ``cameras`` | | ``positions`` (2, 3), ``rotations`` (2, 3, 3), ``fovy_deg`` (2,) |
| ``get_state`` | | ``state`` (n,) |
| ``set_state`` | array ``state`` (n,) | reading |

The first message is sent unasked when the simulator is ready: fields ``tasks``, ``versions``.
A *reading* is ``eef_pos`` (3,), ``eef_quat`` (4,) as x, y, z, w, ``gripper_qpos`` (2,), ``met``
(goals,) bool and ``poses`` (things, 7): position and quaternion (x, y, z, w). A *scene* is the fields
``things``, ``sizes``, ``goal`` and the arrays ``points/NAME`` (m, 3) and ``base`` (3,).
"""

from __future__ import annotations

import traceback
from collections.abc import Callable
from typing import Any, Protocol

from .framing import FramingError, Message, encode, read


class AssetsMissing(Exception):
    """A mesh, texture or scene file is not there."""


class Simulator(Protocol):
    """What the server calls; each method answers one request."""

    def ready(self) -> Message:
        """The unasked first message."""

    def reset(self, request: Message) -> Message:
        """Starts an episode."""

    def step(self, request: Message) -> Message:
        """Executes one action."""

    def draw(self, request: Message) -> Message:
        """Pictures of the last reading."""

    def cameras(self, request: Message) -> Message:
        """Where the cameras are."""

    def get_state(self, request: Message) -> Message:
        """The present moment."""

    def set_state(self, request: Message) -> Message:
        """Back to a moment."""


REQUESTS = ("reset", "step", "draw", "cameras", "get_state", "set_state")


def serve(reader: Any, writer: Any, start: Callable[[], Simulator]) -> None:
    """Makes the simulator and answers until the parent closes the pipe.

    Args:
        reader: binary file of requests.
        writer: binary file for answers.
        start: makes the simulator. An exception in it is sent to the parent and ends the service.
    """

    def read_exactly(number: int) -> bytes:
        received: bytes = reader.read(number)
        if len(received) < number:
            raise EOFError
        return received

    def send(message: Message) -> None:
        writer.write(encode(message))
        writer.flush()

    try:
        try:
            simulator = start()
            send(simulator.ready())
        except Exception as error:
            send(_failure(error))
            return
        while True:
            try:
                request = read(read_exactly)
                if request.kind not in REQUESTS:
                    raise FramingError(f"unknown request {request.kind!r}")
                answer = getattr(simulator, request.kind)(request)
            except EOFError:
                return
            except Exception as error:
                answer = _failure(error)
            send(answer)
    except BrokenPipeError:
        return  # the parent is gone


def _failure(error: Exception) -> Message:
    kind = "assets" if isinstance(error, AssetsMissing) else "internal"
    words = str(error) if kind == "assets" else f"{type(error).__name__}: {error}"
    return Message("error", {"type": kind, "message": words, "traceback": traceback.format_exc()})
