"""Where a parallel gripper can take hold of something, from points on its colliding parts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Float64s = npt.NDArray[np.float64]

MAX_OPENING_M = 0.07
"""Between the fingertips, with a little to spare."""

_RIM_DEPTH_M = 0.012
_FINGERTIP_M = 0.035
_TOP_SLAB_M = 0.012
_HOLLOW_RADIUS_M = 0.02
_AMPLE_M = 0.01
_COMFORTABLE_REACH_M = 0.68

# The open Panda gripper as boxes (low, high): along the line through the fingers, across it, and
# up, in metres from the point between the fingertips.
_GRIPPER = (
    ((-0.058, -0.014, -0.010), (-0.036, 0.014, 0.055)),
    ((0.036, -0.014, -0.010), (0.058, 0.014, 0.055)),
    ((-0.105, -0.035, 0.055), (0.105, 0.035, 0.150)),
)


@dataclass(frozen=True)
class Grasp:
    """One way to take hold of a thing from above.

    Attributes:
        offset: (3,) from the thing's origin to the point between the fingertips, in the world's
            axes, in metres.
        direction: angle of the line through both fingers in the horizontal plane, in radians; it
            means the same with π added.
        clearance_m: from the open gripper to the nearest other thing.
    """

    offset: Float64s
    direction: float
    clearance_m: float


def turn_from_rest(direction: float) -> float:
    """How far the hand has to turn, in (-π/2, π/2], from fingers along y to ``direction``."""
    return float((direction - np.pi / 2 + np.pi / 2) % np.pi - np.pi / 2)


def is_hollow(points: Float64s) -> bool:
    """Whether a thing is open at the top, like a bowl, and too wide to be held across.

    Args:
        points: (m, 3) points on its colliding parts in its own frame, whose z points up.
    """
    rim = points[points[:, 2] > points[:, 2].max() - _TOP_SLAB_M, :2]
    middle = (rim.max(0) + rim.min(0)) / 2
    radii = np.linalg.norm(rim - middle, axis=1)
    wide = bool((rim.max(0) - rim.min(0)).min() > MAX_OPENING_M)
    return wide and bool(radii.min() > _HOLLOW_RADIUS_M)


def find_grasps(
    points: Float64s, rotation: Float64s, others: Float64s, base: Float64s
) -> list[Grasp]:
    """Grasps of a thing, the most promising first.

    A hollow thing is pinched at its rim, one finger inside; anything else is held across its
    narrowest width.

    Args:
        points: (m, 3) points on its colliding parts in its own frame, in metres.
        rotation: (3, 3) of that frame.
        others: (n, 3) points on the other things, relative to its origin, with the world's axes.
        base: (3,) where the arm stands, likewise.
    """
    grasps = (
        _rim_pinches(points, rotation, others)
        if is_hollow(points)
        else _holds(points @ rotation.T, others)
    )
    # Ample room is enough. Then not too far, where a stretched arm gets stuck, and little turning.
    return sorted(grasps, key=lambda g: (-min(g.clearance_m, _AMPLE_M), _effort(g, base)))


def _effort(grasp: Grasp, base: Float64s) -> float:
    """How hard it is to reach: centimetres beyond a comfortable reach, and turning."""
    beyond = float(np.linalg.norm((grasp.offset - base)[:2])) - _COMFORTABLE_REACH_M
    return max(0.0, beyond) / 0.05 + abs(turn_from_rest(grasp.direction)) / np.pi


def _rim_pinches(points: Float64s, rotation: Float64s, others: Float64s) -> list[Grasp]:
    top = points[:, 2].max()
    rim = points[points[:, 2] > top - _TOP_SLAB_M, :2]
    middle = (rim.max(0) + rim.min(0)) / 2
    radius = float(np.linalg.norm(rim - middle, axis=1).mean())
    grasps = []
    for angle in np.deg2rad(np.arange(0, 360, 30)):
        outward = rotation @ np.array([np.cos(angle), np.sin(angle), 0.0])
        edge = rotation @ np.array([*middle, top]) + radius * outward
        offset = edge - np.array([0, 0, _RIM_DEPTH_M])
        direction = float(np.arctan2(outward[1], outward[0]))
        grasps.append(Grasp(offset, direction, _clearance(offset, direction, others)))
    return grasps


def _holds(points: Float64s, others: Float64s) -> list[Grasp]:
    top, bottom = points[:, 2].max(), points[:, 2].min()
    grasps = []
    for angle in np.deg2rad(np.arange(0, 180, 15)):
        along = np.array([np.cos(angle), np.sin(angle)])
        extent = points[:, :2] @ along
        width = float(extent.max() - extent.min())
        if width > MAX_OPENING_M:
            continue
        across = np.array([-along[1], along[0]])
        depth = points[:, :2] @ across
        middle = (
            along * (extent.max() + extent.min()) / 2 + across * (depth.max() + depth.min()) / 2
        )
        offset = np.array([*middle, max(top - _FINGERTIP_M, (top + bottom) / 2)])
        grasps.append(Grasp(offset, float(angle), _clearance(offset, float(angle), others)))
    return grasps


def _clearance(offset: Float64s, direction: float, others: Float64s) -> float:
    """Distance in metres from the open gripper to the nearest of the other things' points."""
    if not len(others):
        return float("inf")
    cos, sin = np.cos(direction), np.sin(direction)
    seen = (others - offset) @ np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    return min(
        float(np.linalg.norm(np.maximum(np.maximum(low - seen, seen - high), 0), axis=1).min())
        for low, high in (np.asarray(box) for box in _GRIPPER)
    )
