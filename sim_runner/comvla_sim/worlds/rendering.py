"""Off-screen pictures of a MuJoCo scene, on machines with or without a screen.

MuJoCo decides while it is being *imported* which OpenGL library it will use. This module therefore
looks for a library first (:func:`find_gl_backend`), writes the answer into ``MUJOCO_GL`` unless the
user has set it, and only then imports ``mujoco`` (:func:`load_mujoco`). All of that happens on the
first use of a world, never when ``comvla_sim`` is imported.
"""

from __future__ import annotations

import atexit
import ctypes
import functools
import importlib
import os
import sys
import weakref
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from comvla.errors import DependencyError

# Software rasterising first: it needs no driver and draws the same pixels on every machine.
_LINUX_LIBRARIES: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("osmesa", ("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so")),
    ("egl", ("libEGL.so.1", "libEGL.so")),
)
_REMEDY = (
    "install one with `apt-get install libosmesa6` (software, needs no graphics card) or "
    "`apt-get install libegl1`, or point MUJOCO_GL at one that works"
)


@dataclass(frozen=True)
class Camera:
    """A free camera, in MuJoCo's terms.

    Attributes:
        lookat: the point (x, y, z) in metres at the centre of the picture.
        distance_m: from that point to the camera.
        azimuth_deg: direction of view around the vertical axis.
        elevation_deg: direction of view above the horizon; negative looks down.
    """

    lookat: tuple[float, float, float]
    distance_m: float
    azimuth_deg: float
    elevation_deg: float

    def axes(self) -> tuple[npt.NDArray[np.float64], ...]:
        """The camera's place and its unit vectors: (position, forward, right, up), each (3,)."""
        azimuth, elevation = np.deg2rad(self.azimuth_deg), np.deg2rad(self.elevation_deg)
        forward = np.array(
            [
                np.cos(elevation) * np.cos(azimuth),
                np.cos(elevation) * np.sin(azimuth),
                np.sin(elevation),
            ]
        )
        right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
        position = np.asarray(self.lookat) - self.distance_m * forward
        return position, forward, right, np.cross(right, forward)


FAR_CAMERAS: tuple[Camera, ...] = (
    Camera((0.0, 0.70, 0.08), 1.75, 160.0, -40.0),
    Camera((0.0, 0.70, 0.05), 1.75, 270.0, -60.0),
)
"""From the side and from the far end: the whole table and the hand stay in both pictures."""


def project(
    points: npt.ArrayLike, fovy_deg: float, cameras: tuple[Camera, ...] = FAR_CAMERAS
) -> npt.NDArray[np.float64]:
    """Where points of the world appear in square pictures.

    Args:
        points: (n, 3) in metres.
        fovy_deg: the vertical field of view of the scene (``model.vis.global_.fovy``).
        cameras: one for each view.

    Returns:
        (views, n, 2): u to the right and v downwards, in [0, 1] inside the picture.
    """
    points = np.asarray(points, dtype=np.float64)
    focal = 0.5 / np.tan(np.deg2rad(fovy_deg) / 2)
    pictures = []
    for camera in cameras:
        position, forward, right, up = camera.axes()
        offset = points - position
        depth = offset @ forward
        u = 0.5 + focal * (offset @ right) / depth
        v = 0.5 - focal * (offset @ up) / depth
        pictures.append(np.stack([u, v], axis=-1))
    return np.stack(pictures)


def find_gl_backend() -> str:
    """Chooses the OpenGL library for off-screen rendering.

    Returns:
        The user's ``MUJOCO_GL`` if set; else ``"osmesa"`` or ``"egl"``, the first whose shared
        library can be opened. On other systems than Linux ``""``: MuJoCo brings its own.

    Raises:
        DependencyError: when there is none; the message says what to install.
    """
    requested = os.environ.get("MUJOCO_GL", "").strip().lower()
    if requested:
        return requested
    if not sys.platform.startswith("linux"):
        return ""
    for backend, libraries in _LINUX_LIBRARIES:
        for library in libraries:
            try:
                ctypes.CDLL(library)
            except OSError:
                continue
            return backend
    tried = ", ".join(names[0] for _, names in _LINUX_LIBRARIES)
    raise DependencyError(f"no off-screen OpenGL library found (tried {tried}): {_REMEDY}")


@functools.cache
def load_mujoco(render: bool = True) -> Any:
    """Imports ``mujoco`` with a usable OpenGL library and returns the module.

    Args:
        render: False where no picture will be drawn: then a missing library is no error.

    Raises:
        DependencyError: when ``mujoco`` is not installed, or no OpenGL library is.
    """
    try:
        backend = find_gl_backend()
    except DependencyError:
        if render:
            raise
        backend = ""
    if backend:
        os.environ["MUJOCO_GL"] = backend
    try:
        return importlib.import_module("mujoco")
    except Exception as error:  # a missing library shows as almost anything, by way of PyOpenGL
        raise DependencyError(
            f"importing mujoco with MUJOCO_GL={backend!r} failed ({error}): "
            f"install the simulator with `pip install 'comvla[sim]'`; if it is, {_REMEDY}"
        ) from error


