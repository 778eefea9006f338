"""Meta-World's scripted experts, as functions of positions."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import numpy.typing as npt

_OBJECT_DIM = 14  # what Meta-World's observation reserves for objects


@functools.cache
def _policy(name: str) -> Any:
    # metaworld.policies imports nothing of MuJoCo, but its package does: hence not at the top.
    import metaworld.policies

    return getattr(metaworld.policies, name)()


def metaworld_expert(
    policy: str,
    *,
    hand: npt.NDArray[np.float64],
    gripper: float,
    handle: npt.NDArray[np.float64],
    goal: npt.NDArray[np.float64],
) -> npt.NDArray[np.float32]:
    """The action of one of Meta-World's experts.

    The experts read a flat observation of 39 numbers: hand, gripper and object now, the same of the
    step before (which none of those used here looks at), and the goal.

    Args:
        policy: a class of ``metaworld.policies``.
        hand: (3,) in metres.
        gripper: opening in [0, 1].
        handle: (3,) the object's position in metres.
        goal: (3,) in metres.

    Returns:
        (4,) float32 in [-1, 1].
    """
    now = np.concatenate([hand, [gripper], handle, np.zeros(_OBJECT_DIM - len(handle))])
    action = _policy(policy).get_action(np.concatenate([now, now, goal]))
    return np.asarray(np.clip(action, -1.0, 1.0), np.float32)
