"""A real policy with random weights, and real servers of it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from comvla_server.background import BackgroundServer
from comvla_server.engine import Engine
from comvla_vla import CloudModel, EdgeModel, random_policy, save_policy
from comvla_vla.random import unit_statistics


@pytest.fixture(scope="session")
def policy() -> tuple[EdgeModel, CloudModel]:
    """Both halves of one policy, small and without skill."""
    return random_policy(seed=0)


@pytest.fixture(scope="session")
def checkpoint(
    policy: tuple[EdgeModel, CloudModel], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """The same policy as a folder."""
    folder = tmp_path_factory.mktemp("policy") / "random"
    edge, cloud = policy
    save_policy(folder, edge.net, cloud.net, edge.prompt.tokenizer, unit_statistics(edge.config))
    return folder


@pytest.fixture(scope="module")
def server(policy: tuple[EdgeModel, CloudModel]) -> Iterator[BackgroundServer]:
    """A server of that policy on free ports."""
    with BackgroundServer(Engine(policy[1])) as running:
        yield running
