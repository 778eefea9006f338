"""Memory and descriptors of the processes that are fuzzed."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

# What may be left of growth after the warm-up: caches that were not full yet, and the allocator.
_GROWTH_SHARE, _GROWTH_BYTES = 0.05, 16 * 2**20
_GROWTH_DESCRIPTORS = 8
_WARM_SHARE = 0.25


@dataclass
class Watch:
    """Samples of one process; Linux only, elsewhere there are none.

    Attributes:
        name: for people.
        pid: of the process.
        samples: (share of the run that is over, resident bytes, open descriptors).
    """

    name: str
    pid: int
    samples: list[tuple[float, int, int]] = field(default_factory=list)

    def look(self, share: float) -> None:
        """Takes a sample."""
        folder = Path("/proc") / str(self.pid)
        try:
            pages = int((folder / "statm").read_text().split()[1])
            descriptors = len(os.listdir(folder / "fd"))
        except (OSError, ValueError, IndexError):
            return
        if pages == 0:  # it has ended, and nobody has asked yet how
            return
        self.samples.append((share, pages * os.sysconf("SC_PAGE_SIZE"), descriptors))

    def verdict(self) -> dict[str, Any]:
        """Resident memory and descriptors in the second and the last quarter, and whether they grew."""
        warm = [sample for sample in self.samples if sample[0] >= _WARM_SHARE]
        if len(warm) < 2:
            return {"name": self.name, "measured": False, "grew": False}
        # Large requests come and go, so one sample may be 10 % above the next: quarters are compared.
        early = [sample for sample in warm if sample[0] < 2 * _WARM_SHARE] or warm[:1]
        late = [sample for sample in warm if sample[0] >= 1.0 - _WARM_SHARE] or warm[-1:]
        resident = int(median(sample[1] for sample in early))
        resident_end = min(int(median(sample[1] for sample in late)), warm[-1][1])
        descriptors, descriptors_end = early[0][2], warm[-1][2]
        room = max(_GROWTH_BYTES, _GROWTH_SHARE * resident)
        return {
            "name": self.name,
            "measured": True,
            "warm_bytes": resident,
            "end_bytes": resident_end,
            "most_bytes": max(sample[1] for sample in self.samples),
            "warm_descriptors": descriptors,
            "end_descriptors": descriptors_end,
            "grew": resident_end - resident > room
            or descriptors_end - descriptors > _GROWTH_DESCRIPTORS,
        }
