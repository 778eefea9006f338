"""Notices when gRPC itself stops taking calls."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable

import grpc

_log = logging.getLogger(__name__)


async def start_watched(server: grpc.aio.Server, on_end: Callable[[], None]) -> None:
    """Starts a server, and tells when its loop ends by an error.

    The loop in which grpc.aio takes calls (grpcio 1.85) ends for good when the path of a request is no
    UTF-8: before any interceptor, and before anybody is asked for a token. The port is closed then, while
    the process looks well. A second server in the same process was tried, and crashed it; so the process
    says that it is ill, and whoever watches over it starts it again.

    Args:
        server: bound, not started.
        on_end: called once, on the event loop.
    """

    def ended(task: asyncio.Task[object]) -> None:
        if task.cancelled() or task.exception() is None:
            return
        _log.critical("gRPC stopped taking calls: %s", ascii(task.exception())[:200])
        on_end()

    before = asyncio.all_tasks()
    await server.start()
    # grpc.aio neither says that its loop has ended nor hands it out: it is the task that it leaves.
    for task in asyncio.all_tasks() - before:
        task.add_done_callback(ended)