@functools.cache
def _shared_gl_context() -> Any:
    """One OpenGL context for the process.

    Several OSMesa contexts in one process overwrite each other's resources and return garbage;
    several scenes inside one context do not. Its own size is irrelevant: scenes are drawn into
    off-screen buffers.
    """
    load_mujoco()
    backend = find_gl_backend()
    # By name and not by mujoco.GLContext: if somebody else imported mujoco before this module
    # could choose, that one wants a screen.
    offscreen = sys.platform.startswith("linux") and backend in ("osmesa", "egl")
    try:
        module = importlib.import_module(f"mujoco.{backend if offscreen else 'gl_context'}")
        context_class = getattr(module, "GLContext", None)
        if context_class is not None:
            context = context_class(64, 64)
            # Now and not earlier: the last handler registered is the first to run, and MuJoCo's
            # own, which ends EGL, has been registered by now.
            atexit.register(_close_everything)
            return context
    except Exception as error:  # each backend has exceptions of its own
        raise DependencyError(
            f"MUJOCO_GL={backend!r} gives no OpenGL context ({type(error).__name__}: {error}): "
            f"{_REMEDY}"
        ) from error
    raise DependencyError(
        f"MUJOCO_GL={backend!r} switches rendering off: unset it, or make the world with "
        "render=False"
    )


_open_renderers: weakref.WeakSet[Renderer] = weakref.WeakSet()


def _close_everything() -> None:
    """Frees OpenGL resources before the interpreter takes the libraries apart.

    Otherwise the contexts of MuJoCo print exceptions from ``__del__`` at the end of a program.
    """
    for renderer in list(_open_renderers):
        renderer.close()
    _shared_gl_context.cache_clear()


class Renderer:
    """Draws square pictures of one model from fixed cameras, cheaply.

    No shadows, reflections or multisampling; collision shapes (geom group 4) and sites are hidden.

    Args:
        model: a ``mujoco.MjModel``; its off-screen settings are changed.
        image_size: side of a picture in pixels.
        cameras: one for each view.

    Raises:
        DependencyError: when no OpenGL context can be had.
    """

    def __init__(
        self, model: Any, image_size: int, cameras: tuple[Camera, ...] = FAR_CAMERAS
    ) -> None:
        mujoco = load_mujoco()
        self._mujoco = mujoco
        self._model = model
        _shared_gl_context().make_current()
        model.vis.quality.offsamples = 0
        model.vis.global_.offwidth = model.vis.global_.offheight = image_size
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_50.value)
        self._scene = mujoco.MjvScene(model=model, maxgeom=2000)
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self._scene.flags[flag] = 0
        self._option = mujoco.MjvOption()
        self._option.geomgroup[4] = 0
        self._option.sitegroup[:] = 0
        self._rect = mujoco.MjrRect(0, 0, image_size, image_size)
        self._cameras = [self._free_camera(camera) for camera in cameras]
        self._upside_down = np.empty((image_size, image_size, 3), np.uint8)
        _open_renderers.add(self)

    def _free_camera(self, camera: Camera) -> Any:
        mujoco = self._mujoco
        free = mujoco.MjvCamera()
        free.type = mujoco.mjtCamera.mjCAMERA_FREE
        free.lookat[:] = camera.lookat
        free.distance = camera.distance_m
        free.azimuth = camera.azimuth_deg
        free.elevation = camera.elevation_deg
        return free

    def draw(self, data: Any) -> npt.NDArray[np.uint8]:
        """Pictures of the state in ``data`` (``mujoco.MjData``).

        Returns:
            (views, image_size, image_size, 3) uint8 RGB.
        """
        mujoco = self._mujoco
        if self._context is None:
            raise RuntimeError("the renderer is closed: make a new world")
        _shared_gl_context().make_current()
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        size = self._rect.width
        images = np.empty((len(self._cameras), size, size, 3), np.uint8)
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        for image, camera in zip(images, self._cameras, strict=True):
            mujoco.mjv_updateScene(
                self._model, data, self._option, None, camera, everything, self._scene
            )
            mujoco.mjr_render(self._rect, self._scene, self._context)
            mujoco.mjr_readPixels(self._upside_down, None, self._rect, self._context)
            image[:] = self._upside_down[::-1]
        return images

    def close(self) -> None:
        """Frees the OpenGL resources; harmless when repeated."""
        if self._context is not None:
            _shared_gl_context().make_current()
            self._context.free()
            self._context = None
