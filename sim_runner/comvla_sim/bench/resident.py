"""How much memory this process has, and had at most."""

from __future__ import annotations

import contextlib
import sys
from pathlib import Path

_STATUS = Path("/proc/self/status")
_RESET = Path("/proc/self/clear_refs")


def now_bytes() -> int | None:
    """Resident memory now; None where the system does not tell."""
    return _field("VmRSS:")


def forget_peak() -> None:
    """Starts the peak anew from now, where the system can (Linux)."""
    with contextlib.suppress(OSError):
        _RESET.write_text("5")


def peak_bytes() -> int:
    """Most resident memory since :func:`forget_peak`, or since the process began."""
    peak = _field("VmHWM:")
    if peak is not None:
        return peak
    import resource

    largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return largest if sys.platform == "darwin" else largest * 1024


def _field(name: str) -> int | None:
    try:
        lines = _STATUS.read_text().splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith(name)), None)
