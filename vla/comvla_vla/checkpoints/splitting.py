"""Cuts a checkpoint in two on disk, tensor by tensor, and checks the result against its source."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from comvla.errors import CheckpointError
from comvla_vla.checkpoints.accounting import HALVES, Half, half_shapes
from comvla_vla.checkpoints.identity import combine, tensor_digest
from comvla_vla.checkpoints.memory import check_disk, gigabytes
from comvla_vla.checkpoints.native import WEIGHTS, publish, write_around
from comvla_vla.checkpoints.opened import Checkpoint
from comvla_vla.checkpoints.opening import open_checkpoint
from comvla_vla.checkpoints.published import Recipe
from comvla_vla.checkpoints.safetensors_writer import SafetensorsWriter, file_order
from comvla_vla.checkpoints.tensors import check_shapes, total_bytes

_SMALL_FILES_BYTES = 64 * 2**20  # tokenizer, configuration, statistics, twice


@dataclass(frozen=True)
class SplitReport:
    """What a split holds.

    Attributes:
        fingerprint: of both halves.
        tensors, nbytes: of each half, by its name. shared_bytes: stand in both.
        left_out: tensors of the source that neither half reads.
    """

    fingerprint: str
    tensors: dict[Half, int]
    nbytes: dict[Half, int]
    shared_bytes: int
    left_out: int


def split_checkpoint(
    source: str | Path,
    destination: str | Path,
    *,
    recipe: Recipe | None = None,
    tokenizer: str | Path | None = None,
    base: str | Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> SplitReport:
    """Writes ``edge/`` and ``cloud/`` under ``destination``, each with only the tensors that its half needs.

    Memory holds one tensor at a time, each is read once, and the destination appears complete or not at all.

    Args:
        source: a whole policy of this project's or the published format, or ``hf://owner/name``.
        destination: a folder that does not exist yet.
        recipe, tokenizer, base: of a published checkpoint, see :func:`~comvla_vla.checkpoints.open_checkpoint`.
        progress: told (bytes done, bytes in all) after each tensor.

    Raises:
        CheckpointError: the source is not a whole policy, the destination exists already, or its disk is too small.
    """
    target = Path(destination)
    if target.exists():
        raise CheckpointError(
            f"{target} exists already: choose a new folder, nothing is overwritten"
        )
    checkpoint = open_checkpoint(source, "whole", recipe, tokenizer, base)
    # Before hours of copying: what would not load must not be written.
    checkpoint.prompt()
    checkpoint.check_content()
    parts = {half: _part(checkpoint, half) for half in HALVES}
    target.parent.mkdir(parents=True, exist_ok=True)
    need = sum(total_bytes(p.tensors.values()) for p in parts.values()) + _SMALL_FILES_BYTES
    check_disk(target.parent, need)
    partial = target.with_name(target.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    try:
        for half in HALVES:
            (partial / half).mkdir(parents=True)
        digests = _write_weights(checkpoint, parts, partial, progress)
        digest = _fingerprint(checkpoint, digests)
        for half, part in parts.items():
            of_half = {name: digests[name] for name in part.tensors}
            write_around(partial / half, checkpoint, half, digest, of_half)
        publish(partial, target)
    except OSError as error:
        raise CheckpointError(f"cannot write {partial}: {error}") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return _report(checkpoint, parts, digest)


def check_split(
    source: str | Path,
    destination: str | Path,
    *,
    recipe: Recipe | None = None,
    tokenizer: str | Path | None = None,
    base: str | Path | None = None,
) -> SplitReport:
    """Compares a split with its source, every weight bit by bit.

    Args:
        source, recipe, tokenizer, base: as they were given to :func:`split_checkpoint`.
        destination: what it wrote.

    Raises:
        CheckpointError: naming the first difference.
    """
    checkpoint = open_checkpoint(source, "whole", recipe, tokenizer, base)
    parts: dict[Half, Checkpoint] = {}
    for half in HALVES:
        part = parts[half] = open_checkpoint(Path(destination) / half, half)
        part.check_content()
        for what in ("config", "statistics", "tokenizer"):
            if getattr(part, what) != getattr(checkpoint, what):
                raise CheckpointError(
                    f"{part.where} has another {what} than {checkpoint.where}: split it again"
                )
        expected = half_shapes(half, checkpoint.config)
        check_shapes(part.tensors, expected, part.where, exhaustive=True)
    digests = {}
    for name in _needed(parts):
        tensor = checkpoint.tensors[name].read()
        digests[name] = tensor_digest(tensor)
        for part in parts.values():
            if name not in part.tensors:
                continue
            if tensor_digest(part.tensors[name].read()) != digests[name]:
                raise CheckpointError(
                    f"{part.where}: tensor {name} differs from {checkpoint.where}: split it again"
                )
            part.check_digest(name, digests[name])
    digest = _fingerprint(checkpoint, digests)
    for part in parts.values():
        if part.fingerprint != digest:
            raise CheckpointError(
                f"{part.where} carries the fingerprint {part.fingerprint}, its weights give {digest}: split it again"
            )
    return _report(checkpoint, parts, digest)


def describe(report: SplitReport) -> str:
    """A report in a few lines."""
    lines = [
        f"{half:6} {report.tensors[half]:5} tensors {gigabytes(report.nbytes[half]):>9}"
        for half in HALVES
    ]
    return "\n".join(
        [
            *lines,
            f"both hold the same {gigabytes(report.shared_bytes)}; {report.left_out} tensors serve neither half",
            f"fingerprint {report.fingerprint}",
        ]
    )


def _part(checkpoint: Checkpoint, half: Half) -> Checkpoint:
    """The same checkpoint with one half's tensors only."""
    names = half_shapes(half, checkpoint.config)
    check_shapes(checkpoint.tensors, names, checkpoint.where, exhaustive=False)
    return Checkpoint(
        where=checkpoint.where,
        half=half,
        config=checkpoint.config,
        statistics=checkpoint.statistics,
        tokenizer=checkpoint.tokenizer,
        tensors={name: checkpoint.tensors[name] for name in names},
        fingerprint=checkpoint.fingerprint,
    )


