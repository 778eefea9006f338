"""Writes a policy that is in memory, whole."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tokenizers import Tokenizer

from comvla_vla.checkpoints.identity import combine, tensor_digest
from comvla_vla.checkpoints.native import WEIGHTS, publish, write_around
from comvla_vla.checkpoints.opened import Checkpoint
from comvla_vla.checkpoints.safetensors_writer import SafetensorsWriter, file_order
from comvla_vla.checkpoints.tensors import from_memory
from comvla_vla.naming import to_published
from comvla_vla.nets import CloudNet, EdgeNet


def save_policy(
    folder: Path,
    edge: EdgeNet,
    cloud: CloudNet,
    tokenizer: Tokenizer,
    statistics: Mapping[str, Any],
) -> str:
    """Writes a whole policy; returns its fingerprint. The folder appears complete or not at all."""
    tensors = {**to_published(edge), **to_published(cloud)}
    digests = {name: tensor_digest(tensor) for name, tensor in tensors.items()}
    digest = combine(cloud.config, statistics, digests)
    entries = from_memory(tensors, folder / WEIGHTS)
    checkpoint = Checkpoint(
        where=str(folder),
        half="whole",
        config=cloud.config,
        statistics=dict(statistics),
        tokenizer=tokenizer.to_str(),
        tensors=entries,
        fingerprint=digest,
    )
    partial = folder.with_name(folder.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        with SafetensorsWriter(partial / WEIGHTS, entries) as writer:
            for name in file_order(entries):
                writer.write(name, tensors[name].cpu())
        write_around(partial, checkpoint, "whole", digest, digests)
        publish(partial, folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return digest
