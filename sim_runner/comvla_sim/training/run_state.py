"""Checkpoints of a training run: a safetensors file, and notes that name it once it is whole."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from comvla.errors import ComVLAError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

_NOTES = "state.json"


class TrainingError(ComVLAError):
    """A run that cannot start or go on; the message says what to change."""


@dataclass(frozen=True)
class RunState:
    """Where a run is.

    Attributes:
        step: optimiser steps done.
        seconds: spent on them.
        tensors: of networks and optimiser.
    """

    step: int
    seconds: float
    tensors: dict[str, Tensor]


def load_run(folder: Path, recipe: DataclassInstance, data: str | None = None) -> RunState | None:
    """The last checkpoint of a folder; None where there is none.

    Args:
        folder: of the run. recipe: of the run.
        data: digest of what it learns from; None where nobody asks.

    Raises:
        TrainingError: the folder belongs to a run with another recipe or on other data, or is damaged.
    """
    notes = folder / _NOTES
    if not notes.is_file():
        return None
    try:
        state = json.loads(notes.read_text())
        theirs, step, seconds = state["recipe"], int(state["step"]), float(state["seconds"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise TrainingError(f"cannot read {notes} ({error}): choose another folder") from error
    ours = json.loads(json.dumps(asdict(recipe)))
    if theirs != ours:
        changed = sorted(k for k in {*ours, *theirs} if theirs.get(k) != ours.get(k))
        raise TrainingError(
            f"{folder} holds a run with another {', '.join(changed)}: choose another folder"
        )
    if None not in (data, state.get("data")) and state["data"] != data:
        raise TrainingError(
            f"{folder} holds a run on other data: name those it began with, or choose another folder"
        )
    path = folder / f"state-{step}.safetensors"
    try:
        return RunState(step, seconds, load_file(path))
    except (OSError, SafetensorError) as error:
        raise TrainingError(f"cannot read {path} ({error}): choose another folder") from error


def save_run(
    folder: Path, recipe: DataclassInstance, state: RunState, data: str | None = None
) -> None:
    """Writes a checkpoint; the notes name it only once it is whole, and then the older ones go."""
    folder.mkdir(parents=True, exist_ok=True)
    current = folder / f"state-{state.step}.safetensors"
    save_file(state.tensors, current)
    notes = {
        "step": state.step,
        "seconds": state.seconds,
        "recipe": asdict(recipe),
        "data": data,
    }
    partial = folder / f"{_NOTES}.writing"
    partial.write_text(json.dumps(notes))
    partial.replace(folder / _NOTES)
    for old in folder.glob("state-*.safetensors"):
        if old != current:
            old.unlink()


def optimizer_tensors(optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """An optimiser's moments by name."""
    return {
        f"optimizer.{index}.{name}": value
        for index, moments in optimizer.state_dict()["state"].items()
        for name, value in moments.items()
    }


def set_optimizer_tensors(optimizer: torch.optim.Optimizer, tensors: Mapping[str, Tensor]) -> None:
    """Puts back what :func:`optimizer_tensors` returned; other names are ignored."""
    moments: dict[int, dict[str, Any]] = {}
    for name, value in tensors.items():
        if name.startswith("optimizer."):
            _, index, kind = name.split(".")
            moments.setdefault(int(index), {})[kind] = value
    optimizer.load_state_dict({**optimizer.state_dict(), "state": moments})


class Schedule(Protocol):
    """What a recipe says about the learning rate."""

    @property
    def steps(self) -> int:
        """Optimiser steps of the run."""

    @property
    def learning_rate(self) -> float:
        """The highest rate."""

    @property
    def warmup_steps(self) -> int:
        """Steps until it is reached."""

    @property
    def final_share(self) -> float:
        """Share of it at the end."""


def learning_rate(recipe: Schedule, step: int) -> float:
    """Linear warm-up, then a cosine down to ``final_share``."""
    done = step / recipe.steps
    cosine = recipe.final_share + (1 - recipe.final_share) * 0.5 * (1 + math.cos(math.pi * done))
    return recipe.learning_rate * min(1.0, (step + 1) / recipe.warmup_steps) * cosine
