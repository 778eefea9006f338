"""Keeps a misbehaving client from filling the disk with log lines."""

from __future__ import annotations

from collections.abc import Callable


class LogThrottle:
    """At most one line per kind and interval. Metrics count everything; the log shows examples.

    Args:
        clock: monotonic seconds.
        interval_s: least time between two lines of a kind, seconds.
    """

    def __init__(self, clock: Callable[[], float], interval_s: float = 1.0) -> None:
        self._clock = clock
        self._interval_s = interval_s
        self._last_s: dict[str, float] = {}
        self._suppressed: dict[str, int] = {}

    def allow(self, kind: str) -> int | None:
        """None to keep quiet, else how many lines of this kind were kept back before."""
        now_s = self._clock()
        if kind in self._last_s and now_s - self._last_s[kind] < self._interval_s:
            self._suppressed[kind] = self._suppressed.get(kind, 0) + 1
            return None
        self._last_s[kind] = now_s
        return self._suppressed.pop(kind, 0)
