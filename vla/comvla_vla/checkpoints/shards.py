"""The weights of a published folder: one safetensors file, or shards and their index."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from typing import Any

from comvla.errors import CheckpointError
from comvla_vla.checkpoints.tensors import TensorEntry, open_safetensors

WEIGHTS = "model.safetensors"
INDEX = "model.safetensors.index.json"


def open_weights(
    folder: Path, wanted: Callable[[str], bool] | None = None
) -> dict[str, TensorEntry]:
    """Catalogue of the folder's main weights.

    Args:
        folder: holds ``model.safetensors``, or an index and its shards.
        wanted: where given, shards with no tensor that it wants may be absent, as when only one half's files were
            fetched.

    Raises:
        CheckpointError: no weights; a shard that is missing, damaged, outside the folder, or does not hold what the
            index says.
    """
    if not (folder / INDEX).is_file():
        return open_safetensors(folder / WEIGHTS)
    places = read_index(folder / INDEX)
    entries: dict[str, TensorEntry] = {}
    for shard in sorted(set(places.values())):
        names = {name for name, place in places.items() if place == shard}
        path = folder / shard
        if not path.is_file():
            if wanted is not None and not any(wanted(name) for name in names):
                continue
            raise CheckpointError(
                f"{folder / INDEX} names the shard {shard}, which is not there: copy it into {folder}"
            )
        there = open_safetensors(path)
        if set(there) != names:
            odd = sorted(set(there) ^ names)[0]
            raise CheckpointError(
                f"{path} and the index disagree about the tensor {odd}: shards and index belong to "
                "different checkpoints"
            )
        entries.update(there)
    return entries


def read_index(path: Path) -> dict[str, str]:
    """Tensor name to shard file name.

    Raises:
        CheckpointError: unreadable, or naming files outside its own folder.
    """
    try:
        table: Any = json.loads(path.read_text())["weight_map"]
        places = {str(name): str(shard) for name, shard in table.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise CheckpointError(
            f"cannot read the index {path}: {error!r}; copy the checkpoint again"
        ) from error
    for shard in set(places.values()):
        parts = PurePosixPath(shard).parts
        if len(parts) != 1 or parts[0] in ("..", "/") or "\\" in shard or "\0" in shard:
            raise CheckpointError(
                f"{path} points at {shard!r}, outside of its folder: shards lie beside their index; "
                "do not use this checkpoint unless you know where it comes from"
            )
    return places
