"""A model is replaced while robots use it: no call fails, and whatever goes wrong leaves the old one serving."""

from __future__ import annotations

import gc
import json
import os
import shutil
import signal
import threading
import weakref
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from http.client import HTTPConnection, RemoteDisconnected
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any, ClassVar

import grpc
import httpx
import numpy as np
import pytest
from server_stubs import PATIENCE_S, STUB_INFO, Robot, StubCloud, eventually, message

from comvla.errors import CheckpointError
from comvla.model_info import ModelInfo
from comvla.v1 import policy_pb2
from comvla_server import cli
from comvla_server.background import BackgroundServer
from comvla_server.engine import Engine
from comvla_server.identity import MAY_SWAP, Identity
from comvla_server.model_loading import Candidate
from comvla_server.server import Server
from comvla_server.settings import ServerSettings
from comvla_server.tokens import TokenLine

OPERATOR, PROMETHEUS = "cvt_operator", "cvt_prometheus"
OTHER = replace(STUB_INFO, fingerprint="beef")
WIDER = replace(STUB_INFO, fingerprint="cafe", token_dim=12, tower_dims=(6, 6))


class StubLoader:
    """Checkpoints by name; a source that is a cloud half itself is loaded as it is."""

    def __init__(self, **clouds: StubCloud) -> None:
        self.clouds = {"first": StubCloud(), **clouds}
        self.edges: dict[str, str | None] = dict.fromkeys(self.clouds, "same eyes")
        self.available: int | None = 10**9
        self.breaks: Exception | None = None

    def inspect(self, source: str) -> Candidate:
        if source not in self.clouds:
            raise CheckpointError(f"there is no checkpoint {source}: correct the path")
        info = self.clouds[source].info
        return Candidate(source, info, 1000, self.available, self.edges[source])

    def load(self, source: str) -> Engine:
        if self.breaks is not None:
            raise self.breaks
        return Engine(self.clouds[source], edge_identity=self.edges[source])


def answering(value: float, info: ModelInfo = STUB_INFO) -> StubCloud:
    """A model that says the same to everybody, so that a test can tell who answered."""
    cloud = StubCloud(info)
    cloud.answer = lambda requests: [
        np.full((info.action_horizon, info.action_dim), value, np.float32) for _ in requests
    ]
    return cloud


@pytest.fixture
def loader() -> StubLoader:
    return StubLoader(
        first=answering(1.0),
        again=answering(2.0),
        tuned=answering(3.0, OTHER),
        wider=answering(4.0, WIDER),
    )


@pytest.fixture
def tokens(tmp_path: Path) -> Path:
    path = tmp_path / "admin-tokens"
    lines = [
        TokenLine.of(Identity("operator", rights=frozenset([MAY_SWAP])), OPERATOR),
        TokenLine.of(Identity("prometheus"), PROMETHEUS),
    ]
    path.write_text("".join(f"{line}\n" for line in lines))
    path.chmod(0o600)
    return path


@pytest.fixture
def server(loader: StubLoader, tokens: Path) -> Iterator[BackgroundServer]:
    with BackgroundServer(
        lambda: loader.load("first"),
        ServerSettings(admin_tokens_file=tokens),
        sources={"": "first"},
        loader=loader,
    ) as running:
        yield running
        for cloud in loader.clouds.values():
            cloud.release()


def swap(
    server: BackgroundServer, source: str, token: str = OPERATOR, **order: Any
) -> httpx.Response:
    return httpx.post(
        f"{server.admin_url}/v1/models/swap",
        json={"source": source, **order},
        headers={"Authorization": f"Bearer {token}"},
        timeout=PATIENCE_S,
    )


def served(server: BackgroundServer) -> dict[str, Any]:
    answer = httpx.get(
        f"{server.admin_url}/v1/models",
        headers={"Authorization": f"Bearer {PROMETHEUS}"},
        timeout=PATIENCE_S,
    )
    found: dict[str, Any] = answer.json()
    return found


def value_of(response: policy_pb2.InferResponse) -> float:
    return float(response.actions[0])


