"""How demonstrations lie on disk: a manifest, and shards of plain arrays that appear when complete.

A data set is a folder with ``manifest.json`` and one folder per shard, each with ``.npy`` files
(see :class:`comvla_sim.training.recording.Frames` for their shapes) and a ``shard.json``.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import fields
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from comvla.errors import ComVLAError
from comvla_sim.training.recording import Frames, Recording
from comvla_sim.worlds import make

FORMAT = 1
ARRAYS: tuple[str, ...] = tuple(field.name for field in fields(Frames))
_MANIFEST = "manifest.json"
_SHARD = "shard.json"


class DemonstrationsError(ComVLAError):
    """A data set that is missing, damaged, or made with other settings than asked for."""


def _read_json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise DemonstrationsError(f"cannot read {path}: {error}") from error
    if not isinstance(content, dict):
        raise DemonstrationsError(f"{path} holds no JSON object")
    return content


def _write_json(path: Path, content: dict[str, Any]) -> None:
    temporary = path.with_name(f".{path.name}.tmp")
    temporary.write_text(json.dumps(content, indent=1) + "\n")
    temporary.replace(path)


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "unknown"


def _describe(recording: Recording) -> dict[str, Any]:
    """The manifest of a data set with these settings."""
    world = make(recording.world, render=False)
    tasks = [{"name": task.name, "instruction": task.instruction} for task in world.tasks]
    world.close()
    packages = ("comvla", "mujoco", "metaworld", "numpy")
    return {
        "format": FORMAT,
        "recording": recording.as_json(),
        "tasks": tasks,
        "versions": {package: _version(package) for package in packages},
    }


def prepare_folder(out: Path, recording: Recording) -> None:
    """Writes the manifest of a new data set, or checks that of one to be continued.

    Raises:
        DemonstrationsError: when the folder holds a data set made otherwise.
    """
    path = out / _MANIFEST
    wanted = _describe(recording)
    if not path.exists():
        if any(out.glob("shard-*")):
            raise DemonstrationsError(f"{out} has shards but no {_MANIFEST}: use another folder")
        out.mkdir(parents=True, exist_ok=True)
        _write_json(path, wanted)
        return
    found = _read_json(path)
    for key in ("format", "recording", "tasks"):
        if found.get(key) != wanted[key]:
            raise DemonstrationsError(
                f"{out} was made with other settings ({key}: {found.get(key)}, asked for "
                f"{wanted[key]}): use another folder, or the same settings"
            )
    made_with, have = found.get("versions", {}).get("mujoco"), wanted["versions"]["mujoco"]
    if made_with != have:
        raise DemonstrationsError(
            f"{out} was made with MuJoCo {made_with}, this is {have}: use another folder, or the "
            "same version"
        )


def read_manifest(path: Path) -> dict[str, Any]:
    """The manifest of a data set. DemonstrationsError when there is none of this format."""
    if not (path / _MANIFEST).exists():
        raise DemonstrationsError(f"{path} holds no demonstrations (no {_MANIFEST}): make them")
    manifest = _read_json(path / _MANIFEST)
    if manifest.get("format") != FORMAT:
        raise DemonstrationsError(
            f"{path} has format {manifest.get('format')}, expected {FORMAT}: make it anew"
        )
    return manifest


def shard_folder(out: Path, number: int) -> Path:
    """Where a shard lies."""
    return out / f"shard-{number:05d}"


def shard_folders(path: Path) -> list[Path]:
    """The finished shards of a data set, in order."""
    return sorted(path.glob("shard-*"))


def read_shard(folder: Path) -> dict[str, Any]:
    """The description of a finished shard: layouts, frames, episodes and successes per task."""
    return _read_json(folder / _SHARD)


def finished_shard(folder: Path, layouts: Sequence[int]) -> dict[str, Any] | None:
    """The description of a shard if it is finished, else None.

    Raises:
        DemonstrationsError: when it was made of other layouts.
    """
    if not folder.exists():
        return None
    shard = read_shard(folder)
    if shard.get("layouts") != list(layouts):
        raise DemonstrationsError(
            f"{folder} holds other layouts than asked for: a data set can be continued with more "
            "layouts at the end of the list, not with others"
        )
    return shard


def write_shard(folder: Path, frames: Frames, description: dict[str, Any]) -> None:
    """Writes a shard under a temporary name and renames it when it is complete."""
    temporary = folder.with_name(f".{folder.name}.tmp")
    shutil.rmtree(temporary, ignore_errors=True)  # of a run that was killed
    temporary.mkdir(parents=True)
    for name in ARRAYS:
        values = getattr(frames, name)
        # Row by row into the file: a stacked copy of the pictures would double the memory.
        array = np.lib.format.open_memmap(
            temporary / f"{name}.npy",
            mode="w+",
            dtype=values[0].dtype,
            shape=(len(values), *values[0].shape),
        )
        for row, value in enumerate(values):
            array[row] = value
        array.flush()
    _write_json(temporary / _SHARD, description)
    temporary.rename(folder)


def load_array(folder: Path, name: str, length: int) -> npt.NDArray[Any]:
    """One array of a shard, memory-mapped. DemonstrationsError unless it has ``length`` rows."""
    path = folder / f"{name}.npy"
    try:
        array: npt.NDArray[Any] = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError) as error:
        raise DemonstrationsError(
            f"cannot read {path}: {error}; delete {folder.name} and generate again"
        ) from error
    if len(array) != length:
        raise DemonstrationsError(
            f"{path} has {len(array)} frames, expected {length}; delete {folder.name} and "
            "generate again"
        )
    return array
