"""Pictures to train a codec on: the frames of expert episodes, every view on its own."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
from torch import Tensor

from comvla_sim.training.demonstrations import Demonstrations, Progress, generate
from comvla_vla.codecs.waveform import uint8_to_float

FIRST_HELD_OUT_LAYOUT = 900_000
"""Layouts that no training sees; those of evaluations start at a million."""

MOST_LAYOUTS = 100_000
"""In a part of the data."""

# Every eighth step, because neighbours look alike. Labels are what demonstrations cost most, and a
# codec needs none: a horizon of one is as few as the recorder makes.
_STRIDE = 8


def render(
    data: Path,
    *,
    size: int,
    layouts: int,
    held_out_layouts: int,
    workers: int,
    progress: Callable[[Progress], None] | None = None,
) -> None:
    """Makes ``data/train`` and ``data/validation``, or what is missing of them.

    Args:
        data: the folder.
        size: side of a picture in pixels.
        layouts: tables to train on, from layout 0. held_out_layouts: tables to measure on.
        workers: processes.
        progress: see :func:`comvla_sim.training.demonstrations.generate`.
    """
    render_held_out(data, size=size, layouts=held_out_layouts, workers=workers, progress=progress)
    _record(data / "train", range(layouts), size, workers, progress)


def render_held_out(
    data: Path,
    *,
    size: int,
    layouts: int,
    workers: int,
    progress: Callable[[Progress], None] | None = None,
) -> None:
    """Makes ``data/validation`` alone; the arguments are those of :func:`render`."""
    first = FIRST_HELD_OUT_LAYOUT
    _record(data / "validation", range(first, first + layouts), size, workers, progress)


def _record(
    folder: Path,
    seeds: range,
    size: int,
    workers: int,
    progress: Callable[[Progress], None] | None,
) -> None:
    generate(
        folder,
        layouts=seeds,
        workers=workers,
        progress=progress,
        image_size=size,
        image_stride=_STRIDE,
        horizon=1,
        episodes_per_layout=1,
    )


class Pictures:
    """All pictures of a data set in one row: the views of frame 0, then of frame 1, and so on.

    A batch depends on (seed, step) only, so an interrupted run goes on as if it had not stopped.

    Args:
        frames: the data set; also one that a policy was trained on.
        seed: of the order.
    """

    def __init__(self, frames: Demonstrations, seed: int = 0) -> None:
        self._frames = frames
        self._seed = seed
        self.views = int(frames.gather_images([0]).shape[1])

    def __len__(self) -> int:
        return len(self._frames) * self.views

    def of(self, indices: npt.ArrayLike) -> Tensor:
        """(n, 3, S, S) float32 in [0, 1]."""
        wanted = np.asarray(indices)
        pictures = self._frames.gather_images(wanted // self.views)
        chosen = pictures[np.arange(len(wanted)), wanted % self.views]
        return uint8_to_float(chosen)

    def batch(self, step: int, size: int) -> Tensor:
        """The ``step``-th batch of ``size`` pictures."""
        per_epoch = max(1, len(self) // size)
        epoch, place = divmod(step, per_epoch)
        order = np.random.default_rng((self._seed, epoch)).permutation(len(self))
        return self.of(order[place * size : (place + 1) * size])

    def spread(self, count: int) -> Tensor:
        """``count`` pictures from beginning to end, both views in turn."""
        count = min(count, len(self))
        frames = np.linspace(0, len(self._frames) - 1, count).astype(int)
        return self.of(frames * self.views + np.arange(count) % self.views)
