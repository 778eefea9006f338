"""Repeated timings, with what must not be counted left out."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Contenders take turns in blocks: a busy moment of the machine then falls on all of them, and each
# still runs often enough in a row to have its own code in the caches.
BLOCK = 25


@dataclass(frozen=True)
class Timing:
    """Durations of one repeated call.

    Attributes:
        median_s: median, seconds.
        p99_s: 99th percentile, seconds.
        repetitions: calls counted, warm-up excluded.
    """

    median_s: float
    p99_s: float
    repetitions: int

    @classmethod
    def of(cls, durations_s: Sequence[float] | NDArray[np.float64]) -> Timing:
        """Summarises durations in seconds.

        Raises:
            ValueError: no durations.
        """
        if len(durations_s) == 0:
            raise ValueError(
                "expected at least one duration, got none: repeat the call at least once"
            )
        median, p99 = np.percentile(durations_s, [50, 99])
        return cls(float(median), float(p99), len(durations_s))


def measure(
    calls: Mapping[str, Callable[[], object]], *, repetitions: int, warm_up: int
) -> dict[str, Timing]:
    """Times each call, in turns.

    Args:
        calls: contenders by name.
        repetitions: timed calls of each.
        warm_up: calls of each that come first and are not counted.

    Returns:
        Timings by name, in the order of ``calls``.

    Raises:
        ValueError: ``repetitions`` below 1 or ``warm_up`` below 0.
    """
    if repetitions < 1 or warm_up < 0:
        raise ValueError(
            f"expected repetitions >= 1 and warm_up >= 0, got {repetitions} and {warm_up}"
        )
    for call in calls.values():
        for _ in range(warm_up):
            call()
    durations_s: dict[str, list[float]] = {name: [] for name in calls}
    for start in range(0, repetitions, BLOCK):
        for name, call in calls.items():
            for _ in range(min(BLOCK, repetitions - start)):
                began = time.perf_counter()
                call()
                durations_s[name].append(time.perf_counter() - began)
    return {name: Timing.of(values) for name, values in durations_s.items()}
