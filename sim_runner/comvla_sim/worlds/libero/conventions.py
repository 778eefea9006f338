"""How LIBERO's observations and actions differ from what OpenVLA-OFT sees and says.

Each convention is a function of its own, so that a test, or a doubt, can be about one of them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

ACTION_DIM = 7
"""Motion of the hand along x, y, z, rotation about x, y, z, and the gripper."""

GRIPPER = 6
"""Which number of an action is the gripper."""

PROPRIO_DIM = 8
MAX_STEPS = {
    "libero_spatial": 220,
    "libero_object": 280,
    "libero_goal": 300,
    "libero_10": 520,
}
"""Steps an episode may take after settling, for each suite (``run_libero_eval.py``)."""

Float64s = npt.NDArray[np.float64]


def upright(frames: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Frames (..., H, W, 3) turned by 180 degrees, as in OpenVLA-OFT's training data.

    The simulator's pictures are upside down. Turning them mirrors left and right as well, compared
    with a camera's picture, but this is what the published policies were trained on.
    """
    return np.ascontiguousarray(frames[..., ::-1, ::-1, :])


def axis_angle(quaternion: npt.ArrayLike) -> Float64s:
    """A quaternion as axis times angle.

    Args:
        quaternion: (4,) in the order x, y, z, w, of unit length.

    Returns:
        (3,) in radians; the angle is in [0, 2π], as robosuite's ``quat2axisangle`` has it: no sign
        is chosen to make it small.
    """
    values = np.asarray(quaternion, dtype=np.float64)
    w = float(np.clip(values[3], -1.0, 1.0))
    sine = float(np.sqrt(1.0 - w * w))
    if np.isclose(sine, 0.0):
        return np.zeros(3)
    return values[:3] * (2.0 * float(np.arccos(w)) / sine)


def proprioception(
    eef_pos: npt.ArrayLike, eef_quat: npt.ArrayLike, gripper_qpos: npt.ArrayLike
) -> npt.NDArray[np.float32]:
    """What the policy is told about the robot.

    Args:
        eef_pos: (3,) position of the hand in metres.
        eef_quat: (4,) its orientation, x, y, z, w.
        gripper_qpos: (2,) positions of the fingers in metres; the second is negative.

    Returns:
        (8,) float32: position, orientation as :func:`axis_angle`, fingers.
    """
    parts = [np.asarray(eef_pos), axis_angle(eef_quat), np.asarray(gripper_qpos)]
    return np.concatenate(parts).astype(np.float32)


def gripper_from_policy(actions: npt.ArrayLike) -> npt.NDArray[Any]:
    """Actions of an OpenVLA-OFT policy in LIBERO's convention.

    A policy says 0 for a closed gripper and 1 for an open one; LIBERO wants +1 to close and -1 to
    open. Exactly 0.5 becomes 0, which leaves the gripper as it is.

    Args:
        actions: (..., 7).

    Returns:
        (..., 7), a copy; the six numbers of the motion are unchanged.
    """
    converted = np.array(actions, dtype=np.float64)
    # Adding zero keeps IEEE's negative zero out of recorded actions.
    converted[..., GRIPPER] = -np.sign(2.0 * converted[..., GRIPPER] - 1.0) + 0.0
    return converted