def test_no_call_fails_and_the_new_model_answers(
    server: BackgroundServer, loader: StubLoader
) -> None:
    stop, failures, seen = threading.Event(), [], []

    def drive(number: int) -> None:
        with Robot(server.target) as robot:
            step = 0
            while not stop.is_set():
                try:
                    seen.append(value_of(robot.infer(message(f"robot-{number}", step))))
                except grpc.RpcError as error:
                    failures.append(error)
                step += 1

    with ThreadPoolExecutor(4) as pool:
        robots = [pool.submit(drive, number) for number in range(4)]
        eventually(lambda: len(seen) > 20)
        for source in ("again", "first", "again"):
            answer = swap(server, source)
            assert answer.status_code == 200, answer.text
            assert answer.json()["swapped"]
        before = len(seen)
        eventually(lambda: len(seen) > before + 20)
        stop.set()
        for robot in robots:
            robot.result(PATIENCE_S)
    assert failures == []
    assert set(seen) == {1.0, 2.0}
    assert set(seen[-10:]) == {2.0}


def test_a_call_under_way_is_finished_by_the_old_model(
    server: BackgroundServer, loader: StubLoader
) -> None:
    old = loader.clouds["first"]
    old.forget()
    old.hold()
    with Robot(server.target) as robot, ThreadPoolExecutor(1) as pool:
        running = robot.send(message("early"))
        old.wait_until_running()
        # The model's thread is one for all, so the old pass has to end before the new model's first.
        swapping = pool.submit(swap, server, "again")
        eventually(lambda: served(server)["models"][0]["source"] == "again")
        late = robot.send(message("late"))
        old.release()
        assert value_of(running.result(PATIENCE_S)) == 1.0
        assert value_of(late.result(PATIENCE_S)) == 2.0
        report = swapping.result(PATIENCE_S).json()
    assert report["swapped"]


def test_the_old_engine_is_let_go(tokens: Path) -> None:
    kept: list[weakref.ref[Engine]] = []

    class Fresh(StubLoader):
        def load(self, source: str) -> Engine:
            engine = Engine(answering(5.0))
            kept.append(weakref.ref(engine))
            return engine

    loader = Fresh()
    with (
        BackgroundServer(
            lambda: loader.load("first"),
            ServerSettings(admin_tokens_file=tokens),
            sources={"": "first"},
            loader=loader,
        ) as server,
        Robot(server.target) as robot,
    ):
        robot.infer(message())
        assert swap(server, "first").json()["freed"] is True
        assert kept[0]() is None
        assert kept[1]() is not None
        assert robot.infer(message(step=1))


def test_robots_with_the_same_edge_half_go_on(server: BackgroundServer) -> None:
    with Robot(server.target) as robot:
        report = swap(server, "tuned").json()
        assert (report["robots"], report["before"], report["after"]) == (
            "compatible",
            "f00d",
            "beef",
        )
        old_half = robot.infer(message("old"))
        assert value_of(old_half) == 3.0
        assert old_half.model_fingerprint == "f00d"
        assert robot.infer(message("new", model_fingerprint="beef")).model_fingerprint == "beef"
        described = robot.stub.GetModel(policy_pb2.GetModelRequest(), timeout=PATIENCE_S)
    assert described.model_fingerprint == "beef"
    assert list(described.edge_fingerprints) == ["f00d"]
    metrics = httpx.get(
        f"{server.admin_url}/metrics",
        headers={"Authorization": f"Bearer {PROMETHEUS}"},
        timeout=PATIENCE_S,
    ).text
    assert 'comvla_model_info{fingerprint="beef"' in metrics
    assert 'fingerprint="f00d"' not in metrics


@pytest.mark.parametrize("edge", ["other eyes", None])
def test_a_model_that_robots_could_not_work_with_is_refused(
    server: BackgroundServer, loader: StubLoader, edge: str | None
) -> None:
    loader.edges["tuned"] = edge
    for source, words in (("tuned", "the weights do not"), ("wider", "token_dim")):
        answer = swap(server, source)
        assert answer.status_code == 409
        assert words in answer.json()["detail"]
        assert "--new-edge" in answer.json()["detail"]
    with Robot(server.target) as robot:
        assert value_of(robot.infer(message())) == 1.0
        assert swap(server, "wider", new_edge=True).json()["robots"] == "new_edge"
        code, words = robot.refused(message(step=1))
    assert code is grpc.StatusCode.FAILED_PRECONDITION
    assert "load the edge half of the same checkpoint" in words


