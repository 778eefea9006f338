"""A real policy with random weights, and real servers of it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from comvla_client import fleet, fleet_aio, revival, revival_aio, roster
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


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """No call takes long enough to be suspected: for tests that count what a server was asked.

    By default a call of more than 50 ms is looked into, and on a machine that is busy with something
    else any call may be.
    """
    for module in (fleet, fleet_aio, revival, revival_aio, roster):
        monkeypatch.setattr(module, "PATIENCE_S", 20.0)


@pytest.fixture
def pings_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """A call is suspected as soon as ever, but the ping that follows may take five times as long.

    A server that answers its pings and takes longer than that for the call itself is only slow.
    """
    usual_s, times = revival.PATIENCE_S, revival.USUAL_TIMES
    suspects_after = property(lambda pace: max(usual_s, times * pace.usual_s))
    monkeypatch.setattr(revival.Pace, "patience_s", suspects_after)
    for module in (fleet, fleet_aio, revival, revival_aio):
        monkeypatch.setattr(module, "PATIENCE_S", 5 * usual_s)
