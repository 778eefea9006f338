"""Many worlds at once, one process each.

One process per world is not only for speed: an OpenGL context belongs to one thread, and the
simulator keeps the interpreter busy.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import multiprocessing.connection
import signal
import traceback
from collections.abc import Sequence
from types import TracebackType
from typing import Any

import numpy.typing as npt

from comvla.errors import ComVLAError
from comvla_sim.worlds.base import Info, Observation, StepResult

_Connection = multiprocessing.connection.Connection

_CLOSING_TIMEOUT_S = 5.0


class WorkerError(ComVLAError, RuntimeError):
    """A world's process failed. The message holds the traceback of that process."""


def _serve(connection: _Connection, name: str, image_size: int | None, render: bool) -> None:
    """The life of a worker: make the world, then answer (method, arguments) until told to stop."""
    # Ctrl-C reaches every process of the terminal. The parent decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    world = None
    try:
        from comvla_sim.worlds import make

        world = make(name, image_size=image_size, render=render)
        while True:
            method, arguments, keywords = connection.recv()
            if method == "close":
                return
            try:
                answer = (True, getattr(world, method)(*arguments, **keywords))
            except Exception as error:
                # An exception itself may not survive the pipe; its words always do.
                answer = (False, (f"{type(error).__name__}: {error}", traceback.format_exc()))
            connection.send(answer)
    except (EOFError, BrokenPipeError):
        return  # the parent is gone
    except Exception as error:
        with contextlib.suppress(OSError):
            words = (f"{type(error).__name__}: {error}", traceback.format_exc())
            connection.send((False, words))
    finally:
        if world is not None:
            world.close()
        connection.close()


class VectorWorld:
    """``num_envs`` worlds of one name that act at the same time. Also a context manager.

    Args:
        name: as for :func:`comvla_sim.worlds.make`.
        num_envs: number of worlds and processes.
        image_size: side of a picture in pixels; None takes the world's own.
        render: False saves the drawing.

    Raises:
        WorkerError: when a world cannot be made.
    """

    def __init__(
        self, name: str, num_envs: int, *, image_size: int | None = None, render: bool = True
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, got {num_envs}")
        # Spawned, not forked: a forked OpenGL context or a forked torch does not work.
        context = multiprocessing.get_context("spawn")
        self.name, self.num_envs = name, num_envs
        self._connections: list[_Connection] = []
        self._processes: list[Any] = []
        self._closed = False
        try:
            for number in range(num_envs):
                here, there = context.Pipe()
                process = context.Process(
                    target=_serve,
                    args=(there, name, image_size, render),
                    name=f"world-{number}",
                    daemon=True,
                )
                process.start()
                there.close()
                self._connections.append(here)
                self._processes.append(process)
            self._exchange({number: ("possible_tasks", (), {}) for number in range(num_envs)})
        except BaseException:
            self.close()
            raise

    def _exchange(
        self, requests: dict[int, tuple[str, tuple[Any, ...], dict[str, Any]]]
    ) -> dict[int, Any]:
        """Sends requests to some workers, then awaits their answers.

        Every answer is awaited before an error is raised, so that none can be taken for one of the
        next call. After Ctrl-C that is impossible: the worlds are closed.
        """
        if self._closed:
            raise RuntimeError("these worlds are closed: make a new VectorWorld")
        try:
            for number, request in requests.items():
                with contextlib.suppress(BrokenPipeError):  # _receive says that it is gone
                    self._connections[number].send(request)
            answers = {number: self._receive(number) for number in requests}
        except BaseException:
            self.close()
            raise
        failures = [
            f"world {number} ({self.name}): {answer[0]}\n{answer[1]}"
            for number, (fine, answer) in answers.items()
            if not fine
        ]
        if failures:
            raise WorkerError("\n".join(failures).rstrip())
        return {number: answer for number, (_, answer) in answers.items()}

    def _receive(self, number: int) -> tuple[bool, Any]:
        """(True, result), or (False, (error, traceback)) in words."""
        try:
            answer: tuple[bool, Any] = self._connections[number].recv()
        except (EOFError, ConnectionResetError):
            self._processes[number].join(_CLOSING_TIMEOUT_S)
            code = self._processes[number].exitcode
            return False, (f"its process ended with exit code {code}", "")
        return answer

    def reset(
        self, seeds: Sequence[int], tasks: Sequence[str | None] | None = None
    ) -> list[tuple[Observation, Info]]:
        """Resets every world.

        Args:
            seeds: one for each world.
            tasks: one for each world; None lets the seed decide.

        Returns:
            (observation, info) of every world.
        """
        tasks = [None] * self.num_envs if tasks is None else list(tasks)
        self._check("seeds", len(seeds))
        self._check("tasks", len(tasks))
        requests = {}
        for number, (seed, task) in enumerate(zip(seeds, tasks, strict=True)):
            options = None if task is None else {"task": task}
            requests[number] = ("reset", (), {"seed": int(seed), "options": options})
        answers = self._exchange(requests)
        return [answers[number] for number in range(self.num_envs)]

    def step_chunk(self, chunks: Sequence[npt.ArrayLike | None]) -> list[StepResult | None]:
        """Executes one chunk (H, A) in every world, at the same time.

        Args:
            chunks: one for each world; None lets that world rest (its episode may be over).

        Returns:
            What :meth:`World.step_chunk` returns, for every world; None for those at rest.
        """
        self._check("chunks", len(chunks))
        answers = self._exchange(
            {
                number: ("step_chunk", (chunk,), {})
                for number, chunk in enumerate(chunks)
                if chunk is not None
            }
        )
        return [answers.get(number) for number in range(self.num_envs)]

    def _check(self, what: str, number: int) -> None:
        if number != self.num_envs:
            raise ValueError(f"expected {self.num_envs} {what}, one for each world, got {number}")

    def close(self) -> None:
        """Ends the processes; harmless when repeated."""
        if self._closed:
            return
        self._closed = True
        for connection in self._connections:
            with contextlib.suppress(OSError):
                connection.send(("close", (), {}))
        for process, connection in zip(self._processes, self._connections, strict=True):
            process.join(_CLOSING_TIMEOUT_S)
            if process.is_alive():
                process.terminate()
                process.join()
            connection.close()

    def __enter__(self) -> VectorWorld:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
