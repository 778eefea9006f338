"""Several models in one server: robots choose by name, and metrics tell them apart."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import grpc
import httpx
import numpy as np
import pytest
from server_stubs import PATIENCE_S, STUB_INFO, Robot, StubCloud, message, payload

from comvla.v1 import policy_pb2
from comvla.v1.policy_pb2 import InferProgressiveHead, InferProgressiveRequest
from comvla_server.background import BackgroundServer
from comvla_server.engine import Engine
from comvla_server.model_names import MOST_MODELS, parse_models
from comvla_server.settings import ServerSettings, SettingsError
from comvla_server.settings_sources import resolve

PLACE_INFO = replace(STUB_INFO, name="placer", fingerprint="1ace")


def answering(value: float, info: object) -> StubCloud:
    cloud = StubCloud(info)  # type: ignore[arg-type]
    cloud.answer = lambda requests: [np.full((3, 2), value, np.float32) for _ in requests]
    return cloud


@pytest.fixture
def server() -> Iterator[BackgroundServer]:
    engines = {
        "pick": Engine(answering(1.0, STUB_INFO)),
        "place": Engine(answering(2.0, PLACE_INFO)),
    }
    with BackgroundServer(engines) as running:
        yield running


@pytest.fixture
def robot(server: BackgroundServer) -> Iterator[Robot]:
    with Robot(server.target) as client:
        yield client


def place(session: str = "robot", step: int = 0, **fields: object) -> policy_pb2.InferRequest:
    return message(session, step, model="place", model_fingerprint="1ace", **fields)


def test_robots_choose_by_name_and_the_first_is_the_default(robot: Robot) -> None:
    assert robot.infer(message()).actions[0] == 1.0
    assert robot.infer(message("a", model="pick")).actions[0] == 1.0
    assert robot.infer(place("b")).actions[0] == 2.0
    for name, fingerprint in (("", "f00d"), ("pick", "f00d"), ("place", "1ace")):
        request = policy_pb2.GetModelRequest(model=name)
        assert robot.stub.GetModel(request, timeout=PATIENCE_S).model_fingerprint == fingerprint


def test_one_session_may_ask_both(robot: Robot) -> None:
    assert robot.infer(message(step=0)).actions[0] == 1.0
    assert robot.infer(place(step=0)).actions[0] == 2.0


def test_a_payload_in_pieces_asks_by_name_too(robot: Robot) -> None:
    head = place(payload=b"")
    messages = [
        InferProgressiveRequest(head=InferProgressiveHead(request=head, window_s=5.0)),
        InferProgressiveRequest(piece=payload(3, "float32", STUB_INFO)),
    ]
    answer = robot.stub.InferProgressive(iter(messages), timeout=PATIENCE_S)
    assert answer.response.actions[0] == 2.0


def test_an_unknown_name_is_told_what_there_is(robot: Robot) -> None:
    code, words = robot.refused(message(model="push"))
    assert code is grpc.StatusCode.NOT_FOUND
    assert "pick, place" in words
    assert "'push'" in words
    with pytest.raises(grpc.RpcError) as caught:
        robot.stub.GetModel(policy_pb2.GetModelRequest(model="push"), timeout=PATIENCE_S)
    assert caught.value.code() is grpc.StatusCode.NOT_FOUND
    code, words = robot.refused(message(model="x" * 100_000))
    assert code is grpc.StatusCode.NOT_FOUND
    assert len(words) < 1000


def test_the_fingerprint_of_another_model_here_does_not_help(robot: Robot) -> None:
    assert robot.refused(message(model="place"))[0] is grpc.StatusCode.FAILED_PRECONDITION


def test_metrics_tell_models_apart_and_know_no_other_names(
    server: BackgroundServer, robot: Robot
) -> None:
    robot.infer(message())
    robot.infer(place())
    robot.infer(place(step=1))
    for number in range(20):
        robot.refused(message(model=f"guess-{number}"))
    text = httpx.get(f"{server.admin_url}/metrics", timeout=PATIENCE_S).text
    assert 'comvla_model_requests_total{model="pick",outcome="ok"} 1.0' in text
    assert 'comvla_model_requests_total{model="place",outcome="ok"} 2.0' in text
    assert 'comvla_model_queue_depth{model="place"} 0.0' in text
    assert 'comvla_requests_dropped_total{reason="unknown_model"} 20.0' in text
    assert "guess" not in text
    assert 'comvla_model_info{fingerprint="1ace",model="placer"' in text
    models = httpx.get(f"{server.admin_url}/v1/models", timeout=PATIENCE_S).json()["models"]
    assert [model["model"] for model in models] == ["pick", "place"]


def test_a_model_without_a_name_is_called_default_in_metrics() -> None:
    with BackgroundServer(Engine(StubCloud())) as server, Robot(server.target) as robot:
        robot.infer(message())
        text = httpx.get(f"{server.admin_url}/metrics", timeout=PATIENCE_S).text
        assert 'comvla_model_requests_total{model="default",outcome="ok"} 1.0' in text
        code, words = robot.refused(message(model="pick"))
    assert code is grpc.StatusCode.NOT_FOUND
    assert "one without a name" in words


@pytest.mark.parametrize(
    ("text", "models"),
    [
        ("mini", {"": "mini"}),
        ("/models/a,b", {"": "/models/a,b"}),
        ("/runs/lr=1e-4/last", {"": "/runs/lr=1e-4/last"}),
        ("./a=b", {"": "./a=b"}),
        ("hf://owner/name@v1", {"": "hf://owner/name@v1"}),
        ("a=mini", {"a": "mini"}),
        ("a=mini,b=/models/lr=3,x", {"a": "mini", "b": "/models/lr=3,x"}),
    ],
)
def test_what_names_models(text: str, models: dict[str, str]) -> None:
    assert parse_models(text) == models


@pytest.mark.parametrize("text", ["", " ", "a=mini,a=mini", "mini,a=mini", "a=", "a=1,b="])
def test_what_does_not(text: str) -> None:
    with pytest.raises(SettingsError, match="NAME=SOURCE"):
        ServerSettings(model=text)
    too_many = ",".join(f"m{i}=mini" for i in range(MOST_MODELS + 1))
    with pytest.raises(SettingsError, match="at most"):
        ServerSettings(model=too_many)


def test_models_are_given_one_by_one_or_together(tmp_path: object) -> None:
    import argparse
    from pathlib import Path

    from comvla_server.settings_flags import add_flags, settings_of

    parser = argparse.ArgumentParser()
    add_flags(parser)
    given = parser.parse_args(["--model", "a=mini", "--model", "b=/models/b"])
    expected = {"a": "mini", "b": "/models/b"}
    assert settings_of(given, {}).settings.models == expected
    alone = parser.parse_args(["--model", "mini"])
    assert settings_of(alone, {}).settings.models == {"": "mini"}
    in_environment = resolve({}, {"COMVLA_MODEL": "a=mini,b=/models/b"})
    assert in_environment.settings.models == expected
    file = Path(str(tmp_path)) / "comvla.toml"
    file.write_text('model = ["a=mini", "b=/models/b"]\n')
    assert resolve({}, {}, str(file)).settings.models == expected


def test_the_client_asks_by_name(server: BackgroundServer) -> None:
    from comvla.errors import HandshakeError
    from comvla_client import ComVLAClient

    options = {"budget": 4, "uplink": "jpeg-75"}
    with pytest.raises(HandshakeError, match=r"no such model: .*pick, place"):
        ComVLAClient(server.target, model="push", **options)  # type: ignore[arg-type]
