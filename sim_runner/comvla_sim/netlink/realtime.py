"""What emulates a link must not wait for what it emulates: real-time priority, and exact waiting."""

from __future__ import annotations

import contextlib
import gc
import os
import time

_SPIN_S = 0.0002


EMULATION, EMULATED = 10, 1
"""Real-time priorities of what makes the link, and of robot and server where they have one."""


def settle() -> None:
    """Sets what the process holds by now apart from garbage collection.

    A collection that walks through all of torch or pyroute2 halts a process for 0.1 to 0.6 s, once in
    some hundred queries: many control periods.
    """
    gc.collect()
    gc.freeze()


def prefer_this_thread(priority: int = EMULATION) -> None:
    """Lets this thread (and those that it starts) run before all ordinary ones, where allowed."""
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(priority))


def wait_until(moment: float) -> float:
    """Waits until ``time.monotonic()`` is at ``moment``.

    Returns:
        How late it is now, in seconds; the past is late, never an error.
    """
    while (left := moment - time.monotonic()) > 0.0:
        if left > _SPIN_S:
            time.sleep(left - _SPIN_S)
    return -left
