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
# A call as long as this has its code in the caches after a thousandth of itself: it takes single turns.
LONG_S = 0.05

Clock = Callable[[], float]


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
        calls, repetitions, warm_up: see :func:`durations`.

    Returns:
        Timings by name, in the order of ``calls``.

    Raises:
        ValueError: ``repetitions`` below 1 or ``warm_up`` below 0.
    """
    found = durations(calls, repetitions=repetitions, warm_up=warm_up)
    return {name: Timing.of(values) for name, values in found.items()}


def durations(
    calls: Mapping[str, Callable[[], object]],
    *,
    repetitions: int,
    warm_up: int,
    clock: Clock = time.perf_counter,
) -> dict[str, list[float]]:
    """Seconds of each single call, in turns: the n-th values of two contenders were taken side by side.

    Args:
        calls: contenders by name.
        repetitions: timed calls of each.
        warm_up: calls of each that come first and are not counted.
        clock: what tells seconds.

    Returns:
        Durations by name, in the order of ``calls``.

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
    done, turn = 0, 1
    while done < repetitions:
        for name, call in calls.items():
            for _ in range(turn):
                began = clock()
                call()
                durations_s[name].append(clock() - began)
        done += turn
        slowest = max(values[0] for values in durations_s.values())
        turn = min(1 if slowest > LONG_S else BLOCK, repetitions - done)
    return durations_s


def paired_ratio(mine: Sequence[float], other: Sequence[float]) -> float:
    """Median of the ratios of durations taken side by side: what the machine did meanwhile fell on both."""
    return float(np.median(np.divide(mine, other)))
