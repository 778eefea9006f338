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
from comvla_sim.netlink.wires import CLOUD_ADDRESS

SYNTHETIC = "synthetic"
"""Instead of a model: the paper's sizes and a cloud half that answers at once."""

_PR_SET_PDEATHSIG = 1


@contextmanager
def cloud_server(namespace: str, model: str) -> Iterator[str]:
    """Serves a model in a namespace while the block lasts.

    Args:
        namespace: the cloud's.
        model: :data:`SYNTHETIC`, or what ``comvla-server serve --model`` takes.

    Yields:
        ``host:port`` of the gRPC service, as the robot reaches it.

    Raises:
        ServerProcessError: ``comvla-server`` did not start.
    """
    if model == SYNTHETIC:
        with serving(_serve_synthetic, namespace) as target:
            yield target
        return
    enter_first = [sys.executable, "-m", "comvla_sim.netlink.cloud", namespace]
    with ServerProcess(model, host=CLOUD_ADDRESS, launcher=enter_first) as server:
        yield server.target


def _serve_synthetic(lifeline: Connection, namespace: str) -> None:
    enter(namespace)
    from comvla_server.background import BackgroundServer
    from comvla_server.engine import Engine
    from comvla_server.settings import ServerSettings
    from comvla_sim.netlink.synthetic import SyntheticCloud

    logging.getLogger("comvla_server").setLevel(logging.ERROR)  # it is not open to anyone outside
    settings = ServerSettings(host=CLOUD_ADDRESS)
    with BackgroundServer(Engine(SyntheticCloud()), settings) as server:
        announce(lifeline, server.target)
        wait_for_end(lifeline)


def main(argv: list[str]) -> None:
    """Becomes another program inside a namespace: ``NAMESPACE PROGRAM ARGUMENT...``."""
    enter(argv[0])
    # Ends with the process that keeps the link, also where that was killed.
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    os.execvp(argv[1], argv[1:])


if __name__ == "__main__":
    main(sys.argv[1:])
