"""One forward pass for several requests, in which no request can spoil another's answer."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from comvla_server.engine import Engine
from comvla_server.metrics import Metrics
from comvla_vla.request import AnyRequest

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Pass:
    """What the model made of one request, and in whose company.

    Attributes:
        result: actions (H, A), or what the model raised.
        batch_size: requests in the same forward pass.
        flops: multiply-adds counted twice, this request's share.
        predict_s: seconds of the forward pass.
    """

    result: NDArray[np.float32] | Exception
    batch_size: int
    flops: float
    predict_s: float

    @property
    def ok(self) -> bool:
        """Whether there are actions."""
        return not isinstance(self.result, Exception)


def run_pass(
    engine: Engine,
    requests: Sequence[AnyRequest],
    metrics: Metrics,
    clock: Callable[[], float],
) -> list[Pass]:
    """Runs a batch; where it fails, runs each request alone, so that only the culprit is refused.

    Args:
        engine: the model.
        requests: at least one.
        metrics: where failures and batch sizes are counted.
        clock: monotonic seconds.

    Returns:
        One pass per request, in order. Nothing is raised: a failure is a result.
    """
    started_s = clock()
    try:
        chunks = engine.predict(requests)
        flops = [engine.flops(request) for request in requests]
    except Exception as error:
        metrics.model_errors.inc()
        _log.exception("the model failed on a batch of %d", len(requests))
        if len(requests) > 1:
            return [run_pass(engine, [request], metrics, clock)[0] for request in requests]
        return [Pass(error, 1, 0.0, clock() - started_s)]
    predict_s = clock() - started_s
    metrics.batch_size.observe(len(requests))
    return [
        Pass(chunk, len(requests), cost, predict_s)
        for chunk, cost in zip(chunks, flops, strict=True)
    ]
