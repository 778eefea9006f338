"""Servers in processes of their own, so that a client and its server do not share an interpreter."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection

from comvla.errors import ComVLAError

START_TIMEOUT_S = 120.0
STOP_TIMEOUT_S = 20.0


class ProcessError(ComVLAError, RuntimeError):
    """A server process ended, or was not ready in time."""


@contextmanager
def serving(target: Callable[..., None], *arguments: object) -> Iterator[str]:
    """Runs ``target(lifeline, *arguments)`` in a new process until the block ends.

    Args:
        target: a module-level function. It calls :func:`announce` once it serves, and returns after
            :func:`wait_for_end`.
        arguments: handed on to it.

    Yields:
        What the server announced.

    Raises:
        ProcessError: it ended, or said nothing within two minutes.
    """
    with connected(target, *arguments) as (_, announcement):
        yield announcement


@contextmanager
def connected(target: Callable[..., None], *arguments: object) -> Iterator[tuple[Connection, str]]:
    """As :func:`serving`, for a process that is also asked things while it runs.

    Yields:
        This end of the lifeline, and what the process announced.

    Raises:
        ProcessError: it ended, or said nothing within two minutes.
    """
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=target, args=(theirs, *arguments), daemon=True)
    process.start()
    theirs.close()
    try:
        yield ours, _announcement(ours, target.__name__)
    finally:
        ours.close()  # the other end sees the end of the file and returns
        process.join(STOP_TIMEOUT_S)
        if process.is_alive():
            process.terminate()
            process.join()


def announce(lifeline: Connection, text: str) -> None:
    """Tells the parent that this server is ready, and where."""
    lifeline.send_bytes(text.encode())


def wait_for_end(lifeline: Connection) -> None:
    """Returns when the parent has closed its end, or has died."""
    try:
        lifeline.recv_bytes()
    except EOFError:
        return


def _announcement(lifeline: Connection, name: str) -> str:
    try:
        if lifeline.poll(START_TIMEOUT_S):
            return lifeline.recv_bytes().decode()
    except EOFError:
        raise ProcessError(f"{name} ended before it served; its own message is above") from None
    raise ProcessError(f"{name} was not ready within {START_TIMEOUT_S:.0f} s: is the machine busy?")
