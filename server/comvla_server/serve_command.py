"""``comvla-server serve``: load, listen, answer, drain."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import logging
import os
import signal
from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

from comvla_server import logs
from comvla_server.descriptors import allow_descriptors
from comvla_server.model_loading import load_engine
from comvla_server.process import settle, take_turns
from comvla_server.settings import ServerSettings
from comvla_server.settings_flags import add_flags, settings_of

_log = logging.getLogger(__name__)

if TYPE_CHECKING:  # torch takes seconds to import: --help does without it
    from comvla_server.engine import Engine
    from comvla_server.server import Server

_DESCRIPTION = """\
Serve a policy until SIGTERM or Ctrl-C.

One line on stdout says when the server is ready and where:
  comvla-server ready grpc=127.0.0.1:50051 admin=http://127.0.0.1:8080 model=comvla-mini

The first signal drains: health says NOT_SERVING, new calls are answered UNAVAILABLE, calls in
flight finish. A second signal exits at once. SIGHUP looks for new certificates, tokens and
checkpoints, and swaps to those without a failed call.

Settings come from flags, from the environment (COMVLA_MAX_BATCH=4), from a file (--config) or from
defaults, in this order; `comvla-server config` shows which.

Beyond this machine (--host) it asks for TLS, and for tokens or client certificates it should be asked:
docs/server.md has the steps.
"""


def add_parser(subparsers: Any) -> None:
    """Registers the subcommand."""
    parser = subparsers.add_parser(
        "serve",
        help="serve a policy over gRPC",
        description=_DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_flags(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Serves until a signal; 0 when every call in flight was answered, else 1.

    Raises:
        ComVLAError: settings, ports or checkpoint are no good.
    """
    settings = settings_of(args).settings
    logs.configure(settings.log_format, settings.log_level)
    allow_descriptors(settings)
    loads = {
        name: partial(load_engine, settings, source) for name, source in settings.models.items()
    }
    return asyncio.run(_serve(settings, loads))


async def _serve(settings: ServerSettings, loads: Mapping[str, Callable[[], Engine]]) -> int:
    from comvla_server.server import Server

    take_turns()
    stop = _stop_on_signals()
    server = Server(loads, settings, sources=settings.models)
    await server.bind()
    _refresh_on_hangup(server)
    ready = asyncio.create_task(server.make_ready(settle))
    stopping = asyncio.create_task(stop.wait())
    lost = asyncio.create_task(server.port_lost.wait())
    try:
        await asyncio.wait({ready, stopping}, return_when=asyncio.FIRST_COMPLETED)
        if ready.done():
            info = ready.result()
            _refresh_on_hangup(server)  # before anybody is told that it is ready: SIGHUP would kill
            names = "".join(f" serves={name}" for name in settings.models if name)
            print(
                f"comvla-server ready grpc={server.target} admin={server.admin_url} "
                f"model={info.name}{names}",
                flush=True,
            )
            await asyncio.wait({stopping, lost}, return_when=asyncio.FIRST_COMPLETED)
    finally:
        ready.cancel()
        stopping.cancel()
        lost.cancel()
        finished = await server.stop()
        with contextlib.suppress(asyncio.CancelledError):
            await ready
    return 0 if finished and not server.port_lost.is_set() else 1


def _stop_on_signals() -> asyncio.Event:
    """An event that the first SIGTERM or SIGINT sets; the second ends the process at once."""
    stop = asyncio.Event()

    def on_signal(number: int) -> None:
        if stop.is_set():
            os._exit(128 + number)
        stop.set()

    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        # Windows has no signal handlers on its loop: Ctrl-C raises KeyboardInterrupt there.
        with contextlib.suppress(NotImplementedError):
            loop.add_signal_handler(number, on_signal, number)
    return stop


def _refresh_on_hangup(server: Server) -> None:
    """SIGHUP: certificates, tokens and checkpoints that have changed are taken over; certificates and
    tokens only while the model loads, which reads its checkpoint as it is."""
    under_way: set[asyncio.Task[None]] = set()

    async def refresh() -> None:
        server.reload()
        if not server.lifecycle.ready:
            return
        replaced, troubles = await server.swapper.refresh()
        for trouble in troubles:
            _log.error("the model that serves goes on: %s", trouble)
        if not replaced and not troubles:
            _log.info("no checkpoint has changed")

    def on_hangup() -> None:
        task = asyncio.ensure_future(refresh())
        under_way.add(task)
        task.add_done_callback(under_way.discard)

    if hasattr(signal, "SIGHUP"):
        with contextlib.suppress(NotImplementedError):
            asyncio.get_running_loop().add_signal_handler(signal.SIGHUP, on_hangup)
