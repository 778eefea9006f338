"""Where a figure was measured: without this, a figure means nothing."""

from __future__ import annotations

import os
import platform
from importlib import metadata
from pathlib import Path
from typing import Any

PACKAGES = (
    "comvla",
    "numpy",
    "torch",
    "grpcio",
    "protobuf",
    "websockets",
    "msgpack",
    "openpi-client",
)


def describe() -> dict[str, Any]:
    """Processor, cores, load and versions, as JSON has them."""
    return {
        "cpu": _cpu_model(),
        "cores": _usable_cores(),
        "load_average": _load_average(),
        "system": platform.platform(),
        "python": platform.python_version(),
        "versions": {name: _version(name) for name in PACKAGES},
    }


def _usable_cores() -> int:
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on macOS
        return os.cpu_count() or 1


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or "unknown"
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.machine())


def _load_average() -> float | None:
    """Processes that wanted to run over the last minute, before this benchmark had its share."""
    try:
        return os.getloadavg()[0]
    except OSError:
        return None


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None
