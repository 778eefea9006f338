"""What is known about a moment in LIBERO's simulator, beyond what a policy is told."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from comvla_sim.worlds.libero.child.framing import Message
from comvla_sim.worlds.libero.errors import ProtocolError

Float64s = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Reading:
    """One moment.

    Attributes:
        eef_pos: (3,) the hand, between the fingertips, in metres.
        eef_quat: (4,) its orientation, x, y, z, w.
        gripper_qpos: (2,) positions of the fingers in metres; the second is negative.
        met: (goals,) which parts of the goal are fulfilled.
        poses: (things, 7) position and quaternion (x, y, z, w) of every thing of the scene.
    """

    eef_pos: Float64s
    eef_quat: Float64s
    gripper_qpos: Float64s
    met: npt.NDArray[np.bool_]
    poses: Float64s

    @classmethod
    def from_message(cls, message: Message) -> Reading:
        """Reads an answer of the simulator.

        Raises:
            ProtocolError: arrays are missing or misshapen.
        """
        shapes: dict[str, tuple[int, ...]] = {
            "eef_pos": (3,),
            "eef_quat": (4,),
            "gripper_qpos": (2,),
            "met": (-1,),
            "poses": (-1, 7),
        }
        arrays = {name: _array(message, name, shape) for name, shape in shapes.items()}
        return cls(**arrays)

    @property
    def success(self) -> bool:
        """Whether the whole goal is fulfilled."""
        return bool(self.met.all())


@dataclass(frozen=True)
class Thing:
    """Something in the scene.

    Attributes:
        index: its row in :attr:`Reading.poses`.
        kind: ``"object"`` (can be moved), ``"fixture"`` or ``"region"``.
        size: (3,) half extents of a region in metres.
        points: (m, 3) on its colliding parts in its own frame, in metres; none for regions.
    """

    index: int
    kind: str
    size: Float64s
    points: Float64s


@dataclass(frozen=True)
class Scene:
    """What stays the same during an episode.

    Attributes:
        things: by name.
        goal: parts of the goal such as ``("on", "akita_black_bowl_1", "plate_1")``.
        base: (3,) where the arm stands, in metres.
    """

    things: Mapping[str, Thing]
    goal: tuple[tuple[str, ...], ...]
    base: Float64s

    @classmethod
    def from_message(cls, message: Message) -> Scene:
        """Reads the answer to a reset.

        Raises:
            ProtocolError: it does not describe a scene.
        """
        try:
            fields: Mapping[str, Any] = message.fields
            things = {}
            for index, ((name, kind), size) in enumerate(
                zip(fields["things"], fields["sizes"], strict=True)
            ):
                points = message.arrays.get(f"points/{name}", np.empty((0, 3)))
                things[str(name)] = Thing(index, str(kind), np.asarray(size, np.float64), points)
            goal = tuple(tuple(str(word) for word in part) for part in fields["goal"])
        except (KeyError, TypeError, ValueError) as error:
            raise ProtocolError(f"the simulator described no scene: {error!r}") from error
        return cls(things, goal, _array(message, "base", (3,)))


@dataclass(frozen=True)
class Cameras:
    """Where the cameras are at a moment.

    Attributes:
        positions: (views, 3) in metres.
        rotations: (views, 3, 3); columns are the camera's right, up and backward directions.
        fovy_deg: (views,) vertical fields of view.
    """

    positions: Float64s
    rotations: Float64s
    fovy_deg: Float64s

    def project(self, points: npt.ArrayLike) -> Float64s:
        """Where points (n, 3) appear in the pictures that a policy sees.

        Those are the simulator's pictures turned by 180 degrees, and these are upside down: a
        camera's own picture mirrored left to right.

        Returns:
            (views, n, 2): u rightwards and v downwards in [0, 1]; NaN behind the camera.
        """
        offsets = np.asarray(points, np.float64)[None] - self.positions[:, None]
        right, up, backward = np.moveaxis(offsets @ self.rotations, -1, 0)
        depth = np.where(-backward > 0, -backward, np.nan)
        focal = 0.5 / np.tan(np.deg2rad(self.fovy_deg) / 2)[:, None]
        u = 0.5 - focal * right / depth
        v = 0.5 - focal * up / depth
        return np.stack([u, v], axis=-1)


def _array(message: Message, name: str, shape: Sequence[int]) -> npt.NDArray[Any]:
    array = message.arrays.get(name)
    if array is None:
        raise ProtocolError(f"the simulator's answer lacks the array {name!r}")
    fits = array.ndim == len(shape) and all(
        wanted in (-1, got) for wanted, got in zip(shape, array.shape, strict=True)
    )
    if not fits:
        raise ProtocolError(f"expected {name!r} of shape {tuple(shape)}, got {array.shape}")
    return np.asarray(array)
