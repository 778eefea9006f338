"""The admin surface behind its own token, and over TLS."""

from __future__ import annotations

import ssl
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from authorities import Authority
from server_stubs import PATIENCE_S, Robot, StubCloud, eventually, message

from comvla_server.background import BackgroundServer
from comvla_server.engine import Engine
from comvla_server.identity import Identity
from comvla_server.settings import ServerSettings
from comvla_server.tokens import TokenLine, TokensError, new_token

OPERATOR, ARM = new_token(), new_token()
SHUT = ("/metrics", "/v1/model", "/v1/sessions", "/openapi.json", "/nowhere")


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    """Tokens of robots, and of operators."""
    files = {}
    for name, token in (("tokens_file", ARM), ("admin_tokens_file", OPERATOR)):
        files[name] = tmp_path / name
        files[name].touch(mode=0o600)
        files[name].write_text(f"{TokenLine.of(Identity('somebody'), token)}\n")
    return files


@pytest.fixture
def server(cloud: StubCloud, files: dict[str, Path]) -> Iterator[BackgroundServer]:
    settings = ServerSettings(**files, reload_interval_s=0.02)
    with BackgroundServer(Engine(cloud), settings) as running:
        yield running


@pytest.fixture
def http(server: BackgroundServer) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=server.admin_url, timeout=PATIENCE_S) as client:
        yield client


def bearer(token: str) -> dict[str, str]:
    return {"authorization": f"Bearer {token}"}


@pytest.mark.parametrize("path", ["/healthz", "/readyz"])
def test_probes_need_no_token(http: httpx.Client, path: str) -> None:
    assert http.get(path).status_code == 200


@pytest.mark.parametrize("path", SHUT)
def test_everything_else_does(http: httpx.Client, path: str) -> None:
    for headers in ({}, bearer(ARM), {"authorization": "Bearer"}, {"authorization": OPERATOR}):
        refused = http.get(path, headers=headers)
        assert refused.status_code == 401
        assert refused.headers["www-authenticate"].startswith("Basic")
        assert "comvla-server token new" in refused.text
    assert http.get(path, headers=bearer(OPERATOR)).status_code == (
        404 if path == "/nowhere" else 200
    )


@pytest.mark.parametrize("path", ["//metrics", "/healthz/../metrics", "/healthz%2f..%2fmetrics"])
def test_no_spelling_of_a_path_goes_round_it(http: httpx.Client, path: str) -> None:
    answer = http.request("GET", httpx.URL(str(http.base_url), raw_path=path.encode()))
    assert answer.status_code in (401, 404)
    assert "comvla_" not in answer.text


def test_a_token_answers_under_any_name(http: httpx.Client) -> None:
    headers = bearer(OPERATOR) | {"host": "gateway.example"}
    assert http.get("/v1/sessions", headers=headers).status_code == 200


def test_two_headers_are_no_token(http: httpx.Client) -> None:
    twice = [("authorization", f"Bearer {OPERATOR}"), ("authorization", f"Bearer {ARM}")]
    assert http.get("/metrics", headers=twice).status_code == 401


def test_a_browser_gives_the_token_as_a_password(http: httpx.Client) -> None:
    assert http.get("/v1/model", auth=("me", OPERATOR)).status_code == 200
    assert http.get("/v1/model", auth=("me", ARM)).status_code == 401
    for broken in ("Basic", "Basic !", "Basic é"):
        answer = http.get("/v1/model", headers={"authorization": broken.encode("latin-1")})
        assert answer.status_code == 401


def test_an_operators_token_does_not_move_a_robot(server: BackgroundServer) -> None:
    with Robot(server.target) as robot:
        for token, refused in ((OPERATOR, True), (ARM, False)):
            metadata = (("authorization", f"Bearer {token}"),)
            call = robot.stub.Infer.future(message(), timeout=60, metadata=metadata)
            assert (call.exception() is not None) is refused


def test_operators_come_and_go_without_a_restart(
    http: httpx.Client, files: dict[str, Path]
) -> None:
    fresh = new_token()
    files["admin_tokens_file"].write_text(f"{TokenLine.of(Identity('new'), fresh)}\n")
    eventually(lambda: http.get("/metrics", headers=bearer(fresh)).status_code == 200)
    assert http.get("/metrics", headers=bearer(OPERATOR)).status_code == 401


def test_metrics_can_be_left_open(cloud: StubCloud, files: dict[str, Path]) -> None:
    with BackgroundServer(Engine(cloud), ServerSettings(**files, open_metrics=True)) as server:
        assert httpx.get(f"{server.admin_url}/metrics", timeout=PATIENCE_S).status_code == 200
        assert httpx.get(f"{server.admin_url}/v1/model", timeout=PATIENCE_S).status_code == 401


def test_an_unreadable_tokens_file_stops_the_start(
    cloud: StubCloud, files: dict[str, Path]
) -> None:
    files["admin_tokens_file"].write_text("hello")
    with pytest.raises(TokensError, match="admin_tokens_file, line 1"):
        BackgroundServer(Engine(cloud), ServerSettings(**files)).start()


def test_over_tls_the_same(cloud: StubCloud, files: dict[str, Path], tmp_path: Path) -> None:
    authority = Authority()
    certificate, key = authority.issue("server").write(tmp_path, "server")
    settings = ServerSettings(
        **files, tls_certificate=certificate, tls_key=key, tls_client_ca=authority.write(tmp_path)
    )
    context = ssl.create_default_context(cadata=authority.pem.decode())
    with BackgroundServer(Engine(cloud), settings) as server:
        assert server.admin_url.startswith("https://127.0.0.1:")
        # Operators show a token; certificates are asked of robots only.
        with httpx.Client(base_url=server.admin_url, verify=context, timeout=PATIENCE_S) as http:
            assert http.get("/healthz").status_code == 200
            assert http.get("/metrics").status_code == 401
            assert http.get("/metrics", headers=bearer(OPERATOR)).status_code == 200
        with pytest.raises(httpx.ConnectError):
            httpx.get(f"{server.admin_url}/healthz", timeout=PATIENCE_S)
        with pytest.raises(httpx.RemoteProtocolError):
            httpx.get(server.admin_url.replace("https", "http"))


def test_the_admin_surface_can_listen_elsewhere(cloud: StubCloud) -> None:
    settings = ServerSettings(host="0.0.0.0", admin_host="127.0.0.1", insecure=True)
    with BackgroundServer(Engine(cloud), settings) as server:
        assert server.admin_url.startswith("http://127.0.0.1:")
        assert server.target.startswith("0.0.0.0:")
