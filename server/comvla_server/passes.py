"""Forward passes, each for several requests, in which no request can spoil another's answer."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from comvla_server.cost_model import Work
from comvla_server.engine import Engine
from comvla_server.inference_thread import InferenceThread
from comvla_server.load_control import LoadControl
from comvla_server.metrics import Metrics
from comvla_server.refusals import Reason, Refusal
from comvla_server.sessions import Session
from comvla_server.tickets import Answer, Ticket
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


class Passes:
    """Computes batches on the inference thread, and settles their tickets.

    Args:
        engine: the model.
        thread: where it runs.
        load: learns what passes cost.
        metrics: where batches, compute and failures are counted.
        clock: monotonic seconds.
    """

    def __init__(
        self,
        engine: Engine,
        thread: InferenceThread,
        load: LoadControl,
        metrics: Metrics,
        clock: Callable[[], float],
    ) -> None:
        self._engine = engine
        self._thread = thread
        self._load = load
        self._metrics = metrics
        self._clock = clock

    async def compute(self, batch: Sequence[Session], ready_s: float) -> float:
        """One pass, after which every ticket in it has its answer or a refusal.

        Args:
            batch: sessions whose observation is ``running``.
            ready_s: monotonic time since when there was this work and no other before it.

        Returns:
            Monotonic time when it ended.
        """
        tickets = [s.running for s in batch if s.running]
        requests = [ticket.request for ticket in tickets if ticket.request]
        work = Work.of(ticket.place.work for ticket in tickets)
        started_s = self._clock()
        self._load.begin(work, started_s)
        try:
            passes = await self._thread.run(
                run_pass, self._engine, requests, self._metrics, self._clock
            )
        # The thread makes one of a SystemExit, too: nothing inside a model may end the batcher's loop.
        except Exception as error:
            self._metrics.model_errors.inc()
            passes = [Pass(error, len(batch), 0.0, 0.0)] * len(batch)
        ended_s = self._clock()
        succeeded = all(p.batch_size == len(batch) and p.ok for p in passes)
        self._load.end(work, ready_s, ended_s, succeeded=succeeded)
        self._metrics.inference_busy_seconds.inc(ended_s - started_s)
        for session, outcome in zip(batch, passes, strict=True):
            self._settle(session, outcome, started_s, ended_s)
        return ended_s

    def _settle(self, session: Session, outcome: Pass, started_s: float, ended_s: float) -> None:
        ticket, session.running = session.running, None
        assert ticket is not None
        assert ticket.request is not None
        if isinstance(outcome.result, Exception):
            ticket.resolve(_model_failed(ticket, outcome.result))
            return
        answer = Answer(
            actions=outcome.result,
            tokens_used=self._engine.num_tokens(ticket.request),
            batch_size=outcome.batch_size,
            cloud_flops=outcome.flops,
            queue_s=started_s - ticket.admitted_s,
            predict_s=outcome.predict_s,
            ready_s=ended_s,
        )
        self._metrics.inference_flops.inc(answer.cloud_flops)
        self._metrics.step_phase.labels("queue").observe(answer.queue_s)
        self._metrics.step_phase.labels("predict").observe(answer.predict_s)
        self._metrics.unanswered_steps.inc(session.note_answered(ticket))
        ticket.resolve(answer)


def _model_failed(ticket: Ticket, error: Exception) -> Refusal:
    return Refusal(
        Reason.MODEL,
        f"expected actions, the model raised {type(error).__name__} on step {ticket.step}; "
        "the server goes on, its log says more",
    )
