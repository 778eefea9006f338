"""This project's own format: a folder with one half or both, in safetensors and JSON.

``config.json`` holds format, half, fingerprint and model; ``model.safetensors`` names as OpenVLA-OFT publishes them,
side modules under ``action_head.`` and ``proprio_projector.``; beside them ``dataset_statistics.json`` and
``tokenizer.json``, and ``digests.json`` with a digest of each tensor, by which damage is noticed when a half is loaded.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from comvla.errors import CheckpointError
from comvla_vla.checkpoints.opened import CONTENT, Checkpoint
from comvla_vla.checkpoints.tensors import open_safetensors
from comvla_vla.config import ModelConfig

CONFIG, WEIGHTS, STATISTICS, TOKENIZER, DIGESTS = (
    "config.json",
    "model.safetensors",
    "dataset_statistics.json",
    "tokenizer.json",
    "digests.json",
)
FORMAT = "comvla-1"


def open_native(folder: Path, header: Mapping[str, Any]) -> Checkpoint:
    """Opens a folder of this format.

    Raises:
        CheckpointError: incomplete or damaged.
    """
    missing = {"model", "fingerprint", "half"} - set(header)
    if missing or header["half"] not in ("whole", "edge", "cloud"):
        raise CheckpointError(
            f"{folder / CONFIG} lacks {sorted(missing) or 'a known half'}: the checkpoint is damaged, copy it again"
        )
    return Checkpoint(
        where=str(folder),
        half=header["half"],
        config=ModelConfig.from_dict(header["model"]),
        statistics=read_json(folder / STATISTICS, "the data-set statistics"),
        tokenizer=read_text(folder / TOKENIZER, "the tokenizer"),
        tensors=open_safetensors(folder / WEIGHTS),
        fingerprint=str(header["fingerprint"]),
        header=header,
        # Early checkpoints have neither these nor the digest over them.
        digests=read_json(folder / DIGESTS, "the digests") if CONTENT in header else None,
    )


def write_around(
    folder: Path, checkpoint: Checkpoint, half: str, digest: str, digests: Mapping[str, str]
) -> None:
    """Writes everything but the weights.

    Args:
        folder: where. checkpoint: what. half: of it.
        digest: fingerprint of the whole. digests: of the tensors that the half holds, by name.
    """
    header = {
        "format": FORMAT,
        "half": half,
        "fingerprint": digest,
        "model": checkpoint.config.to_dict(),
    }
    # Tuples become lists on disk, and what is digested has to be what will be read.
    header = json.loads(json.dumps(header))
    header[CONTENT] = replace(checkpoint, header=header, digests=digests).content()
    for name, content in (
        (CONFIG, header),
        (STATISTICS, checkpoint.statistics),
        (DIGESTS, dict(sorted(digests.items()))),
    ):
        (folder / name).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    (folder / TOKENIZER).write_text(checkpoint.tokenizer, encoding="utf-8", newline="\n")


def publish(partial: Path, folder: Path) -> None:
    """Puts a finished folder in its place, readable for services under other accounts.

    An older checkpoint there is replaced, and kept until the new one stands.

    Raises:
        CheckpointError: the place is taken by something that is not a checkpoint.
    """
    if (
        folder.exists()
        and not (folder / CONFIG).is_file()
        and (not folder.is_dir() or any(folder.iterdir()))
    ):
        raise CheckpointError(
            f"{folder} holds something that is not a checkpoint: choose another folder"
        )
    for file in partial.rglob("*"):
        if file.is_file():
            file.chmod(0o644)
    replaced = folder.with_name(folder.name + ".replaced")
    shutil.rmtree(replaced, ignore_errors=True)
    if folder.exists():
        folder.rename(replaced)
    partial.rename(folder)
    shutil.rmtree(replaced, ignore_errors=True)


def read_json(path: Path, what: str) -> dict[str, Any]:
    """A JSON object.

    Raises:
        CheckpointError: unreadable, or something else.
    """
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise CheckpointError(f"cannot read {what} {path}: {error}") from error
    if not isinstance(table, dict):
        raise CheckpointError(f"cannot read {what} {path}: it holds no mapping")
    return table


def read_text(path: Path, what: str) -> str:
    """A text file.

    Raises:
        CheckpointError: unreadable.
    """
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        raise CheckpointError(f"cannot read {what} {path}: {error}") from error
