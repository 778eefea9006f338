"""Tensors on disk, known by name, shape and type before any of them is read.

Everything below works on catalogues ``{name: TensorEntry}``: whole files, sharded files and merged adapters look the
same, and memory holds one tensor at a time. Nothing that is read is ever executed.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import torch
from torch import Tensor

from comvla.errors import CheckpointError

DTYPES = {
    "F64": torch.float64,
    "F32": torch.float32,
    "F16": torch.float16,
    "BF16": torch.bfloat16,
    "I64": torch.int64,
    "I32": torch.int32,
    "I16": torch.int16,
    "I8": torch.int8,
    "U8": torch.uint8,
    "BOOL": torch.bool,
}
"""Element types by their safetensors names."""

_LARGEST_HEADER_BYTES = 100_000_000  # the format's own limit


@dataclass(frozen=True)
class TensorEntry:
    """One tensor that can be read.

    Attributes:
        shape, dtype: as stored. file: where it lies, for messages.
        read: gives the tensor; each call reads anew, nothing is kept.
    """

    shape: tuple[int, ...]
    dtype: torch.dtype
    file: Path
    read: Callable[[], Tensor]

    @property
    def nbytes(self) -> int:
        """Bytes of its elements."""
        count = 1
        for length in self.shape:
            count *= length
        return count * self.dtype.itemsize


Catalogue: TypeAlias = Mapping[str, TensorEntry]


def renamed(entries: Catalogue, rename: Callable[[str], str]) -> dict[str, TensorEntry]:
    """The same tensors under other names."""
    return {rename(name): entry for name, entry in entries.items()}


def from_memory(tensors: Mapping[str, Tensor], file: Path) -> dict[str, TensorEntry]:
    """Tensors that are in memory, or mapped from a file, as a catalogue."""

    def entry(tensor: Tensor) -> TensorEntry:
        return TensorEntry(tuple(tensor.shape), tensor.dtype, file, lambda: tensor)

    return {name: entry(tensor) for name, tensor in tensors.items()}


def with_reader(entry: TensorEntry, read: Callable[[], Tensor]) -> TensorEntry:
    """The same shape and type, read in another way."""
    return replace(entry, read=read)


def open_safetensors(path: Path) -> dict[str, TensorEntry]:
    """Catalogue of one safetensors file; only its header is read, and checked against the file's length.

    Raises:
        CheckpointError: missing, truncated or malformed file.
    """
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            header_bytes = struct.unpack("<Q", file.read(8))[0]
            if header_bytes > min(size - 8, _LARGEST_HEADER_BYTES):
                raise ValueError(f"header of {header_bytes} bytes in a file of {size}")
            header = json.loads(file.read(header_bytes))
        start = 8 + header_bytes
        entries = {
            name: _entry(path, name, fields, start, size)
            for name, fields in header.items()
            if name != "__metadata__"
        }
    except (OSError, ValueError, KeyError, TypeError, AttributeError, struct.error) as error:
        raise CheckpointError(
            f"cannot read the weights {path}: {error}; copy the checkpoint again"
        ) from error
    return entries


def _entry(path: Path, name: str, fields: Any, start: int, size: int) -> TensorEntry:
    begin, end = (int(offset) for offset in fields["data_offsets"])
    shape = tuple(int(length) for length in fields["shape"])
    if fields["dtype"] not in DTYPES:
        raise ValueError(f"tensor {name} has the unknown type {fields['dtype']!r}")
    dtype = DTYPES[fields["dtype"]]
    entry = TensorEntry(shape, dtype, path, lambda: _read(path, start + begin, entry))
    if min(shape, default=0) < 0 or begin < 0 or end - begin != entry.nbytes:
        raise ValueError(f"tensor {name} does not fill its {end - begin} bytes")
    if start + end > size:
        raise ValueError(
            f"the file is truncated, it ends {start + end - size} bytes before tensor {name} does"
        )
    return entry


def _read(path: Path, offset: int, entry: TensorEntry) -> Tensor:
    # A plain read, not a memory map: mapped pages of a 15 GB file count as ours as long as it is open.
    flat = torch.empty(entry.nbytes, dtype=torch.uint8)
    try:
        with path.open("rb") as file:
            file.seek(offset)
            came = file.readinto(memoryview(flat.numpy()))  # type: ignore[arg-type]
    except OSError as error:
        raise CheckpointError(f"cannot read the weights {path}: {error}") from error
    if came != entry.nbytes:
        raise CheckpointError(
            f"cannot read the weights {path}: it became shorter; copy the checkpoint again"
        )
    return flat.view(entry.dtype).view(entry.shape)


def raw_bytes(tensor: Tensor) -> memoryview:
    """The elements of a CPU tensor as bytes, without a copy where it is contiguous."""
    flat = tensor.detach().cpu().contiguous().reshape(-1)
    return memoryview(flat.view(torch.uint8).numpy())  # type: ignore[arg-type]


def check_shapes(
    entries: Catalogue, expected: Mapping[str, tuple[int, ...]], where: str, *, exhaustive: bool
) -> None:
    """Every expected tensor is there with its shape and, if ``exhaustive``, nothing else is.

    Raises:
        CheckpointError: naming the missing, misshapen or extra tensor.
    """
    missing = sorted(set(expected) - set(entries))
    if missing:
        raise CheckpointError(
            f"{where} lacks {len(missing)} tensors, the first is {missing[0]} {expected[missing[0]]}: "
            "the checkpoint is incomplete, copy it again"
        )
    for name, shape in expected.items():
        if entries[name].shape != tuple(shape):
            raise CheckpointError(
                f"{where}: tensor {name} has shape {entries[name].shape}, the configuration asks for "
                f"{tuple(shape)}: config.json and weights belong to different checkpoints"
            )
    extra = sorted(set(entries) - set(expected)) if exhaustive else []
    if extra:
        raise CheckpointError(
            f"{where} holds {len(extra)} tensors that no part of this model reads, the first is {extra[0]} "
            f"{entries[extra[0]].shape} in {entries[extra[0]].file.name}: this is another architecture"
        )


def total_bytes(entries: Iterable[TensorEntry]) -> int:
    """Bytes of all elements."""
    return sum(entry.nbytes for entry in entries)
