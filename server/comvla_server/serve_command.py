"""``comvla-server serve``: load, listen, answer, drain."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import gc
import os
import signal
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from comvla_server import logs
from comvla_server.descriptors import allow_descriptors
from comvla_server.settings import ServerSettings
from comvla_server.settings_flags import add_flags, settings_of

if TYPE_CHECKING:  # torch takes seconds to import: --help does without it
    from comvla_server.engine import Engine

_DESCRIPTION = """\
Serve a policy until SIGTERM or Ctrl-C.

One line on stdout says when the server is ready and where:
  comvla-server ready grpc=127.0.0.1:50051 admin=http://127.0.0.1:8080 model=comvla-mini

The first signal drains: health says NOT_SERVING, new calls are answered UNAVAILABLE, calls in
flight finish. A second signal exits at once.

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
    return asyncio.run(_serve(settings, lambda: load_engine(settings)))


def load_engine(settings: ServerSettings) -> Engine:
    """The cloud half of the checkpoint that the settings name, ready to run.

    With the vision half where that is wanted.

    Raises:
        CheckpointError: missing, damaged, foreign or incomplete.
    """
    import torch

    from comvla_server.engine import Engine
    from comvla_server.vision import holds_whole, load_vision
    from comvla_vla import CloudOptions, FastV, load_cloud

    if settings.threads is not None:
        torch.set_num_threads(settings.threads)
    options = CloudOptions(
        fastv=None if settings.fastv is None else FastV(*settings.fastv),
        compact_positions=settings.compact_positions,
        compile=settings.compile,
    )
    cloud = load_cloud(
        settings.model,
        device=settings.device,
        dtype=getattr(torch, settings.dtype),
        statistics_key=settings.statistics_key,
        options=options,
        verify=settings.verify,
    )
    wanted = settings.vision == "on" or (settings.vision == "auto" and holds_whole(settings.model))
    if not wanted:
        return Engine(cloud)
    vision = load_vision(
        settings.model, cloud, settings.device, statistics_key=settings.statistics_key
    )
    return Engine(cloud, vision)


async def _serve(settings: ServerSettings, load: Callable[[], Engine]) -> int:
    from comvla_server.server import Server

    stop = _stop_on_signals()
    server = Server(load, settings)
    await server.bind()
    ready = asyncio.create_task(server.make_ready())
    stopping = asyncio.create_task(stop.wait())
    lost = asyncio.create_task(server.port_lost.wait())
    try:
        await asyncio.wait({ready, stopping}, return_when=asyncio.FIRST_COMPLETED)
        if ready.done():
            info = ready.result()
            # What was loaded stays: a garbage collection that walks through all of torch would halt
            # every robot for a quarter of a second, once in some hundred requests.
            gc.collect()
            gc.freeze()
            print(
                f"comvla-server ready grpc={server.target} admin={server.admin_url} "
                f"model={info.name}",
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
