"""Simulated worlds behind one interface. Nothing heavy is imported before :func:`make` needs it."""

from __future__ import annotations

import importlib.util
from typing import TYPE_CHECKING

from comvla.errors import DependencyError

if TYPE_CHECKING:
    from comvla_sim.worlds.base import Task, World, WorldState

__all__ = ["Task", "World", "WorldState", "make", "names"]

_PREFIX = "metaworld:"
_LIBERO_PREFIX = "libero:"
_LIBERO_SUITES = ("libero_spatial", "libero_object", "libero_goal", "libero_10")
_IMAGE_SIZE = 128


def __getattr__(name: str) -> object:
    """``Task``, ``World`` and ``WorldState`` on first use: they need Gymnasium."""
    if name in ("Task", "World", "WorldState"):
        from comvla_sim.worlds import base

        return getattr(base, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def _require_simulator() -> None:
    missing = [n for n in ("gymnasium", "mujoco", "metaworld") if not importlib.util.find_spec(n)]
    if missing:
        raise DependencyError(
            f"the simulated worlds need {', '.join(missing)}: install `pip install 'comvla[sim]'`"
        )


def names() -> list[str]:
    """Every name that :func:`make` understands.

    Raises:
        DependencyError: when the simulator is not installed.
    """
    _require_simulator()
    from comvla_sim.worlds.single_task import task_names

    metaworld = (f"{_PREFIX}{name}" for name in task_names())
    return ["tabletop", *metaworld, *(f"{_LIBERO_PREFIX}{suite}" for suite in _LIBERO_SUITES)]


def make(name: str, *, image_size: int | None = None, render: bool = True) -> World:
    """Makes a world.

    Args:
        name: ``"tabletop"``; ``"metaworld:TASK"`` for a plain Meta-World task such as
            ``"metaworld:drawer-open-v3"``; ``"libero:SUITE"`` for a suite of LIBERO such as
            ``"libero:libero_spatial"``, with ``":plain"`` appended for cheaper pictures.
        image_size: side of a picture in pixels; None takes the world's own, 128 or LIBERO's 256.
        render: False saves the drawing (images are then black) and needs no OpenGL library.

    Raises:
        ValueError: for an unknown name; the message lists what exists.
        DependencyError: when the simulator is not installed, or nothing can draw.
    """
    if name.startswith(_LIBERO_PREFIX):
        return _make_libero(name, image_size, render)
    _require_simulator()
    image_size = _IMAGE_SIZE if image_size is None else image_size
    if name == "tabletop":
        from comvla_sim.worlds.tabletop import Tabletop

        return Tabletop(image_size=image_size, render=render)
    if name.startswith(_PREFIX):
        from comvla_sim.worlds.single_task import SingleTask, task_names

        if name.removeprefix(_PREFIX) in task_names():
            return SingleTask(name.removeprefix(_PREFIX), image_size=image_size, render=render)
    raise ValueError(f"unknown world {name!r}; there are: {', '.join(names())}")


def _make_libero(name: str, image_size: int | None, render: bool) -> World:
    """LIBERO needs neither Meta-World nor a MuJoCo of this process."""
    if not importlib.util.find_spec("gymnasium"):
        raise DependencyError(
            "the simulated worlds need gymnasium: install `pip install 'comvla[sim]'`"
        )
    suite, _, rendering = name.removeprefix(_LIBERO_PREFIX).partition(":")
    if suite not in _LIBERO_SUITES:
        raise ValueError(
            f"unknown world {name!r}; of LIBERO there are: "
            f"{', '.join(_LIBERO_PREFIX + known for known in _LIBERO_SUITES)}"
        )
    from comvla_sim.worlds.libero.world import FULL, IMAGE_SIZE, LiberoWorld

    return LiberoWorld(
        suite,
        image_size=IMAGE_SIZE if image_size is None else image_size,
        render=render,
        rendering=rendering or FULL,
    )