def test_checking_replaces_nothing_and_says_what_it_takes(server: BackgroundServer) -> None:
    report = swap(server, "again", check=True).json()
    assert (report["needed_bytes"], report["available_bytes"]) == (1000, 10**9)
    assert report["swapped"] is False
    assert served(server)["models"][0]["source"] == "first"


def test_whatever_goes_wrong_leaves_the_old_one_serving(
    server: BackgroundServer, loader: StubLoader
) -> None:
    with Robot(server.target) as robot:

        def still_serves(step: int) -> None:
            assert value_of(robot.infer(message(step=step))) == 1.0

        answer = swap(server, "nowhere")
        assert answer.status_code == 422
        assert "there is no checkpoint nowhere" in answer.json()["detail"]
        still_serves(0)
        answer = swap(server, "again", model="unheard-of")
        assert answer.status_code == 404
        assert "one without a name" in answer.json()["detail"]
        loader.available = 10
        answer = swap(server, "again")
        assert answer.status_code == 507
        assert "1e-06 GB of memory beside the model" in answer.json()["detail"]
        loader.available = None
        loader.breaks = RuntimeError("disk on fire")
        answer = swap(server, "again")
        assert answer.status_code == 422
        assert "disk on fire" in answer.json()["detail"]
        still_serves(1)
        loader.breaks = None
        loader.clouds["again"].answer = lambda requests: [np.full((1, 1), np.nan, np.float32)]
        answer = swap(server, "again")
        assert answer.status_code == 422
        assert "shape" in answer.json()["detail"]
        still_serves(2)
        assert swap(server, "first").json()["swapped"], (
            "a later swap is not in the way of an earlier"
        )


def test_sessions_stay_their_robots_and_go_on(server: BackgroundServer) -> None:
    with Robot(server.target) as robot:
        assert value_of(robot.infer(message(step=4))) == 1.0
        swap(server, "again")
        code, words = robot.refused(message(step=3))
        assert code is grpc.StatusCode.ABORTED
        assert "superseded by step 4" in words
        assert value_of(robot.infer(message(step=4))) == 2.0, "a repeat is computed again"
        assert value_of(robot.infer(message(step=5))) == 2.0
    registry = server.server.metrics.registry
    assert registry.get_sample_value("comvla_unanswered_steps_total") == 0
    (session,) = _sessions(server)
    assert (session["newest_step"], session["answers"]) == (5, 2)


def _sessions(server: BackgroundServer) -> list[dict[str, Any]]:
    answer = httpx.get(
        f"{server.admin_url}/v1/sessions",
        headers={"Authorization": f"Bearer {PROMETHEUS}"},
        timeout=PATIENCE_S,
    )
    found: list[dict[str, Any]] = answer.json()["sessions"]
    return found


def test_one_swap_at_a_time(server: BackgroundServer, loader: StubLoader) -> None:
    loader.clouds["again"].hold()
    with ThreadPoolExecutor(1) as pool:
        first = pool.submit(swap, server, "again")
        loader.clouds["again"].wait_until_running()
        answer = swap(server, "again")
        assert answer.status_code == 409
        assert "warming up" in answer.json()["detail"]
        assert "warming up" in served(server)["swap"]
        with Robot(server.target) as robot:
            assert value_of(robot.infer(message())) == 1.0, "the old one answers meanwhile"
        loader.clouds["again"].release()
        assert first.result(PATIENCE_S).json()["swapped"]


