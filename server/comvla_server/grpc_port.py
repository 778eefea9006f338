"""Notices when gRPC itself stops taking calls."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import grpc


async def start_watched(server: grpc.aio.Server, on_end: Callable[[BaseException], None]) -> None:
    """Starts a server, and tells when its loop ends by an error.

    From grpcio 1.84 on, the loop in which grpc.aio takes calls ends for good when the path of a request
    is no UTF-8: before any interceptor, and before anybody is asked for a token. The project asks for an
    earlier one; this is for whoever has a later one all the same, and for what else may end that loop.
    The port is closed then, while the process looks well. A second server in the same process was tried,
    and crashed it; so the process says that it is ill, and whoever watches over it starts it again.

    Args:
        server: bound, not started.
        on_end: called once, on the event loop, with what ended it. A server that is being stopped
            may end so, too.
    """

    def ended(task: asyncio.Task[object]) -> None:
        if task.cancelled():
            return
        error = task.exception()
        if error is None:
            return
        on_end(error)

    before = asyncio.all_tasks()
    await server.start()
    # grpc.aio neither says that its loop has ended nor hands it out: it is the task that it leaves.
    for task in asyncio.all_tasks() - before:
        task.add_done_callback(ended)
