"""The cloud's side of a link: the real server in the cloud's namespace."""

from __future__ import annotations

import ctypes
import logging
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection

from comvla_sim.bench.processes import announce, serving, wait_for_end
from comvla_sim.demo.server_process import ServerProcess
from comvla_sim.netlink.namespaces import enter
from comvla_sim.netlink.realtime import EMULATED, prefer_this_thread, settle
from comvla_sim.netlink.wires import CLOUD_ADDRESS

SYNTHETIC = "synthetic"
"""Instead of a model: the paper's sizes and a cloud half that answers at once."""

_PR_SET_PDEATHSIG = 1
_REALTIME = "--realtime"


@contextmanager
def cloud_server(namespace: str, model: str, *, realtime: bool = False) -> Iterator[str]:
    """Serves a model in a namespace while the block lasts.

    Args:
        namespace: the cloud's.
        model: :data:`SYNTHETIC`, or what ``comvla-server serve --model`` takes.
        realtime: whether the server runs before ordinary processes, on a machine that is shared.

    Yields:
        ``host:port`` of the gRPC service, as the robot reaches it.

    Raises:
        ServerProcessError: ``comvla-server`` did not start.
    """
    if model == SYNTHETIC:
        with serving(_serve_synthetic, namespace, realtime) as target:
            yield target
        return
    enter_first = [sys.executable, "-m", "comvla_sim.netlink.cloud", namespace]
    if realtime:
        enter_first.append(_REALTIME)
    with ServerProcess(model, host=CLOUD_ADDRESS, insecure=True, launcher=enter_first) as server:
        yield server.target


def _serve_synthetic(lifeline: Connection, namespace: str, realtime: bool) -> None:
    enter(namespace)
    if realtime:
        prefer_this_thread(EMULATED)
    from comvla_server.background import BackgroundServer
    from comvla_server.engine import Engine
    from comvla_server.settings import ServerSettings
    from comvla_sim.netlink.synthetic import SyntheticCloud

    logging.getLogger("comvla_server").setLevel(logging.ERROR)
    # The only one who reaches this address is the robot of this link.
    settings = ServerSettings(host=CLOUD_ADDRESS, insecure=True)
    with BackgroundServer(Engine(SyntheticCloud()), settings) as server:
        settle()
        announce(lifeline, server.target)
        wait_for_end(lifeline)


def main(argv: list[str]) -> None:
    """Becomes another program inside a namespace: ``NAMESPACE [--realtime] PROGRAM ARGUMENT...``."""
    enter(argv[0])
    program = argv[1:]
    if program[0] == _REALTIME:
        prefer_this_thread(EMULATED)
        del program[0]
    # Ends with the process that keeps the link, also where that was killed.
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    os.execvp(program[0], program)


if __name__ == "__main__":
    main(sys.argv[1:])
