"""Whether a call is worth reading, by what became of those before it."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

from comvla.v1 import policy_pb2
from comvla_server.identity import caller
from comvla_server.loop_watch import LoopWatch
from comvla_server.models import Models
from comvla_server.refusals import Reason, Refusal

_LEAST_TIME_S = 0.02
"""Whoever arrives with less cannot count on an answer, whatever the model."""

_EARLY = (
    0.1  # of its time: the client's deadline comes before the server's, by the way to the server
)


class Screening:
    """Turns calls away unread where the event loop hardly keeps up, and learns from what became of the others.

    Args:
        models: what answers.
        admission: whether calls are turned away at all.
        clock: monotonic seconds.

    Attributes:
        loop_watch: whether the event loop keeps up; runs where its ``run`` does.
    """

    def __init__(self, models: Models, admission: bool, clock: Callable[[], float]) -> None:
        self._models = models
        self._admission = admission
        self._clock = clock
        self.loop_watch = LoopWatch()

    def glance(self, time_remaining_s: float | None) -> Refusal | None:
        """Whether a call that nobody has read yet can be answered in time; None where it may be.

        Only where the event loop hardly keeps up: to read a request takes longer than to turn it away, and what is
        turned away unread cannot be known for a repeat or for the newest observation of a robot that waits.

        Args:
            time_remaining_s: seconds until the caller gives up, None where it did not say.
        """
        watch = self.loop_watch
        if not self._admission or self._models.default is None or time_remaining_s is None:
            return None
        if watch.skips():
            return Refusal(
                Reason.CONGESTED,
                "more calls come than this machine can read in time: ask again later, or add a replica",
                retry_after_s=min(1.0, max(0.0, time_remaining_s)),
            )
        if not watch.congested:
            return None
        # Which model the call means stands in what was not read: it may pass where any could answer it.
        deadline_s = self._clock() + time_remaining_s
        refusals = []
        for runtime in self._models:
            refusal = runtime.batcher.glance(deadline_s)
            if refusal is None:
                return None
            refusals.append(refusal)
        return min(refusals, key=lambda refusal: refusal.retry_after_s or 0.0)

    async def watched(
        self,
        answer: Awaitable[policy_pb2.InferResponse],
        request: policy_pb2.InferRequest,
        time_remaining_s: float | None,
    ) -> policy_pb2.InferResponse:
        """Awaits an answer, and tells the loop's watch what became of the call.

        Args:
            answer: of the call.
            request: who asked.
            time_remaining_s: seconds that it had when it was first seen, None where it did not say.
        """
        began_s = self._clock()
        died = False
        try:
            return await answer
        except asyncio.CancelledError:
            # A client that asked over two connections takes back the slower call: that one is no loss.
            died = _was_over(time_remaining_s, self._clock() - began_s)
            raise
        except Refusal as refusal:
            died = refusal.reason is Reason.DEADLINE
            raise
        finally:
            if died:
                self.note_lost(caller().name or request.session_id, time_remaining_s)
            else:
                self.loop_watch.note(died=False)

    def note_lost(self, who: str, time_remaining_s: float | None) -> None:
        """Tells the loop's watch of a call that died on its way.

        Args:
            who: made it.
            time_remaining_s: seconds that it had when it was first seen, None where it did not say.
        """
        hopeless = time_remaining_s is not None and time_remaining_s < self._least_time_s()
        self.loop_watch.note(died=True, who=who, hopeless=hopeless)

    def _least_time_s(self) -> float:
        """Seconds in which no model can be expected to answer, however idle."""
        usual_s = min((runtime.batcher.usual_s for runtime in self._models), default=0.0)
        return max(_LEAST_TIME_S, usual_s)


def _was_over(time_remaining_s: float | None, passed_s: float) -> bool:
    """Whether a call that its client gave up had come to its deadline."""
    if time_remaining_s is None:
        return False
    return passed_s >= time_remaining_s - max(_LEAST_TIME_S, _EARLY * time_remaining_s)
