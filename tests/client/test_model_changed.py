"""The server's model is replaced while a robot runs: who can go on does, who cannot is told what to do."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from client_stubs import (
    INFO,
    NARROW,
    WORDS,
    StubEdge,
    StubTransport,
    fault,
    model_response,
    observation,
)
from test_image_uplink import AsyncSeeingTransport, SeeingTransport, robot

from comvla.errors import HandshakeError, ModelChangedError
from comvla_client import AsyncComVLAClient, ComVLAClient
from comvla_client.transport import TransportError

OBS = observation()
ARM: dict[str, Any] = {"edge": StubEdge(), "link": NARROW, "budget": 4, "deadline_s": 20.0}
NEW = replace(INFO, name="next", fingerprint="ne31")
GONE = fault("FAILED_PRECONDITION", "server runs next with fingerprint 'ne31'")


def replaced(transport: SeeingTransport, **changes: Any) -> None:
    """Puts another model into a server."""
    transport.info = replace(NEW, **changes)
    codings = list(transport.model.image_codings)
    transport.model = model_response(transport.info)
    transport.model.image_codings.extend(codings)
    transport.script = [GONE]


def test_a_robot_with_an_edge_half_is_told_to_load_another() -> None:
    with (
        ComVLAClient(StubTransport(GONE), **ARM) as client,
        pytest.raises(ModelChangedError, match="load the edge half of the checkpoint"),
    ):
        client.step(OBS, WORDS)
    assert issubclass(ModelChangedError, HandshakeError)


def test_a_robot_whose_edge_half_fits_the_new_model_too_shakes_hands_with_it() -> None:
    model = model_response(NEW)
    model.edge_fingerprints.append(INFO.fingerprint)
    client = ComVLAClient(StubTransport(model=model), **ARM)
    assert client.step(OBS, WORDS).source == "cloud"
    assert client.info.fingerprint == INFO.fingerprint
    del model.edge_fingerprints[:]
    with pytest.raises(HandshakeError, match="the weights do not"):
        ComVLAClient(StubTransport(model=model), **ARM)


def test_a_robot_without_a_half_of_its_own_learns_the_new_model_and_holds_once() -> None:
    transport = SeeingTransport()
    with robot(transport) as client:
        before = client.step(OBS, WORDS, 20.0).actions
        replaced(transport)
        chunk = client.step(OBS, WORDS, 20.0)
        assert chunk.report.fallback_reason == "rejected"
        assert "another model now, next" in chunk.report.detail
        # The gripper keeps its grip.
        assert chunk.actions[0][-1] == before[-1][-1]
        assert client.info == NEW
        assert client.step(OBS, WORDS, 20.0).source == "cloud"
    assert transport.requests[-1].model_fingerprint == "ne31"


def test_a_new_model_that_would_move_the_robot_otherwise_is_not_taken() -> None:
    transport = SeeingTransport()
    with robot(transport) as client:
        client.step(OBS, WORDS, 20.0)
        replaced(transport, control_period_s=0.1)
        with pytest.raises(ModelChangedError, match="control_period_s"):
            client.step(OBS, WORDS, 20.0)


def test_a_server_that_is_gone_when_it_is_asked_again_raises_what_it_said(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    transport = SeeingTransport()
    with robot(transport) as client:
        client.step(OBS, WORDS, 20.0)
        replaced(transport)

        def gone(timeout_s: float) -> Any:
            raise TransportError("UNAVAILABLE", "gone")

        monkeypatch.setattr(transport, "get_model", gone)
        with pytest.raises(ModelChangedError):
            client.step(OBS, WORDS, 20.0)


async def test_the_asyncio_client_learns_too() -> None:
    transport = AsyncSeeingTransport()
    async with AsyncComVLAClient(transport, uplink="jpeg-75", deadline_s=20.0) as client:
        assert (await client.step(OBS, WORDS, 30.0)).source == "cloud"
        replaced(transport.inner)
        assert (await client.step(OBS, WORDS, 30.0)).report.fallback_reason == "rejected"
        chunk = await client.step(OBS, WORDS, 30.0)
    assert chunk.source == "cloud"
    assert np.isfinite(chunk.actions).all()
