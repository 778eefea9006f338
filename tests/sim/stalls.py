"""Checks of what was measured in real time, on machines that stall for a moment now and then."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

STALL_S = 0.05
"""So late, one control period, an ordinary thread does not wake up on a machine with time to spare."""

_LOOK_EVERY_S = 0.01
_ATTEMPTS = 3


def unless_stalled(check: Callable[[], None]) -> None:
    """Runs a check, and runs it again where it failed while the machine stalled.

    A failure on a quiet machine counts at once, and the last one counts in any case.

    Args:
        check: measures anew whenever it is called, and asserts.
    """
    for left in reversed(range(_ATTEMPTS)):
        watch = _Watch()
        try:
            with watch:
                check()
            return
        except AssertionError:
            if not left or watch.longest_s < STALL_S:
                raise


class _Watch:
    """Sleeps a little, again and again, and notes how much later than asked it woke up at worst."""

    def __init__(self) -> None:
        self.longest_s = 0.0
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._work, daemon=True)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def _work(self) -> None:
        asleep, over = time.monotonic(), False
        # The last look counts too: the check may have failed at once, when a stall was over.
        while not over:
            over = self._over.wait(_LOOK_EVERY_S)
            awake = time.monotonic()
            self.longest_s = max(self.longest_s, awake - asleep - _LOOK_EVERY_S)
            asleep = awake
