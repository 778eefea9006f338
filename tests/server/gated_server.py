"""``comvla-server`` with a model that waits for the test: run as a process of its own.

Usage: gated_server.py FIFO ARGUMENTS…; after the warm-up every forward pass opens FIFO for reading,
and so waits until the test has opened and closed it for writing.
"""

from __future__ import annotations

import sys

import numpy as np
from numpy.typing import NDArray
from server_stubs import StubCloud

from comvla_server import cli, serve_command
from comvla_server.engine import Engine
from comvla_vla.request import PolicyRequest


class GatedCloud(StubCloud):
    """Waits at a named pipe."""

    def __init__(self, fifo: str) -> None:
        super().__init__()
        self._fifo = fifo
        self.gated = False

    def predict(self, requests: list[PolicyRequest]) -> list[NDArray[np.float32]]:
        if self.gated:
            with open(self._fifo) as gate:
                gate.read()
        return super().predict(requests)


class GatedEngine(Engine):
    """Its warm-up runs freely."""

    def __init__(self, cloud: GatedCloud) -> None:
        super().__init__(cloud)
        self._gate = cloud

    def warm_up(self, max_batch: int) -> None:
        """As any other; then the gate closes."""
        super().warm_up(max_batch)
        self._gate.gated = True


if __name__ == "__main__":
    fifo, *arguments = sys.argv[1:]
    serve_command.load_engine = lambda *_: GatedEngine(GatedCloud(fifo))  # type: ignore[assignment]
    sys.exit(cli.main([*arguments, "--max-batch", "1"]))
