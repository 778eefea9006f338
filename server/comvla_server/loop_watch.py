"""Whether an event loop keeps up with what arrives."""

from __future__ import annotations

import asyncio
import random
import time
from collections.abc import Callable

_TICK_S = 0.05
_MEMORY = 0.7  # of the last value at each tick: half of it is forgotten after 0.1 s
_BUSY = 0.5
_LATE_S = 0.005
_DEATHS = 0.02
_LEAST_CALLS = 5  # in one look: 100 a second, far below what a loop can read
_LEAST_LOOKED_AT = 0.05


class LoopWatch:
    """Looks twenty times a second how much processor time the loop's thread takes, and how late it is.

    A loop that works all the time no longer sees how long calls wait for it inside gRPC. It is late where other
    threads or programs take the processor from it.

    Where calls then die on their way through the server, it takes on more than it can do, whatever the model could:
    fewer of them are looked at, a fifth fewer at each look, until the others live; then slowly more again.
    Where few calls come, it is not they who keep the loop from its work, and all are looked at.
    Calls that came with too little time for any answer die wherever they go. Those of many callers have waited before
    they were seen, and count once for each caller but one: one robot whose calls are hopeless shuts nobody out.

    Args:
        clock: monotonic seconds.
        processor: seconds that this thread has worked.
        draw: a number in [0, 1).

    Attributes:
        busy: share of its time that it works, 0 to 1. late_s: how late it comes to what is due, seconds.
        looked_at: share of calls that are worth a look.
    """

    def __init__(
        self,
        clock: Callable[[], float] = time.monotonic,
        processor: Callable[[], float] = time.thread_time,
        draw: Callable[[], float] = random.random,
    ) -> None:
        self._clock = clock
        self._processor = processor
        self._draw = draw
        self._lived = self._died = 0
        self._hopeless: set[str] = set()
        self.looked_at = 1.0
        self._last: tuple[float, float] | None = None
        self.busy = 0.0
        self.late_s = 0.0

    @property
    def congested(self) -> bool:
        """Whether calls may be waiting that the loop has not seen yet."""
        return self.busy > _BUSY or self.late_s > _LATE_S

    def note(self, *, died: bool, who: str = "", hopeless: bool = False) -> None:
        """A call left the server.

        Args:
            died: of its deadline.
            who: made it.
            hopeless: it came with too little time for an answer.
        """
        if died and hopeless:
            self._hopeless.add(who)
        else:
            self._died += died
            self._lived += not died

    def skips(self) -> bool:
        """Whether the next call is one of those that are not looked at."""
        return self.looked_at < 1.0 and self._draw() >= self.looked_at

    def forget(self) -> None:
        """Begins anew: what was seen before anybody was served says nothing of the time after it."""
        self._last = None
        self._lived = self._died = 0
        self._hopeless.clear()
        self.busy = self.late_s = 0.0
        self.looked_at = 1.0

    async def run(self) -> None:
        """Looks until it is cancelled; on the loop that is watched."""
        while True:
            self.look()
            await asyncio.sleep(_TICK_S)

    def look(self) -> None:
        """One look, which ``run`` takes every 50 ms."""
        now_s, worked_s = self._clock(), self._processor()
        if self._last is not None:
            since_s, before_s = now_s - self._last[0], worked_s - self._last[1]
            busy = min(1.0, before_s / max(since_s, 1e-9))
            late_s = max(0.0, since_s - _TICK_S)
            self.busy += (1.0 - _MEMORY) * (busy - self.busy)
            self.late_s += (1.0 - _MEMORY) * (late_s - self.late_s)
        self._last = now_s, worked_s
        died = self._died + max(0, len(self._hopeless) - 1)
        calls = died + self._lived
        if self.congested and calls >= _LEAST_CALLS and died > _DEATHS * calls:
            self.looked_at = max(_LEAST_LOOKED_AT, 0.8 * self.looked_at)
        else:
            self.looked_at = min(1.0, self.looked_at + 0.02)
        self._lived = self._died = 0
        self._hopeless.clear()
