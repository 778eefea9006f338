"""How far an evaluation is, and what was typed to start it."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


def cores() -> int:
    """Cores that this process may use, which in a container are fewer than the machine has."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def typed_command() -> str:
    """The command line of this process, as it is noted in results."""
    return " ".join([Path(sys.argv[0]).name, *sys.argv[1:]])


class Pace:
    """How fast episodes were run. Loading world and policy is not counted: the clock starts with the first row, and the
    steps of that row are left out.
    """

    def __init__(self) -> None:
        self.episodes = 0
        self._steps = 0
        self._began_s = self._ended_s = 0.0

    def counting(
        self, on_row: Callable[[dict[str, Any]], None]
    ) -> Callable[[dict[str, Any]], None]:
        """The same function, with each row counted before."""

        def count(row: dict[str, Any]) -> None:
            self._ended_s = time.perf_counter()
            if self.episodes:
                self._steps += row["steps"]
            else:
                self._began_s = self._ended_s
            self.episodes += 1
            on_row(row)

        return count

    @property
    def steps_per_s(self) -> float | None:
        """Control periods per second of wall time; None with fewer than two episodes."""
        elapsed_s = self._ended_s - self._began_s
        return round(self._steps / elapsed_s, 1) if elapsed_s > 0 else None

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values."""
        return {"episodes": self.episodes, "steps_per_s": self.steps_per_s}

    def __str__(self) -> str:
        pace = "" if self.steps_per_s is None else f", {self.steps_per_s:g} steps per second"
        return f"{self.episodes} episodes run{pace}"


@contextmanager
def episode_bar(total: int, done: int) -> Iterator[Callable[[dict[str, Any]], None]]:
    """A progress bar on a terminal, a line every hundred episodes elsewhere; on stderr."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    console = Console(stderr=True)
    if not console.is_terminal:
        count = done

        def line(row: dict[str, Any]) -> None:
            nonlocal count
            count += 1
            if count % 100 == 0 or count == total:
                print(f"{count}/{total} episodes", file=sys.stderr, flush=True)

        yield line
        return
    columns = (
        TextColumn("episodes"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[last]}"),
    )
    with Progress(*columns, console=console) as progress:
        bar = progress.add_task("", total=total, completed=done, last="")

        def show(row: dict[str, Any]) -> None:
            outcome = "success" if row["success"] else "failure"
            last = f"{row['condition']} {row['method']} K={row['k']} {row['task']}: {outcome}"
            progress.update(bar, advance=1, last=last)

        yield show
