"""Simulated worlds behind one interface. Nothing heavy is imported before :func:`make` needs it."""

from __future__ import annotations

import importlib.util
from typing import TYPE_CHECKING

from comvla.errors import DependencyError

if TYPE_CHECKING:
    from comvla_sim.worlds.base import Task, World, WorldState

__all__ = ["Task", "World", "WorldState", "make", "names"]

_PREFIX = "metaworld:"


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

    return ["tabletop", *(f"{_PREFIX}{name}" for name in task_names())]


def make(name: str, *, image_size: int = 128, render: bool = True) -> World:
    """Makes a world.

    Args:
        name: ``"tabletop"``, or ``"metaworld:TASK"`` for a plain Meta-World task such as
            ``"metaworld:drawer-open-v3"``.
        image_size: side of a picture in pixels.
        render: False saves the drawing (images are then black) and needs no OpenGL library.

    Raises:
        ValueError: for an unknown name; the message lists what exists.
        DependencyError: when the simulator is not installed, or nothing can draw.
    """
    _require_simulator()
    if name == "tabletop":
        from comvla_sim.worlds.tabletop import Tabletop

        return Tabletop(image_size=image_size, render=render)
    if name.startswith(_PREFIX):
        from comvla_sim.worlds.single_task import SingleTask, task_names

        if name.removeprefix(_PREFIX) in task_names():
            return SingleTask(name.removeprefix(_PREFIX), image_size=image_size, render=render)
    raise ValueError(f"unknown world {name!r}; there are: {', '.join(names())}")
