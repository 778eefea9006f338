"""One call's way from server to server, until one answers or none is left who may."""

from __future__ import annotations

import math
from typing import Generic

from comvla_client.channel import Attempts
from comvla_client.errors import TransportError
from comvla_client.roster import BUSY, ELSEWHERE, Member, Roster, T

# First what waiting mends, last what it does not; whatever else was said stands between.
_PASSES = {"UNAVAILABLE": 0, BUSY: 2, "FAILED_PRECONDITION": 3, "NOT_FOUND": 3, "UNIMPLEMENTED": 3}


class Search(Generic[T]):
    """Who was asked for one call, and what they said.

    Args:
        roster: who may be asked.
        target: what stands for them, in words.
        timeout_s: longest that the call may take, in seconds.

    Attributes:
        tried: who was asked, and need not be asked again.
    """

    def __init__(self, roster: Roster[T], target: str, timeout_s: float) -> None:
        self._roster = roster
        self._target = target
        self._attempts = Attempts(timeout_s)
        self._nobody = Attempts(timeout_s)  # apart: that nobody was known is not what a server said
        self._errors: list[TransportError] = []
        self._asked_again = False
        self.tried: list[Member[T]] = []

    def remaining_s(self) -> float:
        """Seconds left for the call."""
        return self._attempts.remaining_s()

    def next(self) -> Member[T] | None:
        """Whom to ask; None where everybody was asked, or nobody is known."""
        return self._roster.pick(self.tried) if self._roster.members else None

    def pause_s(self) -> float:
        """Seconds until those who were merely away may be asked again, or somebody may be known.

        That is once where another is there and busy: who is away may be so for long, and whoever is busy
        also said how much it would take, and when.

        Raises:
            TransportError: there is no time for that; what was said, and may pass soonest.
        """
        if not self._errors:
            nobody = f"{self._target} stands for no server that is known"
            return self._nobody.pause_s(TransportError("UNAVAILABLE", nobody))
        busy = self._busy()
        if busy is not None and self._asked_again:
            raise busy
        try:
            pause_s = self._attempts.pause_s(worst(self._errors))
        except TransportError as error:
            if busy is None or busy is error:
                raise
            raise busy from error
        self._asked_again = busy is not None
        self.tried, self._errors = told(self.tried, self._errors)
        return pause_s

    def failed(self, member: Member[T], error: TransportError) -> None:
        """A server did not answer; another may.

        Raises:
            TransportError: no other would, either.
        """
        if error.code not in ELSEWHERE:
            failure = error
            if member.down:
                # Where the server was down already, the clock only cut short the last attempt.
                late = error.code == "DEADLINE_EXCEEDED"
                failure = (self._busy() if late else None) or worst([*self._errors, error])
            if failure is not error:
                raise failure from error
            self._attempts.pause_s(error)  # raises, and says why the call failed
        self.tried.append(member)
        self._errors.append(error)

    def _busy(self) -> TransportError | None:
        """What was said by whoever is busy, and has time first."""
        busy = [error for error in self._errors if error.code == BUSY]
        return worst(busy) if busy else None


def worst(errors: list[TransportError]) -> TransportError:
    """What to go by where every server had a failure: of several that which may pass soonest.

    A server that is away may be back, and the right one: that the others run another model counts only where
    all of them do, and that they are busy where nobody else is left: of those, who has time first.
    """

    def passes(error: TransportError) -> tuple[int, float]:
        retry_s = error.hints.retry_after_s
        return _PASSES.get(error.code, 1), math.inf if retry_s is None else retry_s

    return min(errors, key=passes)


def told(
    tried: list[Member[T]], errors: list[TransportError]
) -> tuple[list[Member[T]], list[TransportError]]:
    """Those who need not be asked again in this step, since they are there and said no; with what they said."""
    pairs = [
        (member, error)
        for member, error in zip(tried, errors, strict=True)
        if error.code != "UNAVAILABLE"
    ]
    return [member for member, _ in pairs], [error for _, error in pairs]
