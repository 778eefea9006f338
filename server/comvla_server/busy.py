"""How busy the inference thread has been lately."""

from __future__ import annotations

from collections import deque


class BusyMeter:
    """Share of a sliding window spent working. Times are the caller's monotonic seconds."""

    def __init__(self, window_s: float = 5.0) -> None:
        self._window_s = window_s
        self._spans: deque[tuple[float, float]] = deque()
        self._since: float | None = None

    def begin(self, now_s: float) -> None:
        """Work starts."""
        self._since = now_s

    def end(self, now_s: float) -> None:
        """Work ends."""
        if self._since is not None:
            self._spans.append((self._since, now_s))
        self._since = None
        self._forget(now_s)

    def utilization(self, now_s: float) -> float:
        """Busy share of the last ``window_s`` seconds, 0 to 1, work in progress included."""
        self._forget(now_s)
        horizon = now_s - self._window_s
        spans = [*self._spans]
        if self._since is not None:
            spans.append((self._since, now_s))
        busy_s = sum(max(0.0, end - max(start, horizon)) for start, end in spans)
        return min(1.0, busy_s / self._window_s)

    def _forget(self, now_s: float) -> None:
        while self._spans and self._spans[0][1] <= now_s - self._window_s:
            self._spans.popleft()
