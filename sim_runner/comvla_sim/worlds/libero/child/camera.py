"""Pictures exactly as LIBERO's environment takes them, drawn only when somebody looks.

robosuite samples its cameras on a clock of its own, one or two physics steps before a control step
ends, and a picture costs more than the physics of several control steps. So at those moments the
state is only copied, and drawn when it is asked for.
"""

from __future__ import annotations

import copy
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np

from .libero_api import observable

CAMERAS = ("agentview", "robot0_eye_in_hand")
"""In the order in which OpenVLA-OFT sees them."""


class LazyCamera:
    """The two cameras of an environment.

    Args:
        env: robosuite's environment with an off-screen context, before its first reset.
        image_size: side of a picture in pixels.
        plain: draw without shadows, reflections and multisampling.
    """

    def __init__(self, env: Any, image_size: int, *, plain: bool) -> None:
        self._size = image_size
        self._model: Any = env.sim.model._model
        self._data: Any = env.sim.data._data
        # Lamps and hot plates are sites that LIBERO colours while it runs.
        self._site_rgba = self._model.site_rgba.copy()
        self._context: Any = env.sim._render_context_offscreen
        self._context.data = SimpleNamespace(_data=copy.copy(self._data))
        if plain:
            self._draw_plainly()
        env.add_observable(observable("scene_copy", self.sample, env.control_freq))

    def _draw_plainly(self) -> None:
        self._model.vis.quality.offsamples = 0
        # The number of samples is fixed when MuJoCo's context is made.
        self._context.con.free()
        self._context._set_mujoco_context_and_buffers()
        self._context.scn.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
        self._context.scn.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0

    def sample(self) -> None:
        """Remembers the present state as the one to draw."""
        self._context.data._data = copy.copy(self._data)
        self._site_rgba[:] = self._model.site_rgba

    def draw(self) -> np.ndarray[Any, np.dtype[np.uint8]]:
        """(2, S, S, 3) uint8 of the remembered state, upside down as the simulator gives them."""
        now = self._model.site_rgba.copy()
        self._model.site_rgba[:] = self._site_rgba
        pictures = []
        for name in CAMERAS:
            camera = mujoco.mj_name2id(self._model, mujoco.mjtObj.mjOBJ_CAMERA, name)
            self._context.render(self._size, self._size, camera_id=camera)
            pictures.append(self._context.read_pixels(self._size, self._size))
        self._model.site_rgba[:] = now
        return np.stack(pictures)


def camera_poses(env: Any) -> dict[str, np.ndarray[Any, np.dtype[np.float64]]]:
    """Where the cameras are now: ``positions`` (2, 3), ``rotations`` (2, 3, 3), ``fovy_deg`` (2,).

    A rotation's columns are the camera's right, up and backward directions in the world.
    """
    model, data = env.sim.model._model, env.sim.data._data
    ids = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, name) for name in CAMERAS]
    return {
        "positions": data.cam_xpos[ids].copy(),
        "rotations": data.cam_xmat[ids].reshape(len(ids), 3, 3).copy(),
        "fovy_deg": model.cam_fovy[ids].astype(np.float64),
    }
