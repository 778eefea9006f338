"""Where the server stands, for people who watch."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from comvla_server.lifecycle import Lifecycle
from comvla_server.metrics import Metrics
from comvla_server.models import Runtime
from comvla_server.service import PolicyService
from comvla_server.version import server_version


def server_state(
    lifecycle: Lifecycle, metrics: Metrics, service: PolicyService
) -> Callable[[], dict[str, Any]]:
    """A function that says, at any time, where the server stands.

    Args:
        lifecycle: its phase.
        metrics: what was refused, and why.
        service: for the model and its queue.
    """
    started_s = time.monotonic()

    def state() -> dict[str, Any]:
        return {
            "phase": lifecycle.phase.value,
            "up_s": round(time.monotonic() - started_s, 1),
            "version": server_version(),
            "refused": metrics.refusals(),
            **(_running(service.runtime) if service.runtime is not None else {}),
        }

    return state


def _running(runtime: Runtime) -> dict[str, Any]:
    info, batcher = runtime.engine.info, runtime.batcher
    return {
        "model": info.name,
        "fingerprint": info.fingerprint[:12],
        "num_tokens": info.num_tokens,
        "queue_depth": batcher.queue_depth,
        "utilization": round(batcher.utilization, 3),
    }
