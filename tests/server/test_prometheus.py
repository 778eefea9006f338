"""A real Prometheus scrapes a real server, and agrees with what the client counted."""

from __future__ import annotations

import contextlib
import shutil
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest
from server_stubs import eventually

from comvla_client import ComVLAClient, StepReport
from comvla_server.background import BackgroundServer
from comvla_server.engine import Engine
from comvla_vla import random_policy

PROMETHEUS = shutil.which("prometheus")

pytestmark = pytest.mark.skipif(
    PROMETHEUS is None, reason="needs the prometheus binary: apt-get install prometheus"
)


@contextlib.contextmanager
def prometheus(folder: Path, scraped: str) -> Iterator[httpx.Client]:
    """A Prometheus that scrapes one address five times a second; yields a client of its API."""
    config = folder / "prometheus.yml"
    config.write_text(
        "global: {scrape_interval: 200ms, scrape_timeout: 200ms}\n"
        "scrape_configs:\n"
        f"  - {{job_name: comvla, static_configs: [{{targets: ['{scraped}']}}]}}\n"
    )
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    arguments = [
        str(PROMETHEUS),
        f"--config.file={config}",
        f"--storage.tsdb.path={folder / 'data'}",
        f"--web.listen-address=127.0.0.1:{port}",
        "--log.level=error",
    ]
    with (
        subprocess.Popen(
            arguments, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        ) as process,
        httpx.Client(base_url=f"http://127.0.0.1:{port}") as http,
    ):
        try:
            eventually(lambda: _ready(http))
            yield http
        finally:
            process.kill()


def _ready(http: httpx.Client) -> bool:
    with contextlib.suppress(httpx.TransportError):
        return http.get("/-/ready").status_code == 200
    return False


def query(http: httpx.Client, expression: str) -> float | None:
    """Latest value of an expression, None while there is none."""
    answer = http.get("/api/v1/query", params={"query": expression}).json()
    assert answer["status"] == "success", answer
    series = answer["data"]["result"]
    return float(series[0]["value"][1]) if series else None


def drive(server: BackgroundServer, steps: int) -> list[StepReport]:
    """Reports of a robot under a fading link."""
    edge, _ = random_policy(seed=0)
    rng = np.random.default_rng(0)
    height, width = edge.info.image_size
    reports = []
    with ComVLAClient(server.target, edge=edge, deadline_s=20.0) as client:
        for step in range(steps):
            images = rng.integers(0, 256, (edge.info.grid[0], height, width, 3), dtype=np.uint8)
            obs = {"images": list(images), "proprio": np.zeros(edge.info.proprio_dim, np.float32)}
            chunk = client.step(obs, "press the yellow button firmly", snr=2.0 + step)
            reports.append(chunk.report)
    return reports


def test_prometheus_answers_with_the_bytes_that_the_client_counted(tmp_path: Path) -> None:
    with BackgroundServer(Engine(random_policy(seed=0)[1])) as server:
        scraped = server.admin_url.removeprefix("http://")
        with prometheus(tmp_path, scraped) as http:
            reports = drive(server, steps=6)
            assert {report.source for report in reports} == {"cloud"}
            counted = {
                "comvla_tx_payload_bytes_total": sum(r.payload_bytes for r in reports),
                "comvla_tx_encoded_bytes_total": sum(r.encoded_bytes for r in reports),
                "comvla_tx_framed_bytes_total": sum(r.framed_bytes for r in reports),
                "comvla_tokens_received_total": sum(r.tokens for r in reports),
                "comvla_inference_flops_total": sum(r.cloud_flops for r in reports),
                'comvla_step_duration_seconds_count{outcome="ok"}': len(reports),
            }
            assert min(counted.values()) > 0
            for expression, value in counted.items():
                # Nothing is sent any more: the next scrape has the final value.
                assert eventually(lambda e=expression, v=value: query(http, e) == v), expression
            assert query(http, 'up{job="comvla"}') == 1.0
            assert query(http, "comvla_server_ready") == 1.0
