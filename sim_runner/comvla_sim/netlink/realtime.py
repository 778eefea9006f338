"""What emulates a link must not wait for what it emulates: real-time priority, and exact waiting."""

from __future__ import annotations

import contextlib
import os
import time

_SPIN_S = 0.0002


def prefer_this_thread() -> None:
    """Lets this thread (and those that it starts) run before all ordinary ones, where allowed."""
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))


def wait_until(moment: float) -> float:
    """Waits until ``time.monotonic()`` is at ``moment``.

    Returns:
        How late it is now, in seconds; the past is late, never an error.
    """
    while (left := moment - time.monotonic()) > 0.0:
        if left > _SPIN_S:
            time.sleep(left - _SPIN_S)
    return -left
