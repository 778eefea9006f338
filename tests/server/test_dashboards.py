"""Dashboards and alerts as they are shipped, against a real Prometheus that scraped a real server."""

from __future__ import annotations

import json
import math
import re
import runpy
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from prometheus_process import needs_prometheus, prometheus, series
from server_stubs import eventually

from comvla_client import ComVLAClient
from comvla_server.background import BackgroundServer
from comvla_server.engine import Engine
from comvla_vla import random_policy

DOCKER = Path(__file__).parents[2] / "docker"
BOARDS = sorted((DOCKER / "grafana" / "dashboards").glob("*.json"))
PROMTOOL = shutil.which("promtool")


def queries() -> list[tuple[str, str, str]]:
    """(dashboard, panel, PromQL) of everything that Grafana would ask."""
    return [
        (board.stem, panel["title"], target["expr"])
        for board in BOARDS
        for panel in json.loads(board.read_text())["panels"]
        for target in panel["targets"]
    ]


@pytest.fixture(scope="module")
def scraped(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    """Prometheus beside a server that three robots keep busy, one of which lost answers before."""
    edge, cloud = random_policy(seed=0)
    height, width = edge.info.image_size
    obs = {
        "images": [np.zeros((height, width, 3), np.uint8)] * edge.info.grid[0],
        "proprio": np.zeros(edge.info.proprio_dim, np.float32),
    }
    done = threading.Event()

    def robot(number: int, target: str) -> None:
        with ComVLAClient(target, edge=edge, deadline_s=20.0, min_tokens=8) as client:
            while not done.is_set():
                client.step(obs, "press the yellow button firmly", snr=-60.0)  # nothing fits
                client.step(obs, "press the yellow button firmly", snr=10.0 + number)

    with BackgroundServer(Engine(cloud)) as server:
        robots = [threading.Thread(target=robot, args=(n, server.target)) for n in range(3)]
        address = server.admin_url.removeprefix("http://")
        with prometheus(tmp_path_factory.mktemp("prometheus"), address) as http:
            for thread in robots:
                thread.start()
            try:
                yield http
            finally:
                done.set()
                for thread in robots:
                    thread.join()


def concrete(expression: str) -> str:
    """A query with Grafana's variables replaced as Grafana would."""
    return expression.replace("$job", "comvla").replace("$__rate_interval", "5s")


@needs_prometheus
@pytest.mark.parametrize(("board", "panel", "expression"), queries())
def test_every_panel_returns_data(
    board: str, panel: str, expression: str, scraped: httpx.Client
) -> None:
    def answered() -> list[dict[str, Any]]:
        found = series(scraped, concrete(expression))
        return [one for one in found if not math.isnan(float(one["value"][1]))]

    assert eventually(answered), f"{board}, {panel}: {expression}"


def test_dashboards_are_what_their_description_says(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("grafana_foundation_sdk", reason="Grafana's SDK needs Python 3.11")
    monkeypatch.syspath_prepend(str(DOCKER / "grafana"))
    built = runpy.run_path(str(DOCKER / "grafana" / "build.py"))
    assert {board.stem for board in BOARDS} == set(built["DASHBOARDS"])
    for board in BOARDS:
        assert board.read_text() == built["build"](board.stem), "run docker/grafana/build.py"


def test_alerts_and_dashboards_ask_for_metrics_that_exist(scraped: httpx.Client) -> None:
    texts = [path.read_text() for path in [*BOARDS, DOCKER / "prometheus" / "alerts.yml"]]
    asked = set(re.findall(r"comvla_[a-z_]+", " ".join(texts))) - {"comvla_"}
    asked = {name for name in asked if not name.startswith("comvla_certificate")}  # TLS only

    def unknown() -> set[str]:
        return asked - set(scraped.get("/api/v1/label/__name__/values").json()["data"])

    assert eventually(lambda: not unknown()), unknown()


@pytest.mark.skipif(PROMTOOL is None, reason="needs promtool: apt-get install prometheus")
@pytest.mark.parametrize(
    "arguments",
    [
        ("check", "config", "prometheus.yml"),
        ("check", "rules", "alerts.yml"),
        ("test", "rules", "alerts_test.yml"),
    ],
    ids=" ".join,
)
def test_promtool_agrees(arguments: tuple[str, ...]) -> None:
    done = subprocess.run(
        [str(PROMTOOL), *arguments], cwd=DOCKER / "prometheus", capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_services_do_not_set_the_servers_variables() -> None:
    # A service called comvla makes Kubernetes set COMVLA_PORT=tcp://…, which is no port.
    services = (DOCKER / "kubernetes" / "service.yaml").read_text()
    assert "name: comvla\n" in services
    deployment = (DOCKER / "kubernetes" / "deployment.yaml").read_text()
    assert "enableServiceLinks: false" in deployment


def test_every_alert_has_a_test() -> None:
    named = r"alert(?:name)?: (\w+)"
    alerts = set(re.findall(named, (DOCKER / "prometheus" / "alerts.yml").read_text()))
    tested = (DOCKER / "prometheus" / "alerts_test.yml").read_text()
    fired = set(re.findall(r"alertname: (\w+)\n\s+exp_alerts", tested))
    assert alerts
    assert fired == alerts


@pytest.mark.parametrize(
    "command",
    [
        ("hadolint", "server.Dockerfile", "edge.Dockerfile"),
        ("check-jsonschema", "--builtin-schema", "vendor.compose-spec", "compose.yaml"),
        (
            *("kubernetes-validate", "--strict"),
            *sorted(
                f"kubernetes/{path.name}"
                for path in (DOCKER / "kubernetes").glob("*.yaml")
                if path.stem != "kustomization"
            ),
        ),
    ],
    ids=lambda command: command[0],
)
def test_files_of_the_deployment_are_sound(command: tuple[str, ...]) -> None:
    program = Path(sys.executable).with_name(command[0])
    done = subprocess.run([str(program), *command[1:]], cwd=DOCKER, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
