"""Is there room? Asked before gigabytes are read, not found out half-way."""

from __future__ import annotations

import shutil
from pathlib import Path

from comvla.errors import CheckpointError

# Beyond the weights: one tensor in flight, the activations of a batch, the process itself.
WORKING_BYTES = 256 * 2**20


def available_bytes() -> int | None:
    """Memory that can be had without swapping, on this machine and in this container; None where the system does
    not tell (not Linux)."""
    known = [room for room in (_machine_bytes(), _container_bytes()) if room is not None]
    return min(known, default=None)


def _machine_bytes() -> int | None:
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return None
    for line in lines:
        if line.startswith("MemAvailable:"):
            return int(line.split()[1]) * 1024
    return None


def _container_bytes(folder: Path = Path("/sys/fs/cgroup")) -> int | None:
    """What is left of a limit (control groups, version 2); whoever goes beyond it is killed without a word."""
    try:
        limit, used = ((folder / f"memory.{name}").read_text() for name in ("max", "current"))
        lines = (folder / "memory.stat").read_text().splitlines()
    except OSError:
        return None
    if limit.strip() == "max":
        return None
    # Pages of files that were read once are given up first.
    cached = sum(int(line.split()[1]) for line in lines if line.startswith("inactive_file "))
    return max(0, int(limit) - int(used) + cached)


def check_memory(weight_bytes: int, what: str) -> None:
    """Refuses to load what cannot fit.

    Raises:
        CheckpointError: saying how much is needed and how much there is.
    """
    there = available_bytes()
    need = weight_bytes + min(weight_bytes, WORKING_BYTES)
    if there is not None and there < need:
        raise CheckpointError(
            f"{what} needs {gigabytes(need)} of memory ({gigabytes(weight_bytes)} for weights), "
            f"{gigabytes(there)} are available: use a narrower dtype (bfloat16), free memory, or run it on "
            "a larger machine"
        )


def check_disk(folder: Path, nbytes: int) -> None:
    """Refuses to write what cannot fit.

    Args:
        folder: an existing folder of the disk. nbytes: to be written.

    Raises:
        CheckpointError: saying how much is needed and how much there is.
    """
    free = shutil.disk_usage(folder).free
    if free < nbytes:
        raise CheckpointError(
            f"the two halves need {gigabytes(nbytes)} on the disk of {folder}, {gigabytes(free)} are free: "
            "choose another destination"
        )


def gigabytes(nbytes: int) -> str:
    """For messages: 13.7 GB (10^9 bytes)."""
    return f"{nbytes / 1e9:.3g} GB"
