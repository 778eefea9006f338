"""What is on the table and where: knowledge that a policy does not get, but an expert may use."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

Array = np.ndarray[Any, np.dtype[np.float64]]

POINTS_APART_M = 0.02
"""How close to each other the points on a thing are."""


class Things:
    """Objects, fixtures and regions of an environment, in a fixed order.

    Args:
        env: robosuite's environment, reset.
    """

    def __init__(self, env: Any) -> None:
        self._model: Any = env.sim.model._model
        self._data: Any = env.sim.data._data
        self.names: list[tuple[str, str]] = [
            *((name, "object") for name in env.objects_dict),
            *((name, "fixture") for name in env.fixtures_dict),
            *((name, "region") for name in env.object_sites_dict),
        ]
        """(name, kind) of each; kind is ``"object"``, ``"fixture"`` or ``"region"``."""
        bodies = {**env.objects_dict, **env.fixtures_dict}
        self._ids = [
            self._id("site", name) if kind == "region" else self._id("body", bodies[name].root_body)
            for name, kind in self.names
        ]

    def _id(self, kind: str, name: str) -> int:
        types = {"site": mujoco.mjtObj.mjOBJ_SITE, "body": mujoco.mjtObj.mjOBJ_BODY}
        found = mujoco.mj_name2id(self._model, types[kind], name)
        if found < 0:
            raise ValueError(f"the scene has no {kind} {name!r}")
        return int(found)

    def _pose(self, index: int) -> tuple[Array, Array]:
        """Position (3,) and rotation (3, 3)."""
        data, found = self._data, self._ids[index]
        if self.names[index][1] == "region":
            return data.site_xpos[found], data.site_xmat[found].reshape(3, 3)
        return data.xpos[found], data.xmat[found].reshape(3, 3)

    def poses(self) -> Array:
        """(n, 7): position in metres and orientation as a quaternion x, y, z, w."""
        rows = np.empty((len(self.names), 7))
        quaternion = np.empty(4)
        for index, row in enumerate(rows):
            position, rotation = self._pose(index)
            mujoco.mju_mat2Quat(quaternion, rotation.reshape(9))
            row[:3], row[3:6], row[6] = position, quaternion[1:], quaternion[0]
        return rows

    def sizes(self) -> list[list[float]]:
        """For every region its half extents in metres; zeros for objects and fixtures."""
        return [
            self._model.site_size[found].tolist() if kind == "region" else [0.0, 0.0, 0.0]
            for (_, kind), found in zip(self.names, self._ids)  # noqa: B905 (Python 3.9 has no strict)
        ]

    def points(self) -> dict[str, Array]:
        """For every object and fixture, points (m, 3) of its colliding parts in its own frame."""
        found = {}
        for index, (name, kind) in enumerate(self.names):
            if kind != "region":
                position, rotation = self._pose(index)
                parts = [self._geom_points(geom) for geom in self._geoms(self._ids[index])]
                stacked = np.concatenate(parts) if parts else np.empty((0, 3))
                found[name] = (stacked - position) @ rotation
        return found

    def _geoms(self, root: int) -> list[int]:
        """Colliding geoms of a body and of the bodies attached to it."""
        model = self._model
        return [
            geom
            for geom in range(model.ngeom)
            if (model.geom_contype[geom] or model.geom_conaffinity[geom])
            and self._belongs(int(model.geom_bodyid[geom]), root)
        ]

    def _belongs(self, body: int, root: int) -> bool:
        while body not in (0, root):
            body = int(self._model.body_parentid[body])
        return body == root

    def _geom_points(self, geom: int) -> Array:
        """A grid (m, 3) over the box around a geom, in the world."""
        centre, half = self._model.geom_aabb[geom, :3], self._model.geom_aabb[geom, 3:]
        axes = [np.linspace(-h, h, int(np.ceil(2 * h / POINTS_APART_M)) + 1) for h in half]
        grid = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)
        rotation = self._data.geom_xmat[geom].reshape(3, 3)
        return np.asarray(self._data.geom_xpos[geom] + (centre + grid) @ rotation.T)