def _needed(parts: dict[Half, Checkpoint]) -> list[str]:
    """Names of all tensors that some half reads, in the order of the files."""
    return file_order({n: e for part in parts.values() for n, e in part.tensors.items()})


def _write_weights(
    checkpoint: Checkpoint,
    parts: dict[Half, Checkpoint],
    folder: Path,
    progress: Callable[[int, int], None] | None,
) -> dict[str, str]:
    """Streams all weights into the files of both halves; returns their digests by name."""
    names = _needed(parts)
    whole = sum(checkpoint.tensors[name].nbytes for name in names)
    digests, done = {}, 0
    with ExitStack() as stack:
        writers = {
            half: stack.enter_context(SafetensorsWriter(folder / half / WEIGHTS, part.tensors))
            for half, part in parts.items()
        }
        for name in names:
            tensor = checkpoint.tensors[name].read()
            digests[name] = tensor_digest(tensor)
            checkpoint.check_digest(name, digests[name])
            for half, part in parts.items():
                if name in part.tensors:
                    writers[half].write(name, tensor)
            done += checkpoint.tensors[name].nbytes
            if progress is not None:
                progress(done, whole)
    return digests


def _fingerprint(checkpoint: Checkpoint, digests: Mapping[str, str]) -> str:
    """As stored, else over configuration, statistics and all weights."""
    return checkpoint.fingerprint or combine(checkpoint.config, checkpoint.statistics, digests)


def _report(checkpoint: Checkpoint, parts: dict[Half, Checkpoint], digest: str) -> SplitReport:
    edge, cloud = parts["edge"].tensors, parts["cloud"].tensors
    shared = [entry for name, entry in edge.items() if name in cloud]
    return SplitReport(
        fingerprint=digest,
        tensors={half: len(part.tensors) for half, part in parts.items()},
        nbytes={half: total_bytes(part.tensors.values()) for half, part in parts.items()},
        shared_bytes=total_bytes(shared),
        left_out=len(set(checkpoint.tensors) - set(edge) - set(cloud)),
    )
