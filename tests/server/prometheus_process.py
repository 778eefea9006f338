"""A real Prometheus for tests."""

from __future__ import annotations

import contextlib
import json
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from server_stubs import PATIENCE_S, eventually, quiet_port

PROMETHEUS = shutil.which("prometheus")

needs_prometheus = pytest.mark.skipif(
    PROMETHEUS is None, reason="needs the prometheus binary: apt-get install prometheus"
)


@contextlib.contextmanager
def prometheus(folder: Path, scraped: str) -> Iterator[httpx.Client]:
    """A Prometheus that scrapes one address twice a second; yields a client of its API."""
    config = folder / "prometheus.yml"
    config.write_text(
        json.dumps(
            {
                "global": {"scrape_interval": "500ms", "scrape_timeout": "500ms"},
                "scrape_configs": [
                    {"job_name": "comvla", "static_configs": [{"targets": [scraped]}]}
                ],
            }
        )
    )
    port = quiet_port()
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
        httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=PATIENCE_S) as http,
    ):
        try:
            assert eventually(lambda: _ready(http)), "Prometheus never became ready"
            yield http
        finally:
            process.kill()


def series(http: httpx.Client, expression: str) -> list[dict[str, Any]]:
    """All series of an expression, now."""
    answer = http.get("/api/v1/query", params={"query": expression}).json()
    assert answer["status"] == "success", (expression, answer)
    result: list[dict[str, Any]] = answer["data"]["result"]
    return result


def value(http: httpx.Client, expression: str) -> float | None:
    """Latest value of an expression with one series, None while there is none."""
    found = series(http, expression)
    return float(found[0]["value"][1]) if found else None


def _ready(http: httpx.Client) -> bool:
    with contextlib.suppress(httpx.TransportError):
        return http.get("/-/ready").status_code == 200
    return False
