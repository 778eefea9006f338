"""What a server says of itself at ``/metrics``: memory, descriptors, processor time."""

from __future__ import annotations

import urllib.request
from dataclasses import dataclass

_TIMEOUT_S = 30.0
_NAMES = {
    "process_resident_memory_bytes": "resident_bytes",
    "process_open_fds": "descriptors",
    "process_cpu_seconds_total": "cpu_s",
    "comvla_inference_busy_seconds_total": "busy_s",
    "comvla_suggested_tokens": "suggested_tokens",
}


@dataclass(frozen=True)
class ServerAccount:
    """A server process at one moment.

    Attributes:
        resident_bytes: memory. descriptors: open files and sockets.
        cpu_s: processor seconds since it began. busy_s: seconds in the model.
        suggested_tokens: what it advises, 0 for nothing.
    """

    resident_bytes: float
    descriptors: float
    cpu_s: float
    busy_s: float
    suggested_tokens: float

    @classmethod
    def read(cls, admin_url: str) -> ServerAccount:
        """Asks the server's admin surface.

        Raises:
            RuntimeError: a figure is missing, as on systems without ``/proc``.
        """
        with urllib.request.urlopen(f"{admin_url}/metrics", timeout=_TIMEOUT_S) as page:
            lines = page.read().decode().splitlines()
        found = {
            _NAMES[name]: float(value)
            for name, _, value in (line.partition(" ") for line in lines)
            if name in _NAMES
        }
        missing = set(_NAMES.values()) - set(found)
        if missing:
            raise RuntimeError(
                f"expected {', '.join(sorted(missing))} at {admin_url}/metrics, found none: "
                "run this on Linux"
            )
        return cls(**found)
