"""How busy the inference thread has been lately."""

from __future__ import annotations

from collections import deque


class BusyMeter:
    """Share of a sliding window spent working. Times are the caller's monotonic seconds.

    Spans of work follow one another, so only the oldest can reach out of the window, and the sum is
    kept up to date instead of being taken again for every answer.
    """

    def __init__(self, window_s: float = 5.0) -> None:
        self._window_s = window_s
        self._spans: deque[tuple[float, float]] = deque()
        self._spans_s = 0.0
        self._since: float | None = None

    def begin(self, now_s: float) -> None:
        """Work starts."""
        self._since = now_s

    def end(self, now_s: float) -> None:
        """Work ends."""
        if self._since is None:
            return
        self._spans.append((self._since, now_s))
        self._spans_s += now_s - self._since
        self._since = None
        self._forget(now_s - self._window_s)

    def utilization(self, now_s: float) -> float:
        """Busy share of the last ``window_s`` seconds, 0 to 1, work in progress included."""
        horizon_s = now_s - self._window_s
        self._forget(horizon_s)
        busy_s = self._spans_s
        if self._spans:
            busy_s -= max(0.0, horizon_s - self._spans[0][0])
        if self._since is not None:
            busy_s += now_s - max(self._since, horizon_s)
        return min(1.0, max(0.0, busy_s / self._window_s))

    def _forget(self, horizon_s: float) -> None:
        while self._spans and self._spans[0][1] <= horizon_s:
            start_s, end_s = self._spans.popleft()
            self._spans_s -= end_s - start_s
        if not self._spans:
            self._spans_s = 0.0  # rounding must not pile up
