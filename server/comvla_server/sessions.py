"""What the server remembers of each robot: enough to answer a repeat, no more."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass

from comvla_server.identity import caller
from comvla_server.refusals import Reason, Refusal
from comvla_server.tickets import Answer, Ticket
from comvla_server.wording import shown


@dataclass(eq=False)
class Session:
    """One session.

    Attributes:
        session_id: name chosen by the robot.
        last_seen_s: monotonic time of its last call.
        owner: name of the identity that opened it; empty where the server asks nobody who they are.
        first_step: the step with which it was first seen here, -1 before that.
        newest_step: highest step admitted so far, -1 before the first.
        queued: its observation that waits, at most one.
        running: its observation inside the model, at most one.
        recorded: the last step that was answered.
        answers: steps answered so far.
    """

    session_id: str
    last_seen_s: float
    owner: str = ""
    first_step: int = -1
    newest_step: int = -1
    queued: Ticket | None = None
    running: Ticket | None = None
    recorded: Ticket | None = None
    answers: int = 0

    @property
    def idle(self) -> bool:
        """True when nothing of this session waits or runs."""
        return self.queued is None and self.running is None

    @property
    def tokens_used(self) -> int | None:
        """K of the last answer, None before the first."""
        if self.recorded is None:
            return None
        outcome = self.recorded.outcome.result()
        return outcome.tokens_used if isinstance(outcome, Answer) else None

    def note_admitted(self, ticket: Ticket) -> None:
        """Lets an observation wait; it is the newest."""
        if self.newest_step < 0:
            self.first_step = ticket.step
        self.newest_step = max(self.newest_step, ticket.step)
        self.queued = ticket

    def note_answered(self, ticket: Ticket) -> int:
        """Puts an answered step on record.

        Returns:
            Steps between it and the answered one before, which the robot had to bridge.
        """
        before = self.first_step - 1 if self.recorded is None else self.recorded.step
        self.recorded = ticket
        self.answers += 1
        return max(0, ticket.step - before - 1)

    def find(self, step: int, digest: bytes) -> Ticket | None:
        """The ticket of a repeated step, or None for a new one.

        Raises:
            Refusal: the step was sent before with other content, or a newer one was admitted.
        """
        for ticket in (self.queued, self.running, self.recorded):
            if ticket is None or ticket.step != step:
                continue
            if ticket.digest != digest:
                raise Refusal(
                    Reason.CONFLICT,
                    f"step {step} of session {shown(self.session_id)} was sent before with other "
                    "content: expected the same bytes for a retry; count steps up for a new "
                    "observation, and give every robot and episode its own session_id",
                )
            return ticket
        if step < self.newest_step:
            raise superseded(self.session_id, step, self.newest_step)
        return None


def superseded(session_id: str, step: int, newest_step: int) -> Refusal:
    """The refusal of an observation for which a newer one came."""
    return Refusal(
        Reason.SUPERSEDED,
        f"step {step} of session {shown(session_id)} was superseded by step {newest_step}: "
        "expected steps to count up, the latest observation wins; drop this one, or use a new "
        "session_id after a reset",
    )


class SessionTable:
    """Sessions by name, bounded: the least recently seen one that is idle leaves first.

    A session belongs to the identity whose call opened it. The table itself asks who calls, so that
    no way to a session can forget to.
    """

    def __init__(self, max_sessions: int, ttl_s: float) -> None:
        self._max_sessions = max_sessions
        self._ttl_s = ttl_s
        self._sessions: OrderedDict[str, Session] = OrderedDict()

    def __len__(self) -> int:
        return len(self._sessions)

    def __iter__(self) -> Iterator[Session]:
        """Least recently seen first."""
        return iter(self._sessions.values())

    def get(self, session_id: str, now_s: float) -> Session | None:
        """The session, or None where it is unknown or was silent for too long.

        Raises:
            Refusal: it belongs to another identity than the caller's.
        """
        session = self._sessions.get(session_id)
        if session is None:
            return None
        if session.idle and now_s - session.last_seen_s > self._ttl_s:
            del self._sessions[session_id]
            return None
        if session.owner != caller().name:
            raise Refusal(
                Reason.NOT_OWNER,
                f"session {shown(session_id)} belongs to another identity than "
                f"{shown(caller().name)}: expected a session of this robot's own; choose another "
                "session_id, or use the token of the robot that opened it",
            )
        return session

    def touch(self, session_id: str, now_s: float) -> Session:
        """The session, made for the caller where it is new; it becomes the most recently seen.

        Raises:
            Refusal: it belongs to another identity than the caller's.
        """
        session = self.get(session_id, now_s)
        if session is None:
            session = Session(session_id, now_s, caller().name)
            self._sessions[session_id] = session
        session.last_seen_s = now_s
        self._sessions.move_to_end(session_id)
        self._evict(session, now_s)
        return session

    def adopt(self, before: SessionTable) -> None:
        """Takes over whose sessions are whose, and how far each is, but no answers: they are another
        model's. A repeat of the newest step is then computed again."""
        for old in before:
            self._sessions[old.session_id] = Session(
                old.session_id,
                old.last_seen_s,
                old.owner,
                first_step=old.newest_step + 1,
                newest_step=old.newest_step,
            )

    def _evict(self, keep: Session, now_s: float) -> None:
        excess = len(self) - self._max_sessions
        leaving: list[str] = []
        for session in self:
            if len(leaving) >= excess and now_s - session.last_seen_s <= self._ttl_s:
                break
            if session.idle and session is not keep:
                leaving.append(session.session_id)
        for session_id in leaving:
            del self._sessions[session_id]