def test_only_operators_may(server: BackgroundServer, loader: StubLoader) -> None:
    assert swap(server, "again", "cvt_nobody").status_code == 401
    answer = swap(server, "again", PROMETHEUS)
    assert answer.status_code == 403
    assert "--may-swap" in answer.json()["detail"]
    url = f"{server.admin_url}/v1/models/swap"
    # A browser that knows the operator's password must not be led to do it by another page.
    by_browser = httpx.post(
        url, json={"source": "again"}, auth=("operator", OPERATOR), timeout=PATIENCE_S
    )
    assert by_browser.status_code == 403
    as_text = httpx.post(
        url,
        content='{"source": "again"}',
        headers={"Authorization": f"Bearer {OPERATOR}", "Content-Type": "text/plain"},
        timeout=PATIENCE_S,
    )
    assert as_text.status_code == 422
    with BackgroundServer(Engine(loader.clouds["first"]), loader=loader) as open_server:
        answer = swap(open_server, "again")
        assert answer.status_code == 403
        assert "--admin-tokens-file" in answer.json()["detail"]


def begin_order(server: BackgroundServer, token: str, announced: int) -> HTTPConnection:
    """An order of which the head is sent, and nothing else."""
    connection = HTTPConnection("127.0.0.1", server.server.admin_port, timeout=PATIENCE_S)
    connection.putrequest("POST", "/v1/models/swap")
    connection.putheader("Authorization", f"Bearer {token}")
    connection.putheader("Content-Type", "application/json")
    connection.putheader("Content-Length", str(announced))
    connection.endheaders()
    return connection


def test_an_order_is_not_read_before_it_is_known_who_sends_it(server: BackgroundServer) -> None:
    for token, status in (("cvt_nobody", 401), (PROMETHEUS, 403)):
        connection = begin_order(server, token, 10**9)
        assert connection.getresponse().status == status
        connection.close()


def test_an_order_is_read_up_to_a_size(server: BackgroundServer) -> None:
    assert swap(server, "a" * 20_000).status_code == 413
    connection = begin_order(server, OPERATOR, 10**9)
    connection.send(b" " * 20_000)
    assert connection.getresponse().status == 413
    connection.close()


def test_an_order_has_to_arrive_in_time(loader: StubLoader, tokens: Path) -> None:
    settings = ServerSettings(admin_tokens_file=tokens, request_timeout_s=0.2)
    with (
        BackgroundServer(lambda: loader.load("first"), settings, loader=loader) as server,
        # The server may be out of patience while the head is still being sent.
        pytest.raises((RemoteDisconnected, ConnectionError)),
    ):
        begin_order(server, OPERATOR, 100).getresponse()


@pytest.mark.parametrize(
    "order", [{}, {"source": ""}, {"source": 3}, {"source": "again", "force": True}, [], None]
)
def test_an_order_that_makes_no_sense(server: BackgroundServer, order: Any) -> None:
    answer = httpx.post(
        f"{server.admin_url}/v1/models/swap",
        json=order,
        headers={"Authorization": f"Bearer {OPERATOR}"},
        timeout=PATIENCE_S,
    )
    assert answer.status_code == 422


