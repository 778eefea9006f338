"""A policy server as a process of its own, gone when the demo is."""

from __future__ import annotations

import contextlib
import queue
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from types import TracebackType

from comvla.errors import ComVLAError

READY_WITHIN_S = 120.0
"""Loading torch from a cold disk on a slow machine takes a while."""

_DRAIN_WITHIN_S = 15.0
_READY = re.compile(r"^comvla-server ready grpc=(\S+) admin=(\S+)")
_SHOWN_LOG_LINES = 15


class ServerProcessError(ComVLAError):
    """The server did not start, or ended too early; the message ends with its last words."""


class ServerProcess:
    """Runs ``comvla-server serve`` on free ports of this machine; a context manager.

    Args:
        model: as for ``--model``.
        ready_within_s: longest wait for the line that says ready, seconds.
        host: address to listen on.
        insecure: listens without encryption also where others might reach it.
        launcher: a program that becomes the one whose command line follows it, e.g. in another
            network namespace.
        port, admin_port: to take, 0 for free ones.
        options: further ones of ``serve``.

    Attributes:
        target: ``host:port`` of the gRPC service, once entered.
        admin_url: of the admin surface, once entered.

    Raises:
        ServerProcessError: on entering, when the server ends or is not ready in time.
    """

    def __init__(
        self,
        model: str,
        *,
        ready_within_s: float = READY_WITHIN_S,
        host: str = "127.0.0.1",
        insecure: bool = False,
        launcher: Sequence[str] = (),
        port: int = 0,
        admin_port: int = 0,
        options: Sequence[str] = (),
    ) -> None:
        self._command = [*launcher, sys.executable, "-m", "comvla_server", "serve"]
        self._command += ["--model", model, "--host", host]
        self._command += ["--port", str(port), "--admin-port", str(admin_port), "--threads", "1"]
        self._command += options
        self._command += ["--insecure"] if insecure else []
        self._ready_within_s = ready_within_s
        self._process: subprocess.Popen[str] | None = None
        # Closed by stop(); a context manager could not outlive this method.
        self._log = tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace")  # noqa: SIM115
        self.target = ""
        self.admin_url = ""

    def __enter__(self) -> ServerProcess:
        # A session of its own: Ctrl-C reaches the demo, which then ends the server in its own time.
        self._process = subprocess.Popen(
            self._command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=self._log,
            text=True,
            start_new_session=True,
        )
        try:
            self._wait_until_ready(self._process)
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop()

    @property
    def running(self) -> bool:
        """Whether the process is alive."""
        return self._process is not None and self._process.poll() is None

    def require_running(self) -> None:
        """Raises ServerProcessError when the server is gone."""
        if not self.running:
            raise ServerProcessError(f"the server ended in mid-episode{self._last_words()}")

    @property
    def pid(self) -> int:
        """Of the process.

        Raises:
            ServerProcessError: it is gone.
        """
        self.require_running()
        assert self._process is not None
        return self._process.pid

    def kill(self) -> None:
        """Ends the server without a word to anybody, as a lost machine does."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
        self.stop()

    def stop(self) -> None:
        """Lets the server drain, and ends it where it does not; harmless when repeated."""
        process, self._process = self._process, None
        if process is None:
            return
        process.terminate()
        try:
            process.wait(_DRAIN_WITHIN_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        finally:
            if process.stdout is not None:
                with contextlib.suppress(OSError):
                    process.stdout.close()
            self._log.close()

    def _wait_until_ready(self, process: subprocess.Popen[str]) -> None:
        lines: queue.Queue[str | None] = queue.Queue()
        threading.Thread(target=_forward, args=(process, lines), daemon=True).start()
        deadline = time.monotonic() + self._ready_within_s
        while True:
            try:
                line = lines.get(timeout=max(0.0, deadline - time.monotonic()))
            except queue.Empty:
                raise ServerProcessError(
                    f"the server was not ready within {self._ready_within_s:g} s"
                    f"{self._last_words()}"
                ) from None
            if line is None:
                raise ServerProcessError(
                    f"the server ended with code {process.wait()} before it was ready"
                    f"{self._last_words()}"
                )
            match = _READY.match(line)
            if match:
                self.target, self.admin_url = match.groups()
                return

    def _last_words(self) -> str:
        self._log.seek(0)
        lines = self._log.read().strip().splitlines()[-_SHOWN_LOG_LINES:]
        return "; its last words:\n  " + "\n  ".join(lines) if lines else " and said nothing"


def _forward(process: subprocess.Popen[str], lines: queue.Queue[str | None]) -> None:
    """Reads everything the server prints, so that its pipe never fills; None marks the end."""
    if process.stdout is not None:
        # The pipe is closed under the reader when the demo ends.
        with contextlib.suppress(ValueError, OSError):
            for line in process.stdout:
                lines.put(line)
    lines.put(None)
