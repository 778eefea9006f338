"""Demonstrations: generating them in parallel and resumably, and reading them back."""

from __future__ import annotations

import contextlib
import hashlib
import json
import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from comvla_sim.training.recording import Frames, Recording, choose_tasks, record_episode
from comvla_sim.training.shards import (
    ARRAYS,
    DemonstrationsError,
    finished_shard,
    load_array,
    prepare_folder,
    read_manifest,
    read_shard,
    shard_folder,
    shard_folders,
    write_shard,
)
from comvla_sim.worlds import make

__all__ = ["Demonstrations", "DemonstrationsError", "Progress", "generate", "progress_bar"]


@dataclass(frozen=True)
class Progress:
    """How far a generation is: layouts done (also by earlier runs), of how many, and frames."""

    layouts_done: int
    layouts_total: int
    frames: int


@contextlib.contextmanager
def progress_bar() -> Iterator[Callable[[Progress], None]]:
    """A bar on the terminal, to be given to :func:`generate` as ``progress``."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    columns = (BarColumn(), MofNCompleteColumn(), TextColumn("layouts, {task.fields[frames]}"))
    console = Console(stderr=True)
    with Bar(TextColumn("demonstrations"), *columns, TimeRemainingColumn(), console=console) as bar:
        line = bar.add_task("", total=None, frames="")

        def show(progress: Progress) -> None:
            frames = f"{progress.frames} frames"
            done, total = progress.layouts_done, progress.layouts_total
            bar.update(line, completed=done, total=total, frames=frames)

        yield show


def _record_shard(folder: Path, layouts: Sequence[int], recording: Recording) -> dict[str, Any]:
    """Records the episodes of some layouts into ``folder``, which appears when it is complete."""
    world = make(recording.world, image_size=recording.image_size)
    frames = Frames()
    episodes: dict[str, int] = {}
    successes: dict[str, int] = {}
    try:
        for seed in layouts:
            world.reset(seed=seed)
            # A stream that is none of this layout's episodes'.
            random = np.random.RandomState([seed, recording.episodes_per_layout])
            chosen = choose_tasks(
                world.possible_tasks(), episodes, recording.episodes_per_layout, random
            )
            for number, task in enumerate(chosen):
                success = record_episode(
                    world, recording, frames, seed=seed, number=number, task=task
                )
                successes[task.name] = successes.get(task.name, 0) + success
    finally:
        world.close()
    description = {
        "layouts": list(layouts),
        "frames": len(frames),
        "episodes": episodes,
        "successes": successes,
    }
    write_shard(folder, frames, description)
    return description


def generate(
    out: Path | str,
    *,
    layouts: Sequence[int],
    workers: int = 1,
    progress: Callable[[Progress], None] | None = None,
    **settings: Any,
) -> None:
    """Generates a data set of demonstrations, or what is still missing of one.

    Only one generation may work on a folder at a time.

    Args:
        out: the folder of the data set.
        layouts: seeds of the layouts, e.g. ``range(1000)``. A longer list with the same beginning
            continues a data set, as long as its shards are full.
        workers: processes. Each has a world of its own.
        progress: called at the start and after every shard; see :func:`progress_bar`.
        settings: fields of :class:`comvla_sim.training.recording.Recording`.

    Raises:
        DemonstrationsError: when ``out`` holds shards of other settings or layouts.
        ValueError: for no layouts, repeated layouts, or no workers.
        TypeError: for a setting that does not exist.
    """
    out = Path(out)
    seeds = [int(seed) for seed in layouts]
    if not seeds or len(set(seeds)) != len(seeds):
        raise ValueError("layouts must be one or more different seeds")
    if workers < 1:
        raise ValueError(f"workers must be at least 1, got {workers}")
    recording = Recording(**settings)
    prepare_folder(out, recording)
    size = recording.layouts_per_shard
    done = frames = 0
    todo: list[tuple[Path, list[int]]] = []
    for number, first in enumerate(range(0, len(seeds), size)):
        folder, members = shard_folder(out, number), seeds[first : first + size]
        shard = finished_shard(folder, members)
        if shard is None:
            todo.append((folder, members))
        else:
            done, frames = done + len(members), frames + int(shard["frames"])

    def report() -> None:
        if progress is not None:
            progress(Progress(done, len(seeds), frames))

    report()
    if not todo:
        return
    # Spawned, not forked: a forked OpenGL context does not work.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(workers, len(todo)), mp_context=context) as pool:
        running: set[Future[dict[str, Any]]] = set()
        while todo or running:
            # A shard for every worker and none in advance: after Ctrl-C or a worker's error
            # nothing waits in the queue that would still be recorded.
            while todo and len(running) < workers:
                folder, members = todo.pop(0)
                running.add(pool.submit(_record_shard, folder, members, recording))
            finished, running = wait(running, return_when=FIRST_COMPLETED)
            for future in finished:
                shard = future.result()
                done, frames = done + len(shard["layouts"]), frames + int(shard["frames"])
                report()


class Demonstrations:
    """A data set read from disk: pictures stay there (memory-mapped), the rest is in memory.

    Attributes:
        proprio: (F, 4) float32.
        chunks: (F, T, H, 4) float16, the clean expert chunk for every task; zero if not possible.
        possible: (F, T) bool.
        points: (F, T, 4, 3) float32 in metres: hand, object, goal, fixture's centre.
        uv: (F, T, V, 4, 2) float32: the same points in the V pictures, in [0, 1].
        task, t: (F,) int16: index of the task that the episode was about, and its control step.
        layout, episode: (F,) int32.
        tasks: names of the T tasks.
        manifest: settings and versions.
        successes: per task (successful episodes, episodes).

    Args:
        path: the folder. Shards that are still being made are not seen.

    Raises:
        DemonstrationsError: when there is no finished shard or one is damaged.
    """

    proprio: npt.NDArray[np.float32]
    chunks: npt.NDArray[np.float16]
    possible: npt.NDArray[np.bool_]
    points: npt.NDArray[np.float32]
    uv: npt.NDArray[np.float32]
    task: npt.NDArray[np.int16]
    layout: npt.NDArray[np.int32]
    t: npt.NDArray[np.int16]
    episode: npt.NDArray[np.int32]

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self.manifest = read_manifest(self.path)
        self.tasks: tuple[str, ...] = tuple(task["name"] for task in self.manifest["tasks"])
        folders = shard_folders(self.path)
        if not folders:
            raise DemonstrationsError(f"{self.path} has no finished shard yet")
        shards = [read_shard(folder) for folder in folders]
        self.successes: dict[str, tuple[int, int]] = {
            name: (
                sum(int(shard["successes"].get(name, 0)) for shard in shards),
                sum(int(shard["episodes"].get(name, 0)) for shard in shards),
            )
            for name in self.tasks
        }
        lengths = [int(shard["frames"]) for shard in shards]
        self._ends = np.cumsum(lengths)
        parts = {
            name: [load_array(folder, name, n) for folder, n in zip(folders, lengths, strict=True)]
            for name in ARRAYS
        }
        self._images = parts.pop("images")
        for name, arrays in parts.items():
            setattr(self, name, np.concatenate(arrays))

    def __len__(self) -> int:
        return int(self._ends[-1])

    def digest(self) -> str:
        """Hex digest of how the data set was made and of everything in it but the pictures, which follow from that."""
        digest = hashlib.sha256(json.dumps(self.manifest, sort_keys=True).encode())
        for name in sorted(set(ARRAYS) - {"images"}):
            digest.update(np.ascontiguousarray(getattr(self, name)).tobytes())
        return digest.hexdigest()

    def gather_images(self, indices: npt.ArrayLike) -> npt.NDArray[np.uint8]:
        """Pictures of some frames.

        Args:
            indices: (n,) integers in [0, len(self)), in any order.

        Returns:
            (n, V, S, S, 3) uint8, a copy.

        Raises:
            IndexError: for an index outside the data set.
        """
        wanted = np.asarray(indices, dtype=np.int64)
        if wanted.size and (wanted.min() < 0 or wanted.max() >= len(self)):
            raise IndexError(f"frames are 0 to {len(self) - 1}, got {wanted.min()}..{wanted.max()}")
        out = np.empty((len(wanted), *self._images[0].shape[1:]), np.uint8)
        shard = np.searchsorted(self._ends, wanted, side="right")
        starts = np.concatenate([[0], self._ends])
        # In the order of the file, so that a spinning disk or a cold cache is read forwards.
        for row in np.argsort(wanted):
            number = shard[row]
            out[row] = self._images[number][wanted[row] - starts[number]]
        return out
