"""The page at the admin address, as HTTP: files, events, tokens, bounds."""

from __future__ import annotations

import contextlib
import json
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from server_stubs import PATIENCE_S, Robot, StubCloud, eventually, message

from comvla_server import fleet_feed
from comvla_server.background import BackgroundServer
from comvla_server.engine import Engine
from comvla_server.fleet_page import assets
from comvla_server.identity import Identity
from comvla_server.settings import ServerSettings
from comvla_server.tokens import TokenLine, new_token


@pytest.fixture
def http(server: BackgroundServer) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=server.admin_url, timeout=PATIENCE_S) as client:
        yield client


@contextlib.contextmanager
def watching(http: httpx.Client, **headers: str) -> Iterator[Iterator[dict[str, Any]]]:
    """The events of one stream, each with its kind under ``event``."""
    with http.stream("GET", "/events", headers=headers) as answer:
        assert answer.status_code == 200
        assert answer.headers["content-type"].startswith("text/event-stream")
        yield _events(answer.iter_lines())


def _events(lines: Iterator[str]) -> Iterator[dict[str, Any]]:
    kind = ""
    for line in lines:
        if line.startswith("event: "):
            kind = line.removeprefix("event: ")
        elif line.startswith("data: "):
            yield {"event": kind, **json.loads(line.removeprefix("data: "))}


def until(
    events: Iterator[dict[str, Any]], wanted: Callable[[dict[str, Any]], Any]
) -> dict[str, Any]:
    return next(event for event in events if wanted(event))


def test_the_page_is_whole_and_asks_nobody_else(http: httpx.Client) -> None:
    page = http.get("/")
    assert page.headers["content-type"].startswith("text/html")
    linked = set(re.findall(r'(?:src|href)="(/page/[^"]+)"', page.text))
    assert linked
    assert linked <= set(assets())
    for path in assets():
        answer = http.get(path)
        assert answer.status_code == 200
        policy = answer.headers["content-security-policy"]
        assert "default-src 'none'" in policy
        assert "unsafe" not in policy
        for imported in re.findall(r'from "\./([^"]+)"', answer.text):
            assert f"/page/{imported}" in assets()
        outside = re.findall(r"https?://(?!www\.w3\.org/2000/svg)", answer.text)
        assert not outside, path


def test_no_markup_and_no_script_is_made_from_text() -> None:
    """What robots send becomes text: the page's code has no way to make anything else of it."""
    ways = r"innerHTML|outerHTML|insertAdjacent|document\.write|\beval\b|new Function|srcdoc"
    folder = Path(fleet_feed.__file__).parent / "page"
    sources = {file.name: file.read_text() for file in folder.glob("*.js")}
    assert {name for name, text in sources.items() if re.search(ways, text)} == set()
    page = (folder / "index.html").read_text()
    assert not re.search(r"<script(?![^>]*src=)|\son\w+=|style=", page)


def test_files_are_asked_for_anew_and_sent_when_they_changed(http: httpx.Client) -> None:
    first = http.get("/page/main.js")
    again = http.get("/page/main.js", headers={"if-none-match": first.headers["etag"]})
    assert (first.headers["cache-control"], again.status_code) == ("no-cache", 304)
    assert http.get("/page/../metrics").status_code == 200  # httpx has made /metrics of it
    raw = httpx.URL(str(http.base_url), raw_path=b"/page/..%2f..%2fsettings.py")
    assert http.request("GET", raw).status_code == 404


def test_an_answer_is_an_event(http: httpx.Client, robot: Robot) -> None:
    with watching(http) as events:
        hello = next(events)
        assert (hello["event"], hello["robots"], hello["server"]["phase"]) == (
            "hello",
            [],
            "serving",
        )
        assert hello["server"]["model"] == "stub"
        robot.infer(message("arm.0", 4, k=5, quantization="int8"))
        (row,) = until(events, lambda event: event["robots"])["robots"]
        assert (row["name"], row["episode"], row["step"]) == ("arm", 0, 4)
        assert (row["outcome"], row["coding"], row["kept"], row["snr_db"]) == (
            "ok",
            "int8",
            5,
            12.5,
        )
        second = dict(zip(hello["columns"], row["seconds"][-1], strict=True))
        assert (second["answered"], second["tokens"], second["payload_bytes"]) == (1, 5, 5 * 8)
        assert second["wire_bytes"] > second["payload_bytes"]
        assert 0 < second["predict_ms"] <= second["total_ms"]

        robot.refused(message("arm.0", 3))  # overtaken
        event = until(events, lambda event: event["robots"])
        assert event["robots"][0]["outcome"] == "superseded"
        assert event["server"]["refused"] == {"superseded": 1}
    tokens = http.get("/v1/fleet/tokens", params={"robot": row["number"]}).json()
    assert tokens["grid"] == [1, 4, 4]
    assert len(set(tokens["positions"])) == 5
    assert http.get("/v1/fleet/tokens", params={"robot": 99}).status_code == 404


def test_whoever_comes_later_is_told_what_happened_before(http: httpx.Client, robot: Robot) -> None:
    for step in range(3):
        robot.infer(message("arm.0", step))
    with watching(http) as events:
        hello = next(events)
    assert hello["total"]["answered"] == 3
    assert hello["robots"][0]["total"]["answered"] == 3
    assert (
        sum(dict(zip(hello["columns"], s, strict=True))["answered"] for s in hello["seconds"]) == 3
    )


def test_without_robots_there_is_a_heartbeat(http: httpx.Client) -> None:
    with watching(http) as events:
        assert [next(events)["event"] for _ in range(3)] == ["hello", "tick", "tick"]


