"""``comvla-server serve``: load, listen, answer, drain."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import os
import signal
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from comvla_server import logs
from comvla_server.settings import ServerSettings

if TYPE_CHECKING:  # torch takes seconds to import: --help does without it
    from comvla_server.engine import Engine

DEFAULT_PORT = 50051
DEFAULT_ADMIN_PORT = 8080

_DEFAULTS = ServerSettings()

_DESCRIPTION = """\
Serve a policy until SIGTERM or Ctrl-C.

One line on stdout says when the server is ready and where:
  comvla-server ready grpc=127.0.0.1:50051 admin=http://127.0.0.1:8080 model=comvla-mini

The first signal drains: health says NOT_SERVING, new calls are answered UNAVAILABLE, calls in
flight finish. A second signal exits at once.

Nothing is authenticated or encrypted yet: listen beyond this machine only in a trusted network.
"""


def add_parser(subparsers: Any) -> None:
    """Registers the subcommand."""
    parser = subparsers.add_parser(
        "serve",
        help="serve a policy over gRPC",
        description=_DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    model = parser.add_argument_group("model")
    model.add_argument(
        "--model",
        default="mini",
        metavar="SOURCE",
        help="checkpoint folder, hub repository, or mini, the shipped policy (default: mini)",
    )
    model.add_argument("--device", default="cpu", help="torch device, e.g. cuda:0 (default: cpu)")
    model.add_argument(
        "--dtype",
        default="float32",
        choices=("float32", "bfloat16", "float16"),
        help="number format of the weights (default: float32)",
    )
    model.add_argument(
        "--threads",
        type=int,
        metavar="N",
        help="CPU threads of the model (default: torch decides)",
    )
    model.add_argument(
        "--statistics-key",
        metavar="KEY",
        help="data set whose statistics apply, where the checkpoint holds several",
    )
    model.add_argument(
        "--vision",
        default="auto",
        choices=("auto", "on", "off"),
        help="also load the vision half, for robots that send pictures; auto: where the checkpoint on this "
        "machine is whole. It takes the memory of the towers, which the log names (default: auto)",
    )
    model.add_argument(
        "--fastv",
        type=_fastv,
        metavar="LAYER,DROP",
        help="drop this share of the visual tokens before this layer, e.g. 3,0.75: saves operations, not bytes",
    )
    model.add_argument(
        "--compact-positions",
        action="store_true",
        help="number the tokens that arrive 0, 1, 2, …, as VLA-ADP does (default: original positions)",
    )
    model.add_argument(
        "--compile", action="store_true", help="run the backbone through torch.compile"
    )
    network = parser.add_argument_group("network")
    network.add_argument(
        "--host",
        default=_DEFAULTS.host,
        help=f"address to listen on; 0.0.0.0 for all (default: {_DEFAULTS.host})",
    )
    network.add_argument(
        "--port",
        type=int,
        default=DEFAULT_PORT,
        help=f"gRPC port, 0 for a free one (default: {DEFAULT_PORT})",
    )
    network.add_argument(
        "--admin-port",
        type=int,
        default=DEFAULT_ADMIN_PORT,
        metavar="PORT",
        help="HTTP port of /metrics, /readyz and /docs, 0 for a free one "
        f"(default: {DEFAULT_ADMIN_PORT})",
    )
    limits = parser.add_argument_group("limits")
    for name, kind, words in (
        ("max_batch", int, "most requests in one forward pass; 1 turns batching off"),
        ("max_queue", int, "most robots that may wait; one more is answered RESOURCE_EXHAUSTED"),
        ("max_sessions", int, "most sessions whose last answer is kept for a retry"),
        ("max_request_bytes", int, "largest request, bytes"),
        ("default_deadline_s", float, "deadline of calls that bring none, seconds"),
        ("grace_s", float, "time that calls in flight get when the server stops, seconds"),
    ):
        default = getattr(_DEFAULTS, name)
        parser_name = "--" + name.replace("_", "-")
        limits.add_argument(
            parser_name,
            type=kind,
            default=default,
            metavar="N" if kind is int else "SECONDS",
            help=f"{words} (default: {default})",
        )
    logging = parser.add_argument_group("logs, on stderr")
    logging.add_argument("--log-format", default="plain", choices=logs.FORMATS)
    logging.add_argument(
        "--log-level", default="info", choices=("debug", "info", "warning", "error")
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Serves until a signal; 0 when every call in flight was answered, else 1.

    Raises:
        ComVLAError: settings, ports or checkpoint are no good.
    """
    settings = ServerSettings(
        host=args.host,
        port=args.port,
        admin_port=args.admin_port,
        max_batch=args.max_batch,
        max_queue=args.max_queue,
        max_sessions=args.max_sessions,
        max_request_bytes=args.max_request_bytes,
        default_deadline_s=args.default_deadline_s,
        grace_s=args.grace_s,
    )
    logs.configure(args.log_format, args.log_level)
    return asyncio.run(
        _serve(
            settings,
            lambda: load_engine(
                args.model,
                args.device,
                args.dtype,
                args.threads,
                args.statistics_key,
                args.fastv,
                args.compact_positions,
                args.compile,
                args.vision,
            ),
        )
    )


def load_engine(
    model: str,
    device: str,
    dtype: str,
    threads: int | None,
    statistics_key: str | None = None,
    fastv: tuple[int, float] | None = None,
    compact_positions: bool = False,
    compiled: bool = False,
    vision: str = "auto",
) -> Engine:
    """The cloud half of a checkpoint, ready to run; with the vision half where that is wanted.

    Raises:
        CheckpointError: missing, damaged, foreign or incomplete.
    """
    import torch

    from comvla_server.engine import Engine
    from comvla_server.vision import holds_whole, load_vision
    from comvla_vla import CloudOptions, FastV, load_cloud

    if threads is not None:
        torch.set_num_threads(threads)
    options = CloudOptions(
        fastv=None if fastv is None else FastV(*fastv),
        compact_positions=compact_positions,
        compile=compiled,
    )
    cloud = load_cloud(
        model,
        device=device,
        dtype=getattr(torch, dtype),
        statistics_key=statistics_key,
        options=options,
    )
    if vision == "off" or (vision == "auto" and not holds_whole(model)):
        return Engine(cloud)
    return Engine(cloud, load_vision(model, cloud, device, statistics_key=statistics_key))


def _fastv(text: str) -> tuple[int, float]:
    layer, _, drop = text.partition(",")
    try:
        read = int(layer), float(drop)
    except ValueError:
        read = 0, 0.0
    if read[0] < 1 or not 0 <= read[1] < 1:
        raise argparse.ArgumentTypeError(
            f"expected a layer >= 1 and a share below 1, e.g. 3,0.75, got {text!r}"
        )
    return read


async def _serve(settings: ServerSettings, load: Callable[[], Engine]) -> int:
    from comvla_server.server import Server

    stop = _stop_on_signals()
    server = Server(load, settings)
    await server.bind()
    ready = asyncio.create_task(server.make_ready())
    stopping = asyncio.create_task(stop.wait())
    try:
        await asyncio.wait({ready, stopping}, return_when=asyncio.FIRST_COMPLETED)
        if ready.done():
            info = ready.result()
            print(
                f"comvla-server ready grpc={server.target} admin={server.admin_url} "
                f"model={info.name}",
                flush=True,
            )
            await stopping
    finally:
        ready.cancel()
        stopping.cancel()
        finished = await server.stop()
        with contextlib.suppress(asyncio.CancelledError):
            await ready
    return 0 if finished else 1


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
