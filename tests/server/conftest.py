"""Fixtures of the server's tests."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from server_stubs import Robot, StubCloud

from comvla_server.background import BackgroundServer
from comvla_server.engine import Engine


@pytest.fixture
def cloud() -> Iterator[StubCloud]:
    """A stub that no test leaves waiting."""
    stub = StubCloud()
    yield stub
    stub.release()


@pytest.fixture
def server(cloud: StubCloud) -> Iterator[BackgroundServer]:
    """A real server on free ports, warm, its warm-up forgotten by the stub."""
    with BackgroundServer(Engine(cloud)) as running:
        cloud.forget()
        yield running
        cloud.release()


@pytest.fixture
def robot(server: BackgroundServer) -> Iterator[Robot]:
    """A client of that server."""
    with Robot(server.target) as client:
        yield client
