"""Who waits for the model: who gets a place, and whose turn it is."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

from comvla_server.cost_model import Work
from comvla_server.identity import caller
from comvla_server.load_control import LoadControl
from comvla_server.refusals import Reason, Refusal
from comvla_server.sessions import Session, superseded
from comvla_server.tickets import Place, Ticket


class WaitingRoom:
    """Sessions with an observation that waits, a bounded number of them.

    One observation per session waits at most. A newer one takes the place of the older one, so that
    the session keeps its turn. Where all places are taken, a robot with fewer of them than another
    gets one of that one's: whoever opens many sessions keeps nobody out.

    Args:
        size: most sessions that may wait.
        load: what the model can do, and who gets it.
    """

    def __init__(self, size: int, load: LoadControl) -> None:
        self._size = size
        self._load = load
        self._sessions: dict[str, Session] = {}  # in order of arrival

    def __len__(self) -> int:
        return len(self._sessions)

    def screen(self, session_id: str, work: Work, deadline_s: float, now_s: float) -> None:
        """Whether a new step would get a place; nothing is kept for it.

        Args:
            session_id: name chosen by the robot.
            work: what it would add to a forward pass.
            deadline_s: monotonic time after which the answer is of no use.
            now_s: the time.

        Raises:
            Refusal: see :meth:`let_in`.
        """
        self._find_place(session_id, work, deadline_s, now_s, self._load.screen)

    def let_in(self, session_id: str, work: Work, deadline_s: float, now_s: float) -> Place:
        """The place of a new step, which is now counted as let in.

        Args:
            session_id: name chosen by the robot.
            work: what it adds to a forward pass.
            deadline_s: monotonic time after which the answer is of no use.
            now_s: the time.

        Raises:
            Refusal: the room is full, or the answer would be late; or it is another robot's turn.
        """
        place, evicted = self._find_place(session_id, work, deadline_s, now_s, self._load.let_in)
        if evicted is not None:
            refusal = self._full(now_s, Reason.FAIR_SHARE, "open fewer sessions at once")
            self.drop(evicted, now_s, refusal)
        return place

    def glance(self, deadline_s: float, now_s: float) -> Refusal | None:
        """Whether one more request like those of late could be answered in time; None where it could."""
        work = self._load.usual_work()
        place = Place("", work, deadline_s, deadline_s)
        try:
            self._load.predict(place, self._places(), now_s, replaces=True)
        except Refusal as late:
            refusal = Refusal(Reason.CONGESTED, late.message, retry_after_s=late.retry_after_s)
            refusal.suggested_tokens = self._load.suggested_tokens(now_s)
            return refusal
        return None

    def seat(self, session: Session, ticket: Ticket) -> None:
        """Lets an observation wait in the place it was given; an older one of its session is superseded."""
        if session.queued is not None:
            session.queued.resolve(superseded(session.session_id, session.queued.step, ticket.step))
        session.note_admitted(ticket)
        self._sessions[session.session_id] = session

    def holds(self, ticket: Ticket) -> bool:
        """Whether it still waits."""
        session = self._sessions.get(ticket.session_id)
        return session is not None and session.queued is ticket

    def in_turn(self) -> list[Ticket]:
        """Whoever waits, first to be computed first."""
        tickets = {id(s.queued.place): s.queued for s in self._sessions.values() if s.queued}
        return [tickets[id(place)] for place in self._load.order(self._places())]

    def take(self, ticket: Ticket) -> Session:
        """Takes an observation that waits out of the room; its session."""
        session = self._sessions.pop(ticket.session_id)
        assert session.queued is ticket, "only an observation that waits can be taken"
        session.queued = None
        return session

    def drop(self, ticket: Ticket, now_s: float, why: Refusal | None = None) -> None:
        """Takes an observation that waits out of the room, unanswered.

        Args:
            ticket: of the observation.
            now_s: the time.
            why: what its callers are told; that it is too late where None.
        """
        self.take(ticket)
        self._load.note_unanswered(ticket.place, now_s)
        ticket.resolve(too_late(ticket) if why is None else why)

    def clear(self) -> None:
        """Nobody waits any more."""
        self._sessions.clear()

    def _places(self, *but: Session | None) -> list[Place]:
        """Places that are taken, in order of arrival."""
        taken = (s for s in self._sessions.values() if all(s is not other for other in but))
        return [s.queued.place for s in taken if s.queued]

    def _find_place(
        self,
        session_id: str,
        work: Work,
        deadline_s: float,
        now_s: float,
        ask: Callable[..., object],
    ) -> tuple[Place, Ticket | None]:
        """The place of a new step, where there is one for it, and whose place it is where none was free."""
        robot = caller().name or session_id
        older, evicted = self._sessions.get(session_id), None
        if older is None and len(self) >= self._size:
            evicted = self._last_of_many(robot)
            if evicted is None:
                self._load.note_full(now_s)
                raise self._full(now_s, Reason.OVERLOAD, "ask less often, send fewer tokens")
        place = Place(robot, work, deadline_s, deadline_s)
        if older is not None and older.queued is not None:
            # The newer observation may wait longer, but it is the robot's turn when it was before.
            place.due_s = min(deadline_s, older.queued.place.due_s)
        leaving = None if evicted is None else self._sessions[evicted.session_id]
        try:
            ask(place, self._places(older, leaving), now_s, replaces=older is not None)
        except Refusal as refusal:
            refusal.suggested_tokens = self._load.suggested_tokens(now_s)
            raise
        return place, evicted

    def _last_of_many(self, robot: str) -> Ticket | None:
        """The observation, of whom most wait, that would be computed last; None where none has more than this robot."""
        counts = Counter(place.robot for place in self._places())
        most, count = counts.most_common(1)[0]
        if count < counts[robot] + 2:  # else the next one would only take it back
            return None
        return next(t for t in reversed(self.in_turn()) if t.place.robot == most)

    def _full(self, now_s: float, reason: Reason, remedy: str) -> Refusal:
        refusal = Refusal(
            reason,
            f"the queue is full: {len(self)} of {self._size} sessions wait for the model; "
            f"{remedy}, or add a replica",
            retry_after_s=max(0.001, self._load.free_s(now_s) - now_s),
        )
        refusal.suggested_tokens = self._load.suggested_tokens(now_s)
        return refusal


def too_late(ticket: Ticket) -> Refusal:
    """The refusal of an observation that nobody waits for any more."""
    return Refusal(
        Reason.DEADLINE,
        f"step {ticket.step} was not computed within its deadline: expected an answer before it, "
        "none came; allow more time, send fewer tokens, or add a replica",
    )
