"""A simulator in a process of its own, asked and answered over a pipe.

Nothing that happens there can hang or kill the caller: every answer has a deadline, a process that
misses it is ended, and what it last wrote on stderr is in the error's message.
"""

from __future__ import annotations

import contextlib
import os
import selectors
import signal
import subprocess
import tempfile
import time
import weakref
from collections.abc import Callable, Mapping, Sequence
from typing import IO, Any, cast

from comvla_sim.worlds.libero.child.framing import FramingError, Message, encode, read
from comvla_sim.worlds.libero.errors import (
    AssetsError,
    LiberoError,
    ProtocolError,
    SimulatorDiedError,
    SimulatorTimeoutError,
)

_CLOSING_TIMEOUT_S = 5.0
_LAST_WORDS_BYTES = 4000
_CHUNK_BYTES = 1 << 20


def _end(process: subprocess.Popen[bytes], stderr: IO[bytes]) -> None:
    """Ends a child and everything it started, politely first."""
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            with contextlib.suppress(OSError):
                pipe.close()  # the child leaves when its pipe ends
    if process.poll() is None:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_CLOSING_TIMEOUT_S)
    _kill(process)
    stderr.close()


def _kill(process: subprocess.Popen[bytes]) -> None:
    # The child leads a session of its own, so its group is all that it started.
    with contextlib.suppress(OSError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


class SimulatorProcess:
    """Starts a child and waits for its first message.

    Args:
        command: what to run; it must speak the protocol of :mod:`.child.server`.
        environment: its environment variables.
        start_timeout_s: for the first message; importing the simulator takes seconds.
        timeout_s: for each answer.

    Raises:
        SimulatorDiedError, SimulatorTimeoutError, ProtocolError, LiberoError: it did not start.
    """

    def __init__(
        self,
        command: Sequence[str],
        environment: Mapping[str, str],
        *,
        start_timeout_s: float = 180.0,
        timeout_s: float = 120.0,
    ) -> None:
        self._timeout_s = timeout_s
        # A file, not a pipe: nobody has to empty it while the simulator is busy.
        self._stderr = cast("IO[bytes]", tempfile.TemporaryFile())  # noqa: SIM115
        try:
            self._process = subprocess.Popen(
                list(command),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._stderr,
                env=dict(environment),
                start_new_session=True,  # Ctrl-C is for the parent, which then ends the child
            )
        except OSError as error:
            self._stderr.close()
            raise SimulatorDiedError(f"cannot start {command[0]}: {error}") from error
        # Also when the interpreter exits without anybody having called close().
        self._finalizer = weakref.finalize(self, _end, self._process, self._stderr)
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            os.set_blocking(pipe.fileno(), False)
        try:
            self.greeting = self._guarded(self._receive, start_timeout_s)
            """The child's first message."""
        except LiberoError:
            self.close()
            raise

    @property
    def pid(self) -> int:
        """The child's process id."""
        return self._process.pid

    @property
    def closed(self) -> bool:
        """Whether the process is gone."""
        return not self._finalizer.alive

    def ask(
        self,
        kind: str,
        fields: Mapping[str, Any] | None = None,
        arrays: Mapping[str, Any] | None = None,
        *,
        timeout_s: float | None = None,
    ) -> Message:
        """Sends a request and waits for its answer.

        Raises:
            AssetsError: the simulator misses a file.
            LiberoError: the request failed there; the process lives on.
            SimulatorDiedError, SimulatorTimeoutError, ProtocolError: the process is gone now.
        """
        if self.closed:
            raise LiberoError("the simulator is closed: make a new world")
        request = encode(Message(kind, fields or {}, arrays or {}))

        def exchange(deadline: float) -> Message:
            self._send(request, deadline)
            return self._receive(deadline)

        return self._guarded(exchange, self._timeout_s if timeout_s is None else timeout_s)

    def close(self) -> None:
        """Ends the process; harmless when repeated."""
        self._finalizer()

    # ---------------------------------------------------------------- the pipe

    def _guarded(self, exchange: Callable[[float], Message], timeout_s: float) -> Message:
        """Runs an exchange; whatever interrupts it midway ends the child, which is out of step."""
        try:
            answer = exchange(time.monotonic() + timeout_s)
        except TimeoutError:
            words = self._last_words()
            self._abort()
            raise SimulatorTimeoutError(
                f"the simulator gave no answer in {timeout_s:g} s and was ended{words}"
            ) from None
        except (EOFError, BrokenPipeError):
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(_CLOSING_TIMEOUT_S)
            code = self._process.poll()
            words = self._last_words()
            self._abort()
            raise SimulatorDiedError(
                f"the simulator's process ended ({_cause(code)}){words}"
            ) from None
        except FramingError as error:
            words = self._last_words()
            self._abort()
            raise ProtocolError(f"the simulator sent no message but {error}{words}") from error
        except BaseException:  # Ctrl-C, above all
            self._abort()
            raise
        if answer.kind == "error":
            self._raise_failure(answer)
        return answer

    def _raise_failure(self, answer: Message) -> None:
        fields = answer.fields
        if fields.get("type") == "assets":
            raise AssetsError(
                f"the assets lack {fields.get('message')}, which this suite needs: "
                "`comvla-sim libero setup --download` gets all of them"
            )
        raise LiberoError(
            f"the simulator failed: {fields.get('message')}\n{fields.get('traceback', '')}"
        )

    def _abort(self) -> None:
        _kill(self._process)
        self.close()

    def _last_words(self) -> str:
        size = os.fstat(self._stderr.fileno()).st_size
        self._stderr.seek(max(0, size - _LAST_WORDS_BYTES))
        words = self._stderr.read().decode(errors="replace").strip()
        return f"; it wrote:\n{words}" if words else ""

    def _wait(self, pipe: IO[bytes], event: int, deadline: float) -> None:
        with selectors.DefaultSelector() as selector:
            selector.register(pipe, event)
            remaining_s = deadline - time.monotonic()
            if remaining_s <= 0 or not selector.select(remaining_s):
                raise TimeoutError

    def _send(self, request: bytes, deadline: float) -> None:
        pipe = self._process.stdin
        assert pipe is not None
        unsent = memoryview(request)
        while unsent:
            self._wait(pipe, selectors.EVENT_WRITE, deadline)
            with contextlib.suppress(BlockingIOError):
                unsent = unsent[os.write(pipe.fileno(), unsent) :]

    def _receive(self, deadline: float) -> Message:
        pipe = self._process.stdout
        assert pipe is not None

        def read_exactly(number: int) -> bytes:
            received = bytearray()
            while len(received) < number:
                self._wait(pipe, selectors.EVENT_READ, deadline)
                with contextlib.suppress(BlockingIOError):
                    some = os.read(pipe.fileno(), min(number - len(received), _CHUNK_BYTES))
                    if not some:
                        raise EOFError
                    received += some
            return bytes(received)

        return read(read_exactly)


def _cause(code: int | None) -> str:
    if code is None:
        return "it closed its pipe"
    if code < 0:
        return f"signal {signal.Signals(-code).name}"
    return f"exit code {code}"
