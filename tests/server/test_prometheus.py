"""A real Prometheus scrapes a real server, and agrees with what the client counted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from prometheus_process import needs_prometheus, prometheus, value
from server_stubs import eventually

from comvla_client import ComVLAClient, StepReport
from comvla_server.background import BackgroundServer
from comvla_server.engine import Engine
from comvla_vla import random_policy

pytestmark = needs_prometheus


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
            for expression, total in counted.items():
                # Nothing is sent any more: the next scrape has the final value.
                assert eventually(lambda e=expression, t=total: value(http, e) == t), expression
            # A scrape that comes too late on a busy machine leaves both out.
            assert eventually(lambda: value(http, 'up{job="comvla"}') == 1.0)
            assert eventually(lambda: value(http, "comvla_server_ready") == 1.0)