def test_the_command_asks_and_tells(
    server: BackgroundServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    token = tmp_path / "operator.token"
    token.write_text(OPERATOR + "\n")
    where = ["--admin", server.admin_url, "--token-file", str(token)]
    assert cli.main(["swap", "again", *where, "--check"]) == 0
    assert capsys.readouterr().out.startswith("checked only: f00d -> f00d: the same model")
    assert cli.main(["swap", "tuned", *where, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["robots"] == "compatible"
    assert cli.main(["swap", "nowhere", *where]) == 2
    assert "nothing was replaced: 'nowhere'" in capsys.readouterr().err
    assert cli.main(["swap", "again", "--admin", "http://127.0.0.1:1", *where[2:]]) == 2
    assert "admin surface of a server at http://127.0.0.1:1" in capsys.readouterr().err


async def test_a_replaced_model_that_is_still_asked_is_closed_with_the_server(
    loader: StubLoader,
) -> None:
    settings = ServerSettings(grace_s=0.05)
    server = Server(lambda: loader.load("first"), settings, sources={"": "first"}, loader=loader)
    await server.start()
    assert server._service is not None
    (old,) = server._service.models
    with old.users.one():
        assert not (await server.swapper.swap("", "again")).freed
        assert old.batcher.alive
        await server.stop()
        assert not old.batcher.alive


async def test_a_bad_checkpoint_is_not_in_the_way_of_the_next(loader: StubLoader) -> None:
    server = Server(
        {name: Engine(answering(0.0), edge_identity="same eyes") for name in ("one", "two", "six")},
        sources={"one": "nowhere", "two": "tuned", "six": "wider"},
        loader=loader,
    )
    await server.start()
    try:
        replaced, troubles = await server.swapper.refresh()
    finally:
        await server.stop()
    assert [report.model for report in replaced] == ["two"]
    assert [trouble.trouble for trouble in troubles] == ["checkpoint", "robots"]


class Impostor(BaseHTTPRequestHandler):
    """Answers at ``/redirects`` with the way to ``/``, elsewhere with JSON that is no report."""

    seen: ClassVar[list[str]] = []

    def do_POST(self) -> None:
        self.seen.append(self.path)
        self.rfile.read(int(self.headers["content-length"]))
        self.send_response(302 if self.path.startswith("/redirects") else 200)
        self.send_header("location", "/")
        self.end_headers()
        self.wfile.write(b'{"robots": "same"}')

    do_GET = do_POST

    def log_message(self, *_: Any) -> None:
        """Nothing."""


def test_the_command_gives_the_token_to_nobody_else(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    token = tmp_path / "operator.token"
    token.write_text(OPERATOR)

    def asking(admin: str) -> str:
        assert cli.main(["swap", "again", "--admin", admin, "--token-file", str(token)]) == 2
        return capsys.readouterr().err

    with HTTPServer(("127.0.0.1", 0), Impostor) as impostor:
        thread = threading.Thread(target=impostor.serve_forever)
        thread.start()
        url = f"http://127.0.0.1:{impostor.server_port}"
        try:
            assert "nothing was replaced: 302" in asking(f"{url}/redirects")
            assert "expected the report of a swap" in asking(f"{url}/other")
        finally:
            impostor.shutdown()
            thread.join()
    assert Impostor.seen == ["/redirects/v1/models/swap", "/other/v1/models/swap"]
    assert "--insecure" in asking("http://192.0.2.1:8080")
    assert "http://… or https://…" in asking("http://[")


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="there is no SIGHUP here")
def test_a_hangup_takes_over_a_checkpoint_that_changed(tmp_path: Path) -> None:
    """The real command with real checkpoints, the folder replaced under its name."""
    from test_cli import FREE_PORTS, process, ready_line

    from comvla_vla import random_policy, save_policy
    from comvla_vla.random import unit_statistics

    for name, seed in (("one", 0), ("two", 1)):
        edge, cloud = random_policy(seed=0)
        if seed:
            _, cloud = random_policy(seed=seed)
            # Another cloud half behind the same eyes.
            cloud.net.projector.load_state_dict(edge.net.projector.state_dict())
        statistics = unit_statistics(edge.config)
        save_policy(tmp_path / name, edge.net, cloud.net, edge.prompt.tokenizer, statistics)
    current = tmp_path / "current"
    shutil.copytree(tmp_path / "one", current)
    arguments = ("-m", "comvla_server", "serve", "--model", str(current), *FREE_PORTS)
    with process(*arguments) as running:
        target, admin, _ = ready_line(running)

        def model() -> Any:
            return httpx.get(f"{admin}/v1/models", timeout=PATIENCE_S).json()["models"][0]

        first = model()["fingerprint"]
        shutil.rmtree(current)
        shutil.copytree(tmp_path / "two", current)
        os.kill(running.pid, signal.SIGHUP)

        def replaced() -> bool:
            serves = model()
            return serves["fingerprint"] != first and serves["edge_fingerprints"] == [first]

        eventually(replaced)
        with Robot(target) as robot:
            described = robot.stub.GetModel(policy_pb2.GetModelRequest(), timeout=PATIENCE_S)
    assert list(described.edge_fingerprints) == [first]


def test_garbage_collection_stays_frozen_where_it_was() -> None:
    from comvla_server.swapping import _freed

    frozen = gc.get_freeze_count()
    engine = Engine(StubCloud())
    ref = weakref.ref(engine)
    assert not _freed(ref)
    del engine
    assert _freed(ref)
    assert (gc.get_freeze_count() > 0) == (frozen > 0)
