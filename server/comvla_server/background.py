"""A server in a thread of this process: for tests, notebooks and benches."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Mapping
from concurrent.futures import Future
from functools import partial
from types import TracebackType
from typing import Any

from comvla_server.bring_up import EngineSource
from comvla_server.server import Server
from comvla_server.settings import ServerSettings


class BackgroundServer:
    """Runs a :class:`Server` on an event loop of its own while the ``with`` block lasts.

    Example:
        >>> with BackgroundServer(Engine(cloud)) as server:        # doctest: +SKIP
        ...     client = ComVLAClient(server.target, edge=edge)

    Args:
        engine: the model, a function that loads it, or several by name.
        settings: free ports on this machine where None.
        options: further ones of :class:`Server`.
    """

    def __init__(
        self,
        engine: EngineSource | Mapping[str, EngineSource],
        settings: ServerSettings | None = None,
        **options: Any,
    ) -> None:
        self._make = partial(Server, engine, settings, **options)
        self._started: Future[tuple[Server, asyncio.AbstractEventLoop, asyncio.Event]] = Future()
        self._grace_s: float | None = None
        self._finished = False
        self._thread = threading.Thread(target=self._run, name="comvla-server", daemon=True)

    @property
    def server(self) -> Server:
        """The server inside. Touch it from its own event loop only."""
        return self._started.result()[0]

    @property
    def target(self) -> str:
        """Where robots connect, ``host:port``."""
        return self.server.target

    @property
    def admin_url(self) -> str:
        """Root of the admin surface."""
        return self.server.admin_url

    def start(self) -> BackgroundServer:
        """Starts the thread; returns when calls are answered.

        Raises:
            ComVLAError: a port is taken or the model cannot be loaded.
        """
        self._thread.start()
        self._started.result()
        return self

    def stop(self, grace_s: float | None = None) -> bool:
        """Drains and stops; a second call does nothing.

        Args:
            grace_s: seconds that calls in flight may take, the setting where None.

        Returns:
            True when every call in flight was answered.
        """
        if self._thread.ident is None:
            return True  # never started
        if self._thread.is_alive() and self._started.exception() is None:
            _, loop, stop = self._started.result()
            self._grace_s = grace_s
            loop.call_soon_threadsafe(stop.set)
        self._thread.join()
        return self._finished

    def __enter__(self) -> BackgroundServer:
        return self.start()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.stop()

    def _run(self) -> None:
        try:
            asyncio.run(self._serve())
        except BaseException as error:
            if self._started.done():
                raise
            self._started.set_exception(error)

    async def _serve(self) -> None:
        server = self._make()
        del self._make  # a model that is replaced must not be held here
        stop = asyncio.Event()
        await server.start()
        self._started.set_result((server, asyncio.get_running_loop(), stop))
        await stop.wait()
        self._finished = await server.stop(self._grace_s)
