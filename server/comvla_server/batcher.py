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
from comvla_server.identity import caller
from comvla_server.inference_thread import InferenceThread
from comvla_server.load_control import LoadControl
from comvla_server.load_policy import LoadPolicy
from comvla_server.metrics import Metrics
from comvla_server.occupancy import Occupancy
from comvla_server.passes import Pass, run_pass
from comvla_server.refusals import Reason, Refusal
from comvla_server.sessions import Session, SessionTable, superseded
from comvla_server.tickets import Answer, Place, Ticket
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
        self._max_queue = max_queue
        self._sessions = SessionTable(max_sessions, session_ttl_s)
        self._metrics = metrics or Metrics()
        self._thread = thread or InferenceThread()
        self._clock = clock
        self._load = LoadControl(
            max_batch,
            engine.info.num_tokens,
            load or LoadPolicy(),
            engine.costs if costs is None else costs,
            self._metrics,
            occupancy,
        )
        # Sessions with an observation that waits, in order of arrival. A newer observation replaces
        # the older one in its session, so the session keeps its place in the queue.
        self._queue: dict[str, Session] = {}
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
        return len(self._queue)

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
        self._let_in(session_id, work, deadline_s, now_s, self._load.screen)

    def glance(self, deadline_s: float) -> Refusal | None:
        """Whether one more request like those of late could be answered in time; None where it could."""
        now_s = self._clock()
        work = self._load.usual_work()
        place = Place("", work, deadline_s, deadline_s)
        waiting = [s.queued.place for s in self._queue.values() if s.queued]
        try:
            self._load.predict(place, waiting, now_s, replaces=True)
        except Refusal as late:
            refusal = Refusal(Reason.CONGESTED, late.message, retry_after_s=late.retry_after_s)
            refusal.suggested_tokens = self._load.suggested_tokens(now_s)
            return refusal
        return None

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
        place = self._let_in(session_id, work, deadline_s, now_s, self._load.let_in)
        session = self._sessions.touch(session_id, now_s)
        outcome = asyncio.get_running_loop().create_future()
        ticket = Ticket(session_id, step, digest, request, place, now_s, outcome)
        if session.queued is not None:
            session.queued.resolve(superseded(session_id, session.queued.step, step))
        session.note_admitted(ticket)
        self._queue[session_id] = session
        self._work.set()
        return ticket

    def _let_in(
        self,
        session_id: str,
        work: Work,
        deadline_s: float,
        now_s: float,
        ask: Callable[..., object],
    ) -> Place:
        """The place of a new step, where there is one for it."""
        older = self._queue.get(session_id)
        if older is None and len(self._queue) >= self._max_queue:
            refusal = Refusal(
                Reason.OVERLOAD,
                f"the queue is full: {len(self._queue)} of {self._max_queue} sessions wait for the "
                "model; ask less often, send fewer tokens, or add a replica",
                retry_after_s=max(0.001, self._load.free_s(now_s) - now_s),
            )
            self._load.note_full(now_s)
            refusal.suggested_tokens = self._load.suggested_tokens(now_s)
            raise refusal
        place = Place(caller().name or session_id, work, deadline_s, deadline_s)
        if older is not None and older.queued is not None:
            # The newer observation may wait longer, but it is the robot's turn when it was before.
            place.due_s = min(deadline_s, older.queued.place.due_s)
        waiting = [s.queued.place for s in self._queue.values() if s.queued and s is not older]
        try:
            ask(place, waiting, now_s, replaces=older is not None)
        except Refusal as refusal:
            refusal.suggested_tokens = self._load.suggested_tokens(now_s)
            raise
        return place

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
            session = self._queue.get(ticket.session_id)
            if ticket.callers == 0 and session is not None and session.queued is ticket:
                self._drop(session)
        outcome = ticket.outcome.result() if ticket.outcome.done() else _too_late(ticket)
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
        self._queue.clear()

    async def _dispatch(self) -> None:
        while True:
            await self._work.wait()
            ready_s = self._clock()
            while batch := self._collect():
                ready_s = await self._run(batch, ready_s)
            self._work.clear()

    def _collect(self) -> list[Session]:
        """Sessions whose observation runs next; what came too late is dropped."""
        places = {id(s.queued.place): s for s in self._queue.values() if s.queued is not None}
        batch: list[Session] = []
        for place in self._load.order([s.queued.place for s in places.values() if s.queued]):
            if len(batch) == self._max_batch:
                break
            session = places[id(place)]
            if place.deadline_s <= self._clock():
                self._drop(session)
            else:
                session.running = self._take(session)
                batch.append(session)
        return batch

    def _take(self, session: Session) -> Ticket:
        ticket = session.queued
        assert ticket is not None, "a session in the queue has an observation that waits"
        session.queued = None
        del self._queue[session.session_id]
        return ticket

    def _drop(self, session: Session) -> None:
        """Takes an observation that waits out of the queue, unanswered."""
        ticket = self._take(session)
        self._load.note_unanswered(ticket.place, self._clock())
        ticket.resolve(_too_late(ticket))

    async def _run(self, batch: list[Session], ready_s: float) -> float:
        """One pass; returns when it ended."""
        tickets = [s.running for s in batch if s.running]
        requests = [ticket.request for ticket in tickets if ticket.request]
        work = Work.of(ticket.place.work for ticket in tickets)
        started_s = self._clock()
        self._load.begin(work, started_s)
        try:
            passes = await self._thread.run(
                run_pass, self._engine, requests, self._metrics, self._clock
            )
        except Exception as error:  # not even a SystemExit inside a model may end this loop
            self._metrics.model_errors.inc()
            passes = [Pass(error, len(batch), 0.0, 0.0)] * len(batch)
        ended_s = self._clock()
        succeeded = all(p.batch_size == len(batch) and p.ok for p in passes)
        self._load.end(work, ready_s, ended_s, succeeded=succeeded)
        self._metrics.inference_busy_seconds.inc(ended_s - started_s)
        for session, outcome in zip(batch, passes, strict=True):
            self._finish(session, outcome, started_s, ended_s)
        return ended_s

    def _finish(self, session: Session, outcome: Pass, started_s: float, ended_s: float) -> None:
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


def _too_late(ticket: Ticket) -> Refusal:
    return Refusal(
        Reason.DEADLINE,
        f"step {ticket.step} was not computed within its deadline: expected an answer before it, "
        "none came; allow more time, send fewer tokens, or add a replica",
    )


def _model_failed(ticket: Ticket, error: Exception) -> Refusal:
    return Refusal(
        Reason.MODEL,
        f"expected actions, the model raised {type(error).__name__} on step {ticket.step}; "
        "the server goes on, its log says more",
    )


def _cut_off(ticket: Ticket) -> Refusal:
    return Refusal(
        Reason.DRAINING,
        f"the server stopped before step {ticket.step} was computed: "
        "send it to another replica, or retry when it is back",
    )
