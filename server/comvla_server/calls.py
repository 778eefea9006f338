"""What one call brought with it, noted where it is counted and read when the call ends."""

from __future__ import annotations

from contextvars import ContextVar
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from comvla.model_info import ModelInfo
from comvla_vla.request import AnyRequest, PolicyRequest


@dataclass
class CallRecord:
    """One call for actions, as far as it has got.

    Attributes:
        wire_bytes: its messages with protobuf, gRPC and HTTP/2 framing.
        payload_bytes: the paper's accounting, or files of pictures.
        coding: of the token values, or of the pictures; empty where neither could be read.
        positions: (K,) of the tokens that were read, most important first; None without tokens.
        model: for whose grid they are.
    """

    wire_bytes: int = 0
    payload_bytes: int = 0
    coding: str = ""
    positions: NDArray[np.integer] | None = None
    model: ModelInfo | None = None

    def note_content(self, payload_bytes: int, coding: str) -> None:
        """Token values or pictures have come."""
        self.payload_bytes += payload_bytes
        self.coding = coding

    def note_read(self, request: AnyRequest, model: ModelInfo) -> None:
        """The content was what this model can take."""
        self.model = model
        if isinstance(request, PolicyRequest):
            self.positions = np.asarray(request.positions)


# Every call runs in a task, and so in a context, of its own.
_CALL: ContextVar[CallRecord | None] = ContextVar("comvla_call", default=None)


def begin_call() -> CallRecord:
    """From here on this task works for a new call."""
    record = CallRecord()
    _CALL.set(record)
    return record


def this_call() -> CallRecord:
    """The record of the call that runs here; one that nobody reads where none does."""
    return _CALL.get() or CallRecord()