def test_words_of_a_robot_stay_words(http: httpx.Client, robot: Robot) -> None:
    """In a stream of lines and JSON they can neither end a line nor begin an event."""
    hostile = '</script><img src=x onerror=alert(1)>\r\n\n\nevent: hello\ndata: {}\u2028\u202e"'
    with watching(http) as events:
        next(events)
        robot.infer(message("a-b.c:d@e/f+g=h.0", instruction=hostile))
        (row,) = until(events, lambda event: event["robots"])["robots"]
        assert row["name"] == "a-b.c:d@e/f+g=h"
        assert next(events)["event"] == "tick"
    tokens = http.get("/v1/fleet/tokens", params={"robot": row["number"]})
    assert tokens.headers["content-type"] == "application/json"
    assert tokens.json()["instruction"] == hostile[:200]


def test_watchers_are_bounded_and_places_come_back(
    http: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fleet_feed, "MOST_WATCHERS", 2)
    with watching(http) as first, watching(http) as second:
        next(first), next(second)
        full = http.get("/events")
        assert full.status_code == 503
        assert "at most 2" in full.json()["detail"]
        assert full.headers["retry-after"]

    def place() -> bool:
        with http.stream("GET", "/events") as answer:
            return answer.status_code == 200

    assert eventually(place)


def test_a_watcher_that_does_not_read_is_dropped_and_holds_nobody_up(
    cloud: StubCloud, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fleet_feed, "_PAUSE_S", 0.0)
    # A large first event fills what the system buffers, so that the watcher is behind at once.
    monkeypatch.setattr(
        fleet_feed, "_encode", lambda event, data: b"data: " + b"x" * 2**20 + b"\n\n"
    )
    joined = threading.Event()
    join = fleet_feed.FleetFeed.join

    def noted(feed: fleet_feed.FleetFeed) -> fleet_feed.Watcher:
        watcher = join(feed)
        joined.set()
        return watcher

    monkeypatch.setattr(fleet_feed.FleetFeed, "join", noted)
    settings = ServerSettings(request_timeout_s=0.5)
    with (
        BackgroundServer(Engine(cloud), settings) as server,
        Robot(server.target) as robot,
        socket.create_connection(("127.0.0.1", server.server.admin_port)) as deaf,
    ):
        deaf.sendall(b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n")
        feed = server.server._feed
        assert feed is not None
        assert joined.wait(PATIENCE_S)
        for step in range(40):
            assert robot.infer(message("arm.0", step))
        eventually(lambda: feed.watchers == 0)
        deaf.settimeout(PATIENCE_S)
        with contextlib.suppress(ConnectionResetError):
            while deaf.recv(2**20):
                pass


def test_other_peoples_pages_get_no_events(http: httpx.Client) -> None:
    assert http.get("/events", headers={"sec-fetch-site": "cross-site"}).status_code == 403


def test_streams_end_with_the_server(cloud: StubCloud) -> None:
    with (
        BackgroundServer(Engine(cloud)) as server,
        httpx.Client(base_url=server.admin_url, timeout=PATIENCE_S) as http,
        watching(http) as events,
    ):
        next(events)
        server.stop()
        assert [event["server"]["phase"] for event in events][-1] == "draining"


async def test_a_page_that_is_opened_while_the_model_loads_says_so(cloud: StubCloud) -> None:
    from comvla_server.server import Server

    server = Server(Engine(cloud))
    await server.bind()
    try:
        async with (
            httpx.AsyncClient(base_url=server.admin_url, timeout=PATIENCE_S) as http,
            http.stream("GET", "/events") as answer,
        ):
            lines = [line async for line in _first(answer.aiter_lines(), 2)]
    finally:
        await server.stop()
    state = json.loads(lines[1].removeprefix("data: "))["server"]
    assert state["phase"] == "loading"
    assert "model" not in state


async def _first(lines: Any, count: int) -> Any:
    async for line in lines:
        yield line
        count -= 1
        if not count:
            return


class TestBehindTokens:
    """The page itself is open; what it shows is not."""

    @pytest.fixture
    def token(self) -> str:
        return new_token()

    @pytest.fixture
    def tokens_file(self, tmp_path: Path, token: str) -> Path:
        file = tmp_path / "admin"
        file.touch(mode=0o600)
        file.write_text(f"{TokenLine.of(Identity('operator'), token)}\n")
        return file

    @pytest.fixture
    def server(self, cloud: StubCloud, tokens_file: Path) -> Iterator[BackgroundServer]:
        settings = ServerSettings(admin_tokens_file=tokens_file, reload_interval_s=0.02)
        with BackgroundServer(Engine(cloud), settings) as running:
            yield running

    def test_files_need_no_token_and_events_do(self, http: httpx.Client, token: str) -> None:
        for path in assets():
            assert http.get(path).status_code == 200
        for path in ("/events", "/v1/fleet/tokens?robot=1", "/page/", "/page/none.js"):
            assert http.get(path).status_code == 401
        assert http.get(f"/events?token={token}").status_code == 401
        with watching(http, authorization=f"Bearer {token}") as events:
            assert next(events)["event"] == "hello"

    def test_a_token_that_is_taken_away_ends_what_it_opened(
        self, http: httpx.Client, token: str, tokens_file: Path
    ) -> None:
        with watching(http, authorization=f"Bearer {token}") as events:
            next(events)
            tokens_file.write_text(f"{TokenLine.of(Identity('new'), new_token())}\n")
            deadline_s = time.monotonic() + PATIENCE_S
            for _ in events:  # a heartbeat each second, until it ends
                assert time.monotonic() < deadline_s, "it never ended"
        assert http.get("/events", headers={"authorization": f"Bearer {token}"}).status_code == 401
