"""A connection to one of several servers, with threads that make its calls."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

from comvla_client.errors import TransportError
from comvla_client.health import check_health
from comvla_client.roster import PROBE_TIMEOUT_S
from comvla_client.transport import GrpcTransport


class Line:
    """A connection to one server, with a thread that makes its calls."""

    def __init__(self, transport: GrpcTransport) -> None:
        self.transport = transport
        self._jobs: queue.SimpleQueue[tuple[Future[Any], Callable[[], Any]] | None]
        self._jobs = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._threads = 0
        self._idle = 0
        self._closed = False

    def submit(self, call: Callable[[], Any]) -> Future[Any]:
        """Makes a call as soon as a thread is free; another thread where none is.

        Once the line is closed the call fails at once with UNAVAILABLE.
        """
        future: Future[Any] = Future()
        with self._lock:
            if self._closed:
                future.set_exception(
                    TransportError("UNAVAILABLE", "the connection to this server was closed")
                )
                return future
            if self._idle > 0:
                self._idle -= 1
            else:
                threading.Thread(target=self._work, name="comvla-line", daemon=True).start()
                self._threads += 1
            self._jobs.put((future, call))  # before close can tell the threads to end
        return future

    def is_well(self) -> bool:
        """Whether the server answers over a new connection, and says that it serves."""
        try:
            return check_health(self.transport.access, PROBE_TIMEOUT_S) == "SERVING"
        except TransportError as error:
            return error.code == "UNIMPLEMENTED"  # it is there, and has no health service

    def close(self) -> None:
        """Ends calls under way and frees the connection."""
        self.transport.close()
        with self._lock:
            self._closed = True
            for _ in range(self._threads):
                self._jobs.put(None)
            self._threads = 0

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            future, call = job
            try:
                result = call()
            except BaseException as error:
                self._rest()
                future.set_exception(error)
            else:
                self._rest()
                future.set_result(result)
            del job, future, call

    def _rest(self) -> None:
        with self._lock:
            self._idle += 1
