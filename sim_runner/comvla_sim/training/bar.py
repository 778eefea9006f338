"""How a training shows where it is."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def training_bar(steps: int, done: int) -> Iterator[Callable[[int, str], None]]:
    """A bar on a terminal, plain lines elsewhere; on stderr.

    Args:
        steps: of the whole training.
        done: by earlier runs.

    Yields:
        A function of the step and a few words about it.
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    console = Console(stderr=True)
    if not console.is_terminal:

        def line(step: int, words: str) -> None:
            if step % 100 == 0 or step == steps:
                print(f"step {step}/{steps} {words}", file=sys.stderr, flush=True)

        yield line
        return
    columns = (
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
    )
    with Bar(TextColumn("training"), *columns, console=console) as bar:
        task = bar.add_task("", total=steps, completed=done, note="")

        def show(step: int, words: str) -> None:
            bar.update(task, completed=step, note=words)

        yield show
