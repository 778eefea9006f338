"""Writes a safetensors file tensor by tensor: the header is known before the first one is read."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from types import TracebackType

from torch import Tensor

from comvla_vla.checkpoints.tensors import DTYPES, Catalogue, raw_bytes

_NAMES = {dtype: name for name, dtype in DTYPES.items()}


def file_order(entries: Catalogue) -> list[str]:
    """Names in the order in which tensors lie in a file: wide elements first, so that all of them are aligned."""
    return sorted(entries, key=lambda name: (-entries[name].dtype.itemsize, name))


class SafetensorsWriter:
    """Takes the tensors of a catalogue in :func:`file_order`.

    Args:
        path: file to write. entries: what will come; shapes and types must hold.
    """

    def __init__(self, path: Path, entries: Catalogue) -> None:
        self._entries = entries
        self._waiting = file_order(entries)[::-1]
        header: dict[str, object] = {"__metadata__": {"format": "pt"}}
        end = 0
        for name in file_order(entries):
            entry = entries[name]
            begin, end = end, end + entry.nbytes
            header[name] = {
                "dtype": _NAMES[entry.dtype],
                "shape": list(entry.shape),
                "data_offsets": [begin, end],
            }
        text = json.dumps(header, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 8)
        self._file = path.open("wb")
        self._file.write(struct.pack("<Q", len(text)) + text)

    def write(self, name: str, tensor: Tensor) -> None:
        """Appends the next tensor."""
        entry = self._entries[name]
        assert name == self._waiting.pop(), "tensors come in file_order"
        assert (tuple(tensor.shape), tensor.dtype) == (entry.shape, entry.dtype), name
        self._file.write(raw_bytes(tensor))

    def __enter__(self) -> SafetensorsWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._file.close()
        assert error is not None or not self._waiting, "not all tensors were written"
