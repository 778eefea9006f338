"""What worlds share whose MuJoCo runs in this process: the arm of Meta-World and two far cameras."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import numpy.typing as npt

from comvla_sim.worlds.base import ACTION_DIM, World
from comvla_sim.worlds.rendering import Renderer, load_mujoco, project


class MujocoWorld(World):
    """A world with Meta-World's arm.

    The proprioception (4,) is the hand's position (x, y, z) in metres and the gripper's opening in
    [0, 1]. Subclasses set :attr:`model` and :attr:`data`.

    Args:
        image_size: side of a picture in pixels.
        render: False saves the drawing: the images of every observation are then black.
    """

    def __init__(self, *, image_size: int = 128, render: bool = True) -> None:
        super().__init__(
            image_size=image_size,
            render=render,
            action_dim=ACTION_DIM,
            proprio_low=(-2, -2, -2, 0),
            proprio_high=(2, 2, 2, 1),
        )
        # Meta-World's experts say at every step that their output gets clipped. It is meant to be.
        warnings.filterwarnings("ignore", message=r"Constant\(s\) may be too high")
        self._mujoco: Any = load_mujoco(render)
        self._renderer: Renderer | None = None

    def _pictures(self) -> npt.NDArray[np.uint8]:
        if self._renderer is None:
            self._renderer = Renderer(self.model, self.image_size)
        return self._renderer.draw(self.data)

    def project(self, points: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """(views, n, 2): where points (n, 3) appear, u rightwards and v downwards in [0, 1]."""
        return project(points, float(self.model.vis.global_.fovy))

    def _simulator_state(self) -> npt.NDArray[np.float64]:
        mujoco = self._mujoco
        kind = mujoco.mjtState.mjSTATE_INTEGRATION
        buffer = np.empty(mujoco.mj_stateSize(self.model, kind))
        mujoco.mj_getState(self.model, self.data, buffer, kind)
        return buffer

    def _set_simulator_state(self, state: npt.NDArray[np.float64]) -> None:
        mujoco = self._mujoco
        mujoco.mj_setState(self.model, self.data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
        # Positions only: a full mj_forward would be slower and is not needed before a step.
        mujoco.mj_kinematics(self.model, self.data)

    def close(self) -> None:
        """Frees the renderer; harmless when repeated."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
