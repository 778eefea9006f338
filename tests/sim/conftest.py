"""What several tests of the simulation share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch

from comvla_sim import worlds
from comvla_sim.worlds import World
from comvla_vla import CloudModel, EdgeModel, random_policy


@pytest.fixture(scope="module")
def policy() -> Iterator[tuple[EdgeModel, CloudModel]]:
    """Both halves, with random weights."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # so small a model only waits for its threads
    yield random_policy(seed=0)
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def long_world() -> Iterator[World]:
    """Episodes as long as they are."""
    world = worlds.make("tabletop")
    yield world
    world.close()
