"""What a process that only serves asks of its Python interpreter. A library must not: a program has one interpreter."""

from __future__ import annotations

import gc
import sys

_TURN_S = 0.0001


def take_turns() -> None:
    """The event loop and the model's thread want the interpreter's lock in turn, for many short pieces of work.

    Whoever wants it waits for as long as Python lets a thread go on, 5 ms by default. A model of many small operations
    loses that again and again beside a busy loop: on two cores, asked for ten times what it could answer, comvla-mini
    gave 37 answers a second with 5 ms, 53 with this.
    """
    sys.setswitchinterval(_TURN_S)


def settle() -> None:
    """What was loaded stays: a garbage collection that walks through all of torch would halt every
    robot for a quarter of a second, once in some hundred requests. So would this one, if it came later."""
    gc.collect()
    gc.freeze()
