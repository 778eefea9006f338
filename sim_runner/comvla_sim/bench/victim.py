"""A server that is killed and brought back, again and again.

Most of what a server takes to start is spent on imports. The next one does them beforehand, in a process
of its own that then waits; when the old one is dead it goes on: reads the checkpoint, binds the same
port, warms up. So a robot finds the port closed, then a server that still loads, then one that answers,
as after any restart, and many kills fit into an hour.
"""

from __future__ import annotations

import os
import socket
import sys
import tempfile
import threading
import time
from pathlib import Path

import grpc

from comvla_sim.demo.server_process import ServerProcess, ServerProcessError

_RESTART_WITHIN_S = 120.0
_LOOK_EVERY_S = 0.005
_WATCH = "/grpc.health.v1.Health/Watch"
_SERVING = b"\x08\x01"

# Started as `python -c STANDBY fifo python -m comvla_server serve …`: does what the rest says when
# somebody has opened the fifo to write.
_STANDBY = """
import sys
import torch, comvla_vla, comvla_server.cli, comvla_server.server, comvla_server.serve_command
with open(sys.argv[1]) as gate:
    gate.read()
sys.exit(comvla_server.cli.main(sys.argv[5:]))
"""


class Victim:
    """A server on ports of its own that is killed and brought back by a thread beside the robot.

    Attributes:
        target: where it is.
        killed_at: when it was dead, on ``time.monotonic``.
        back_at: when the next one said over a fresh connection that it serves, likewise.
    """

    def __init__(self, model: str) -> None:
        self._model = model
        self._process = ServerProcess(model)
        self._next: _Standby | None = None
        self._thread: threading.Thread | None = None
        self._trouble: BaseException | None = None
        self._struck = threading.Event()
        self._back = threading.Event()
        self._ports = (0, 0)
        self.target = ""
        self.killed_at = 0.0
        self.back_at = 0.0

    @property
    def struck(self) -> bool:
        """Whether the blow has fallen."""
        return self._struck.is_set()

    @property
    def up_again(self) -> bool:
        """Whether the next one has said that it serves."""
        return self._back.is_set()

    def prepare(self) -> None:
        """Starts the process that will take over, unless there is one."""
        if self._next is None:
            self._join()
            self._next = _Standby(self._model, *self._ports, Path(self._folder.name))

    def kill_and_restart(self, after_s: float) -> None:
        """Kills the server a moment from now, perhaps in the middle of a call, and starts the next.

        First waits, where it has to, until the next one has done its imports.
        """
        self.prepare()
        assert self._next is not None
        self._next.wait_until_prepared()
        self._struck.clear()
        self._back.clear()
        self._thread = threading.Thread(target=self._work, args=(after_s,), daemon=True)
        self._thread.start()

    def wait_until_back(self) -> None:
        """Waits until the next one has said that it serves."""
        while not self._back.wait(_LOOK_EVERY_S):
            self.check()

    def check(self) -> None:
        """Raises ServerProcessError where the server could not be brought back."""
        if self._trouble is not None:
            raise ServerProcessError(f"the server did not come back: {self._trouble}")

    def _work(self, after_s: float) -> None:
        standby, self._next = self._next, None
        assert standby is not None
        try:
            time.sleep(after_s)
            self._process.kill()
            self.killed_at = time.monotonic()
            self._struck.set()
            standby.go()
            self.back_at = _serving_at(self.target, time.monotonic() + _RESTART_WITHIN_S)
            self._back.set()
            self._process = standby.ready()
        except BaseException as error:
            self._trouble = error
            standby.stop()

    def _join(self) -> None:
        if self._thread is not None:
            self._thread.join(_RESTART_WITHIN_S)
        self.check()

    def __enter__(self) -> Victim:
        # Closed by __exit__.
        self._folder = tempfile.TemporaryDirectory(prefix="comvla-kills-")
        self._process.__enter__()
        self.target = self._process.target
        places = (self._process.target, self._process.admin_url)
        port, admin_port = (int(place.rpartition(":")[2]) for place in places)
        self._ports = (port, admin_port)
        return self

    def __exit__(self, *_: object) -> None:
        if self._thread is not None:
            self._thread.join(_RESTART_WITHIN_S)
        if self._next is not None:
            self._next.stop()
        self._process.stop()
        self._folder.cleanup()


class _Standby:
    """A server's process that has done its imports and waits to be told to go on."""

    def __init__(self, model: str, port: int, admin_port: int, folder: Path) -> None:
        self._gate = folder / f"gate-{time.monotonic_ns()}"
        os.mkfifo(self._gate)
        self._process = ServerProcess(
            model,
            port=port,
            admin_port=admin_port,
            launcher=[sys.executable, "-c", _STANDBY, str(self._gate)],
            ready_within_s=3600.0,  # it waits for its turn
        )
        self._trouble: BaseException | None = None
        self._thread = threading.Thread(target=self._start, daemon=True)
        self._thread.start()

    def wait_until_prepared(self) -> None:
        """Waits for the imports. Opens the gate halfway: who waits behind it is found, and waits on."""
        deadline = time.monotonic() + _RESTART_WITHIN_S
        while True:
            try:
                self._opened = os.open(self._gate, os.O_WRONLY | os.O_NONBLOCK)
            except OSError as error:  # nobody waits behind it yet
                if not self._thread.is_alive() or time.monotonic() > deadline:
                    raise ServerProcessError(
                        f"the next server was never prepared ({self._trouble})"
                    ) from error
                time.sleep(_LOOK_EVERY_S)
            else:
                return

    def go(self) -> None:
        """Has it take over."""
        os.close(self._opened)

    def ready(self) -> ServerProcess:
        """The server, once it has said that it is ready.

        Raises:
            ServerProcessError: it is not.
        """
        self._thread.join(_RESTART_WITHIN_S)
        if self._thread.is_alive() or self._trouble is not None:
            raise ServerProcessError(f"the next server was not ready ({self._trouble})")
        return self._process

    def stop(self) -> None:
        """Ends it, wherever it stands."""
        self._process.kill()

    def _start(self) -> None:
        try:
            self._process.__enter__()
        except BaseException as error:
            self._trouble = error


def _serving_at(target: str, deadline: float) -> float:
    """When a server says over a fresh connection that it serves, on ``time.monotonic``.

    Its port is tried with bare connections, which cost the robot's process next to nothing. Behind
    it the server itself tells the moment (``grpc.health.v1.Health/Watch``).

    Raises:
        ServerProcessError: it did not in time.
    """
    host, _, port = target.rpartition(":")
    while time.monotonic() < deadline:
        try:
            socket.create_connection((host, int(port)), timeout=1.0).close()
        except OSError:
            time.sleep(_LOOK_EVERY_S)
            continue
        with grpc.insecure_channel(target, [("grpc.use_local_subchannel_pool", 1)]) as channel:
            watch: grpc.UnaryStreamMultiCallable[bytes, bytes] = channel.unary_stream(_WATCH)
            try:
                for answer in watch(b"", timeout=deadline - time.monotonic()):
                    if answer == _SERVING:
                        return time.monotonic()
            except grpc.RpcError:
                time.sleep(_LOOK_EVERY_S)
    raise ServerProcessError(f"nobody served at {target} within {_RESTART_WITHIN_S:g} s")
