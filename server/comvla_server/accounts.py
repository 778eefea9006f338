"""How each call for actions ended: counted, timed and, now and then, logged."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable

from comvla.v1 import policy_pb2
from comvla_server.calls import begin_call
from comvla_server.fleet import Fleet
from comvla_server.log_throttle import LogThrottle
from comvla_server.metrics import Metrics
from comvla_server.refusals import Reason, Refusal
from comvla_server.wording import shown

_log = logging.getLogger(__name__)

# A robot's own deadline began when it sent: it hangs up earlier than the deadline seen from here.
_TRANSIT_S = 0.05

Answered = tuple[policy_pb2.InferResponse, bool]
"""A response, and whether it repeats an earlier one."""

Work = Callable[[float, float], Awaitable[Answered]]
"""Answers one call, given when it started and when its caller gives up."""


class CallAccounts:
    """Runs the work of calls and keeps the books.

    Args:
        metrics: where calls are counted.
        fleet: where people see them.
        default_deadline_s: of calls that bring none, seconds.
        clock: monotonic seconds.

    Attributes:
        idle: set while no call is open.
    """

    def __init__(
        self,
        metrics: Metrics,
        fleet: Fleet,
        default_deadline_s: float,
        clock: Callable[[], float],
    ) -> None:
        self.idle = asyncio.Event()
        self.idle.set()
        self._open = 0
        self._metrics = metrics
        self._fleet = fleet
        self._default_deadline_s = default_deadline_s
        self._clock = clock
        self._throttle = LogThrottle(clock)

    async def run(
        self, request: policy_pb2.InferRequest, time_remaining_s: float | None, work: Work
    ) -> policy_pb2.InferResponse:
        """Does the work of one call.

        Args:
            request: for the log; may be filled in while the work goes on.
            time_remaining_s: seconds until the caller gives up, None where it did not say.
            work: answers the call.

        Raises:
            Refusal: no actions, and why.
        """
        started_s = self._clock()
        deadline_s = started_s + (
            self._default_deadline_s if time_remaining_s is None else time_remaining_s
        )
        outcome = Reason.CANCELLED.value
        response: policy_pb2.InferResponse | None = None
        call = begin_call()
        self._open += 1
        self.idle.clear()
        try:
            response, repeat = await work(started_s, deadline_s)
            outcome = "repeat" if repeat else "ok"
            return response
        except Refusal as refusal:
            outcome = refusal.reason.value
            self.note_refusal(request, refusal)
            raise
        except asyncio.CancelledError:
            if self._clock() >= deadline_s - _TRANSIT_S:
                outcome = Reason.DEADLINE.value
            self._metrics.requests_dropped.labels(outcome).inc()
            raise
        except Exception as error:
            outcome = Reason.MODEL.value
            _log.exception("a request broke the server's own code")
            self._metrics.requests_dropped.labels(outcome).inc()
            raise Refusal(
                Reason.MODEL,
                f"expected actions, the server failed with {type(error).__name__}: "
                "its log says more, please report it",
            ) from error
        finally:
            self._open -= 1
            if not self._open:
                self.idle.set()
            self._metrics.step_duration.labels(outcome).observe(self._clock() - started_s)
            self._fleet.note(request, call, outcome, response)

    def note_refusal(self, request: policy_pb2.InferRequest, refusal: Refusal) -> None:
        """Counts a refusal, and logs it unless its like was logged a moment ago."""
        self._metrics.requests_dropped.labels(refusal.reason.value).inc()
        suppressed = self._throttle.allow(refusal.reason.value)
        if suppressed is None:
            return
        _log.info(
            "refused: %s",
            refusal.message,
            extra={
                "reason": refusal.reason.value,
                "session": shown(request.session_id),
                "step": request.step,
                "suppressed": suppressed,
            },
        )
