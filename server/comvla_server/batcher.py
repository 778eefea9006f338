"""Requests of many robots into few forward passes.

The window is zero: while the model runs, whatever arrives waits, and the next forward pass takes
it, up to ``max_batch``. A quiet server answers at once, a busy one batches by itself.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable, Sequence

from comvla_server.cost_model import CostModel, Work
from comvla_server.engine import Engine
from comvla_server.inference_thread import InferenceThread
from comvla_server.load_control import LoadControl
from comvla_server.load_policy import LoadPolicy
from comvla_server.metrics import Metrics
from comvla_server.occupancy import Occupancy
from comvla_server.passes import Passes
from comvla_server.refusals import Reason, Refusal
from comvla_server.sessions import Session, SessionTable
from comvla_server.tickets import Answer, Ticket
from comvla_server.waiting_room import WaitingRoom, too_late
from comvla_vla.request import AnyRequest, ImageRequest


class Batcher:
    """Bounded queue in front of one inference thread. Used from one event loop only.

    One observation per session waits at most; a newer one takes its place in the queue, however
    often the robot asks anew. What cannot be answered in time is turned away before it waits, and
    whose deadline is nearest is computed first (:mod:`comvla_server.admission`). A ticket whose
    deadline has passed, or for which nobody waits any more, is dropped before it costs compute.

    A process may have one for each of its models; they share what they are given, the inference
    thread and what it has before it.

    Args:
        engine: runs the batches.
        max_batch: most requests in one forward pass.
        max_queue: most sessions that may wait.
        max_sessions: most sessions whose last answer is remembered.
        session_ttl_s: silence after which a session is forgotten, seconds.
        load: what happens when more is asked than can be answered.
        costs: what passes cost; what the engine has learned where None.
        metrics: where batches, compute and failures are counted.
        thread: the inference thread; a new one where none is given.
        occupancy: of that thread.
        clock: monotonic seconds.
    """

    def __init__(
        self,
        engine: Engine,
        *,
        max_batch: int = 8,
        max_queue: int = 64,
        max_sessions: int = 1024,
        session_ttl_s: float = 600.0,
        load: LoadPolicy | None = None,
        costs: CostModel | None = None,
        metrics: Metrics | None = None,
        thread: InferenceThread | None = None,
        occupancy: Occupancy | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._engine = engine
        self._max_batch = max_batch
        self._sessions = SessionTable(max_sessions, session_ttl_s)
        self._clock = clock
        metrics = metrics or Metrics()
        self._load = LoadControl(
            max_batch,
            engine.info.num_tokens,
            load or LoadPolicy(),
            engine.costs if costs is None else costs,
            metrics,
            occupancy,
        )
        self._passes = Passes(engine, thread or InferenceThread(), self._load, metrics, clock)
        self._waiting = WaitingRoom(max_queue, self._load)
        self._work = asyncio.Event()
        self._task: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Starts to take batches from the queue; needs a running event loop."""
        self._task = asyncio.get_running_loop().create_task(self._dispatch())

    @property
    def alive(self) -> bool:
        """False when nothing takes requests from the queue any more."""
        return self._task is not None and not self._task.done()

    @property
    def queue_depth(self) -> int:
        """Requests that wait."""
        return len(self._waiting)

    @property
    def utilization(self) -> float:
        """Busy share of the inference thread over the last seconds, 0 to 1."""
        return self._load.utilization(self._clock())

    @property
    def offered_load(self) -> float:
        """Work that robots asked for lately, as a share of what the model can do with full batches."""
        return self._load.load(self._clock())

    @property
    def suggested_tokens(self) -> int:
        """Tokens that the server would like a request to have at most, 0 for no wish."""
        return self._load.suggested_tokens(self._clock())

    @property
    def usual_s(self) -> float:
        """Seconds that a model at rest takes for one request like those of late."""
        return self._load.alone_s(self._load.usual_work())

    @property
    def sessions(self) -> Sequence[Session]:
        """Sessions on record, least recently seen first."""
        return list(self._sessions)

    def adopt_sessions(self, before: Batcher) -> None:
        """Goes on with the sessions of the model that this one replaces."""
        self._sessions.adopt(before._sessions)

    def find(self, session_id: str, step: int, digest: bytes) -> Ticket | None:
        """The ticket of a step that is waiting, running or on record; None for a new step.

        Raises:
            Refusal: same step with other content (conflict), or an older step (superseded).
        """
        session = self._sessions.get(session_id, self._clock())
        return session.find(step, digest) if session else None

    def screen(
        self, session_id: str, step: int, num_tokens: int, deadline_s: float, *, pictures: bool
    ) -> None:
        """Turns away a new step before anything is spent on decoding it; a repeat passes.

        Args:
            session_id: name chosen by the robot.
            step: counts up within the session.
            num_tokens: as its payload announces, or N for pictures.
            deadline_s: monotonic time after which the answer is of no use.
            pictures: whether it brings pictures.

        Raises:
            Refusal: see :meth:`admit`.
        """
        now_s = self._clock()
        session = self._sessions.get(session_id, now_s)
        if session is not None and step <= session.newest_step:
            return  # find() will tell
        work = Work(1, num_tokens, int(pictures))
        self._waiting.screen(session_id, work, deadline_s, now_s)

    def glance(self, deadline_s: float) -> Refusal | None:
        """Whether one more request like those of late could be answered in time; None where it could."""
        return self._waiting.glance(deadline_s, self._clock())

    def admit(
        self,
        session_id: str,
        step: int,
        request: AnyRequest,
        digest: bytes,
        deadline_s: float,
    ) -> Ticket:
        """Puts a new step into the queue; an older one of the session that waits is superseded.

        Raises:
            Refusal: the queue is full, or the answer would be late; or it is another robot's turn.
        """
        now_s = self._clock()
        pictures = isinstance(request, ImageRequest)
        work = Work(1, self._engine.num_tokens(request), int(pictures))
        place = self._waiting.let_in(session_id, work, deadline_s, now_s)
        session = self._sessions.touch(session_id, now_s)
        outcome = asyncio.get_running_loop().create_future()
        ticket = Ticket(session_id, step, digest, request, place, now_s, outcome)
        self._waiting.seat(session, ticket)
        self._work.set()
        return ticket

    async def wait(self, ticket: Ticket, deadline_s: float) -> Answer:
        """The answer to a ticket. When its last caller leaves, a waiting ticket leaves the queue.

        Args:
            ticket: from :meth:`find` or :meth:`admit`.
            deadline_s: monotonic time at which this caller gives up.

        Raises:
            Refusal: too late, superseded, or the model failed.
        """
        ticket.place.deadline_s = max(ticket.place.deadline_s, deadline_s)
        ticket.callers += 1
        try:
            remaining_s = max(0.0, deadline_s - self._clock())
            # Unlike wait_for, wait leaves the outcome alone when this caller gives up.
            await asyncio.wait([ticket.outcome], timeout=remaining_s)
        finally:
            ticket.callers -= 1
            if ticket.callers == 0 and self._waiting.holds(ticket):
                self._waiting.drop(ticket, self._clock())
        outcome = ticket.outcome.result() if ticket.outcome.done() else too_late(ticket)
        if isinstance(outcome, Refusal):
            raise outcome
        if remaining_s:
            now_s = self._clock()
            self._load.note_lag(now_s - max(outcome.ready_s, deadline_s - remaining_s), now_s)
        return outcome

    async def submit(
        self,
        session_id: str,
        step: int,
        request: AnyRequest,
        deadline_s: float,
        digest: bytes = b"",
    ) -> Answer:
        """Finds or admits a step and waits for its answer.

        Args:
            session_id: name chosen by the robot.
            step: counts up within the session.
            request: what the model needs.
            deadline_s: monotonic time after which the answer is of no use.
            digest: fingerprint of the content; a repeat must have the same.

        Raises:
            Refusal: see :meth:`find`, :meth:`admit` and :meth:`wait`.
        """
        ticket = self.find(session_id, step, digest)
        if ticket is None:
            ticket = self.admit(session_id, step, request, digest, deadline_s)
        return await self.wait(ticket, deadline_s)

    async def close(self) -> None:
        """Stops taking batches; whoever waits is refused. A batch in the model is abandoned."""
        if self._task is not None:
            self._task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._task
        self._load.close()
        for session in self._sessions:
            for ticket in (session.queued, session.running):
                if ticket is not None:
                    ticket.resolve(_cut_off(ticket))
        self._waiting.clear()

    async def _dispatch(self) -> None:
        while True:
            await self._work.wait()
            ready_s = self._clock()
            while batch := self._collect():
                ready_s = await self._passes.compute(batch, ready_s)
            self._work.clear()

    def _collect(self) -> list[Session]:
        """Sessions whose observation runs next; what came too late is dropped."""
        batch: list[Session] = []
        for ticket in self._waiting.in_turn():
            if len(batch) == self._max_batch:
                break
            if ticket.place.deadline_s <= self._clock():
                self._waiting.drop(ticket, self._clock())
            else:
                session = self._waiting.take(ticket)
                session.running = ticket
                batch.append(session)
        return batch


def _cut_off(ticket: Ticket) -> Refusal:
    return Refusal(
        Reason.DRAINING,
        f"the server stopped before step {ticket.step} was computed: "
        "send it to another replica, or retry when it is back",
    )
