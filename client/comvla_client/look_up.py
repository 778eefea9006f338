"""Looks names up beside the calls, which a resolver without an answer must not hold up."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable

from comvla_client.targets import Address, Addresses


class LookUps:
    """Looks a target's names up: one look-up at a time, in a thread of its own.

    A resolver may take many seconds, and nothing can interrupt it. May be used from several threads,
    and from an event loop.

    Args:
        addresses: what the target names.
        clock: monotonic seconds.
    """

    def __init__(
        self, addresses: Addresses, *, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._addresses = addresses
        self._clock = clock
        self._lock = threading.Lock()
        self._began = -math.inf
        self._busy = False
        self._found: list[Address] = []

    def news(self, every_s: float) -> list[Address]:
        """What was found since this was last asked; waits for nothing.

        Args:
            every_s: a look-up begins where none is under way and the last began so many seconds ago.

        Returns:
            All servers that there are; empty where no look-up ended, or nobody is known.
        """
        with self._lock:
            found, self._found = self._found, []
            now = self._clock()
            due = self._addresses.change and not self._busy and now - self._began >= every_s
            if due:
                self._busy, self._began = True, now
        if due:
            threading.Thread(target=self._look_up, name="comvla-names", daemon=True).start()
        return found

    def _look_up(self) -> None:
        found: list[Address] = []
        try:
            found = self._addresses.look_up()
        finally:
            with self._lock:
                self._busy, self._found = False, found
