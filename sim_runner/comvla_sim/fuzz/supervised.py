"""The fuzzed server in a process of its own, started again when something has ended it."""

from __future__ import annotations

import asyncio
import contextlib
from multiprocessing.connection import Connection
from types import TracebackType

from comvla_sim.bench.processes import connected
from comvla_sim.fuzz.target import serve
from comvla_sim.fuzz.watch import Watch

CRASHED = "its process crashed"
# Between the moment at which a server stops answering and that at which its process is gone.
_ENDS_WITHIN_S = 15.0
_LOOKS_EVERY_S = 0.02


class SupervisedServer:
    """A context manager.

    Attributes:
        target: where gRPC listens now, ``host:port``.
        admin_url: root of its admin surface.
        watches: one for each process there was; the last is the present one.
    """

    def __init__(self) -> None:
        self.target = ""
        self.admin_url = ""
        self.watches: list[Watch] = []
        self._lifeline: Connection | None = None
        self._process = contextlib.ExitStack()
        self._ended: str | None = None

    def __enter__(self) -> SupervisedServer:
        self.restart()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._process.close()

    def restart(self) -> None:
        """Ends the process if it still runs, and starts another."""
        self._process.close()
        self._lifeline, announcement = self._process.enter_context(connected(serve))
        self.target, self.admin_url, pid = announcement.split()
        number = len(self.watches)
        self.watches.append(Watch(f"server, start {number + 1}" if number else "server", int(pid)))
        self._ended = None

    def look(self, share: float) -> None:
        """Takes a sample of its memory; see :class:`Watch`."""
        self.watches[-1].look(share)

    def ended(self) -> str | None:
        """What ended it: the name of what gRPC raised, or :data:`CRASHED`; None while it runs."""
        assert self._lifeline is not None
        if self._ended is None and self._lifeline.poll():
            try:
                self._ended = self._lifeline.recv_bytes().decode()
            except (EOFError, OSError):
                self._ended = CRASHED
        return self._ended

    async def end(self) -> str | None:
        """As :meth:`ended`, for a server that has just stopped answering: waits for it a little."""
        for _ in range(round(_ENDS_WITHIN_S / _LOOKS_EVERY_S)):
            if self.ended() is not None:
                break
            await asyncio.sleep(_LOOKS_EVERY_S)
        return self.ended()
