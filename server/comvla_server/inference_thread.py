"""One thread that runs the model, so that the event loop never waits for it."""

from __future__ import annotations

import asyncio
import contextlib
import queue
import threading
from collections.abc import Callable
from typing import Any, TypeVar

_T = TypeVar("_T")
_Job = tuple[Callable[[], Any], "asyncio.Future[Any]"]


class InferenceThread:
    """Runs one function at a time.

    It is a daemon, unlike the threads of :class:`concurrent.futures.ThreadPoolExecutor`: a model
    that hangs must not keep a process alive that was told to stop.

    Args:
        name: of the thread, for people who look at a stuck process.
    """

    def __init__(self, name: str = "comvla-inference") -> None:
        self._jobs: queue.SimpleQueue[_Job | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._work, name=name, daemon=True)
        self._thread.start()

    async def run(self, function: Callable[..., _T], *args: object) -> _T:
        """Result of ``function(*args)``, computed in the thread.

        Raises:
            Exception: whatever the function raised.
        """
        future: asyncio.Future[_T] = asyncio.get_running_loop().create_future()
        self._jobs.put((lambda: function(*args), future))
        return await future

    def close(self, timeout_s: float) -> bool:
        """Asks the thread to end after its current job; True when it did within the time."""
        self._jobs.put(None)
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            function, future = job
            result: Any = None
            error: Exception | None = None
            try:
                result = function()
            except Exception as caught:
                error = caught
            except BaseException as caught:  # a SystemExit inside a model must not end the thread
                error = RuntimeError(f"the model raised {type(caught).__name__}")
            # The loop is gone when the server was stopped without waiting for this job.
            with contextlib.suppress(RuntimeError):
                future.get_loop().call_soon_threadsafe(_settle, future, result, error)
            del job, function, future, result, error


def _settle(future: asyncio.Future[Any], result: Any, error: Exception | None) -> None:
    if future.done():
        return
    if error is None:
        future.set_result(result)
    else:
        future.set_exception(error)
