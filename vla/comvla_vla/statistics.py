"""Data-set statistics: raw proprioception in, real actions out."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from comvla.errors import CheckpointError

# OpenVLA divides by (q99 - q01 + 1e-8) and multiplies by the same on the way back.
_EPSILON = 1e-8

# OpenVLA-OFT's two ways to choose bounds: percentiles (LIBERO) or extremes (ALOHA, and the small policy here).
_BOUNDS = {"bounds_q99": ("q01", "q99"), "bounds": ("min", "max")}


@dataclass(frozen=True)
class Statistics:
    """Bounds of actions and proprioception in the training data.

    Attributes:
        key: name of the data set.
        action_low, action_high: (A,) bounds. action_mask: (A,) True where actions are normalised.
        proprio_low, proprio_high: (P,) bounds; empty where the model takes no proprioception.
    """

    key: str
    action_low: NDArray[np.float64]
    action_high: NDArray[np.float64]
    action_mask: NDArray[np.bool_]
    proprio_low: NDArray[np.float64]
    proprio_high: NDArray[np.float64]

    def normalise_proprio(self, proprio: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
        """Raw (..., P) to [-1, 1], clipped."""
        width = self.proprio_high - self.proprio_low + _EPSILON
        scaled = 2 * (np.asarray(proprio, dtype=np.float64) - self.proprio_low) / width - 1
        return np.clip(scaled, -1, 1).astype(np.float32)

    def unnormalise_actions(self, actions: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
        """Model outputs (..., A) to real actions; masked-out dimensions pass through; nothing is clipped."""
        wide = np.asarray(actions, dtype=np.float64)
        real = 0.5 * (wide + 1) * (self.action_high - self.action_low + _EPSILON) + self.action_low
        return np.where(self.action_mask, real, wide).astype(np.float32)


def read_statistics(path: Path, key: str | None = None) -> Statistics:
    """Reads ``dataset_statistics.json``; with one key in it, that one is the default.

    Raises:
        CheckpointError: unreadable file, no or several keys without a choice, or a key that is not there.
    """
    try:
        table = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise CheckpointError(f"cannot read the data-set statistics {path}: {error}") from error
    return pick_statistics(table, key, where=str(path))


def pick_statistics(table: dict[str, Any], key: str | None, where: str) -> Statistics:
    """Chooses one entry of a statistics table (see :func:`read_statistics`)."""
    if not isinstance(table, dict) or not table:
        raise CheckpointError(
            f"{where} holds no data-set statistics: copy dataset_statistics.json of the checkpoint"
        )
    if key is None and len(table) > 1:
        raise CheckpointError(
            f"{where} holds several statistics {sorted(table)}: choose one with statistics_key="
        )
    key = key if key is not None else next(iter(table))
    if key not in table:
        raise CheckpointError(f"{where} has no statistics {key!r}, it holds {sorted(table)}")
    entry = table[key]
    try:
        low_name, high_name = _BOUNDS[entry.get("normalization", "bounds_q99")]
        action, proprio = entry["action"], entry.get("proprio", {low_name: [], high_name: []})
        low = np.asarray(action[low_name], np.float64)
        high = np.asarray(action[high_name], np.float64)
        return Statistics(
            key=key,
            action_low=low,
            action_high=high,
            action_mask=np.asarray(action.get("mask", [True] * len(low)), np.bool_),
            proprio_low=np.asarray(proprio[low_name], np.float64),
            proprio_high=np.asarray(proprio[high_name], np.float64),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(
            f"statistics {key!r} in {where} lack {error}: need action and proprio q01/q99"
        ) from error
