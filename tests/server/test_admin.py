"""The admin surface of a running server."""

from __future__ import annotations

from collections.abc import Iterator

import httpx
import pytest
from server_stubs import PATIENCE_S, STUB_INFO, Robot, StubCloud, message

from comvla_server.background import BackgroundServer
from comvla_server.batcher import Batcher


@pytest.fixture
def http(server: BackgroundServer) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=server.admin_url, timeout=PATIENCE_S) as client:
        yield client


def test_model_is_described(http: httpx.Client) -> None:
    model = http.get("/v1/model").json()
    assert model["run_options"] == []
    assert model["name"] == STUB_INFO.name
    assert model["fingerprint"] == STUB_INFO.fingerprint
    assert model["quantizations"] == ["float32", "float16", "int8", "int4"]
    assert model["max_batch"] == 8


def test_sessions_are_listed_newest_first(
    http: httpx.Client, robot: Robot, cloud: StubCloud
) -> None:
    assert http.get("/v1/sessions").json() == {"count": 0, "sessions": []}
    for session, step, k in (("a", 0, 2), ("a", 1, 4), ("b", 9, 3)):
        robot.infer(message(session, step, k=k))
    cloud.forget()
    cloud.hold()
    running = robot.send(message("c", 1))
    cloud.wait_until_running()
    listing = http.get("/v1/sessions").json()
    assert listing["count"] == 3
    c, b, a = listing["sessions"]
    assert (c["session_id"], c["running"], c["tokens_used"]) == ("c", True, None)
    assert (b["session_id"], b["running"], b["newest_step"]) == ("b", False, 9)
    assert (a["answers"], a["newest_step"], a["tokens_used"]) == (2, 1, 4)
    assert a["idle_s"] >= b["idle_s"] >= 0.0
    assert len(http.get("/v1/sessions", params={"limit": 1}).json()["sessions"]) == 1
    assert http.get("/v1/sessions", params={"limit": 0}).status_code == 422
    cloud.release()
    running.result()


def test_metrics_are_prometheus_text_at_exactly_that_path(http: httpx.Client) -> None:
    answer = http.get("/metrics")
    assert answer.status_code == 200  # no redirect to /metrics/
    assert answer.headers["content-type"].startswith("text/plain")
    assert "comvla_model_info{" in answer.text
    open_metrics = http.get("/metrics", headers={"accept": "application/openmetrics-text"})
    assert open_metrics.headers["content-type"].startswith("application/openmetrics-text")
    assert open_metrics.text.endswith("# EOF\n")


def test_every_path_is_in_the_open_api_description(http: httpx.Client) -> None:
    paths = http.get("/openapi.json").json()["paths"]
    read = {
        "/healthz",
        "/readyz",
        "/v1/model",
        "/v1/models",
        "/v1/sessions",
        "/v1/fleet/tokens",
        "/events",
        "/metrics",
    }
    assert set(paths) == read | {"/v1/models/swap"}
    changing = {path for path, operations in paths.items() if set(operations) != {"get"}}
    assert changing == {"/v1/models/swap"}


def test_a_server_whose_dispatcher_died_asks_to_be_restarted(
    http: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert http.get("/healthz").json() == {"status": "ok"}
    monkeypatch.setattr(Batcher, "alive", False)
    answer = http.get("/healthz")
    assert answer.status_code == 503
    assert "restart" in answer.json()["status"]


async def test_model_and_sessions_are_unavailable_while_loading(cloud: StubCloud) -> None:
    from comvla_server.engine import Engine
    from comvla_server.server import Server

    server = Server(Engine(cloud))
    await server.bind()
    try:
        async with httpx.AsyncClient(base_url=server.admin_url, timeout=PATIENCE_S) as http:
            for path in ("/v1/model", "/v1/sessions"):
                answer = await http.get(path)
                assert answer.status_code == 503
                assert "still loading" in answer.json()["detail"]
            assert (await http.get("/healthz")).status_code == 200
            assert "comvla_server_ready 0.0" in (await http.get("/metrics")).text
    finally:
        await server.stop()


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("localhost", 200),
        ("LOCALHOST:8080", 200),
        ("127.0.0.1:1", 200),
        ("[::1]:8080", 200),
        ("rebound.example", 421),
        ("localhost.rebound.example:8080", 421),
        ("user@rebound.example", 421),
        ("192.0.2.1", 421),
        ("", 421),
        ("[", 421),
    ],
)
def test_a_name_that_was_led_here_reads_nothing(http: httpx.Client, host: str, status: int) -> None:
    assert http.get("/v1/sessions", headers={"host": host}).status_code == status


@pytest.mark.parametrize("path", ["/docs", "/docs/oauth2-redirect", "/redoc"])
def test_no_page_loads_scripts_of_other_hosts(http: httpx.Client, path: str) -> None:
    assert http.get(path).status_code == 404
    assert "/v1/model" in http.get("/openapi.json").json()["paths"]
    assert 'href="/docs"' not in http.get("/").text
