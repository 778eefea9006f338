"""LIBERO worlds whose simulator is a stand-in process."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from comvla_sim.worlds.libero.environment import CHILD
from comvla_sim.worlds.libero.launch import Launch
from comvla_sim.worlds.libero.process import SimulatorProcess
from comvla_sim.worlds.libero.world import LiberoWorld

FAKE = Path(__file__).with_name("libero_fake_child.py")
SIZE = 16


def fake_command(behaviour: str = "good") -> list[str]:
    """The command line of a fake simulator."""
    return [sys.executable, str(FAKE), str(CHILD.parent), behaviour, str(SIZE)]


def fake_process(behaviour: str = "good", **timeouts: float) -> SimulatorProcess:
    """A running fake simulator."""
    return SimulatorProcess(fake_command(behaviour), os.environ, **timeouts)


def fake_world(behaviour: str = "good", suite: str = "libero_spatial") -> LiberoWorld:
    """A world around a fake simulator."""
    launch = Launch(fake_command(behaviour), os.environ, "stand-in")
    return LiberoWorld(suite, image_size=SIZE, launch=launch)
