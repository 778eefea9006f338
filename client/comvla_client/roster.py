"""Whose turn it is among several servers, and which of them had better be left alone."""

from __future__ import annotations

import random
import statistics
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar

from comvla_client.errors import TransportError
from comvla_client.revival import PATIENCE_S, USUAL_TIMES
from comvla_client.targets import Address

PROBE_EVERY_S = 0.1
"""How often a server that is down is asked whether it is back, in seconds; after each answer at the soonest."""

PROBE_TIMEOUT_S = 0.5
"""How long it may take to answer that."""

PROBED_AT_ONCE = 16
"""How many servers that are down are asked at the same time: silent ones must not hold up the rest."""

FOREIGN_FOR_S = 30.0
"""How long a server that runs another model is left alone."""

MOST_PROBED = 2
"""How many others are asked whether they are well where one is silent."""

LOOK_UP_EVERY_S = 30.0
"""How often a name is looked up again while all is well, in seconds."""

LOOK_UP_DOWN_EVERY_S = 1.0
"""The same while a server is down."""

LOOK_UP_NOBODY_EVERY_S = 0.5
"""The same where a call found nobody."""

BUSY = "RESOURCE_EXHAUSTED"
"""The code of a server that has no time, or not for this robot."""

ELSEWHERE = frozenset({"UNAVAILABLE", "FAILED_PRECONDITION", "NOT_FOUND", "UNIMPLEMENTED", BUSY})
"""Codes of one server that say nothing of the others."""

_REMEMBERED = 9


class Closes(Protocol):
    """What a member needs of its transport."""

    def close(self) -> object:
        """Ends calls under way and frees the connection."""


T = TypeVar("T", bound=Closes)


@dataclass(eq=False)
class Member(Generic[T]):
    """One server.

    Attributes:
        address: where it is.
        transport: calls it.
        down: not to be asked while others are there.
        probe_at: when to ask it whether it is back, on ``time.monotonic``.
        probed_at: when it was last asked.
        probing: whether it owes the answer to that.
        calls: under way.
        took_s: seconds of its last answers.
    """

    address: Address
    transport: T
    down: bool = False
    probe_at: float = 0.0
    probed_at: float = 0.0
    probing: bool = False
    calls: int = 0
    took_s: deque[float] = field(default_factory=lambda: deque(maxlen=_REMEMBERED))

    @property
    def patience_s(self) -> float:
        """How long a call may take before something seems to be wrong, in seconds."""
        usual_s = statistics.median(self.took_s) if self.took_s else 0.0
        return max(PATIENCE_S, USUAL_TIMES * usual_s)


class Roster(Generic[T]):
    """Takes turns. May be used from several threads.

    Args:
        make: a transport to an address.
    """

    def __init__(self, make: Callable[[Address], T]) -> None:
        self._make = make
        self._lock = threading.Lock()
        self._members: list[Member[T]] = []
        # Robots that start together begin at different servers.
        self._turn = random.SystemRandom().randrange(1024)

    @property
    def members(self) -> list[Member[T]]:
        """Everybody."""
        with self._lock:
            return list(self._members)

    @property
    def down(self) -> list[Member[T]]:
        """Those that had better be left alone."""
        return [member for member in self.members if member.down]

    def update(self, addresses: Iterable[Address]) -> list[Member[T]]:
        """Takes over what a look-up found; nothing at all is taken for a look-up that failed.

        Returns:
            Those that are gone; their transports are the caller's to close.
        """
        wanted = list(addresses)
        with self._lock:
            known = {member.address: member for member in self._members}
            if not wanted:
                return []
            self._members = [known.get(a) or Member(a, self._make(a)) for a in wanted]
            return [member for a, member in known.items() if a not in wanted]

    def pick(self, tried: Collection[Member[T]] = ()) -> Member[T] | None:
        """Whose turn it is: of those who are well the next that is idle, or at least the next.

        Args:
            tried: who was asked already and had no answer.

        Returns:
            None where everybody was asked.
        """
        with self._lock:
            count = len(self._members)
            order = [self._members[(self._turn + i) % count] for i in range(count)]
            left = [member for member in order if member not in tried]
            if not left:
                return None
            # Sorting is stable: of equals the next in turn comes first.
            chosen = min(left, key=lambda member: (member.down, member.calls))
            self._turn = self._members.index(chosen) + 1
            return chosen

    def others(self, silent: Member[T], tried: Collection[Member[T]]) -> list[Member[T]]:
        """Who may stand in for a server that is silent: few, so that a crowded fleet is not asked by all of its
        robots at once; those first who were well."""
        left = [member for member in self.members if member is not silent and member not in tried]
        random.shuffle(left)
        return sorted(left, key=lambda member: member.down)[:MOST_PROBED]

    def begin(self, member: Member[T]) -> None:
        """A call sets out."""
        with self._lock:
            member.calls += 1

    def end(self, member: Member[T]) -> None:
        """A call is over."""
        with self._lock:
            member.calls -= 1

    def answered(self, member: Member[T], took_s: float) -> None:
        """A call was answered."""
        member.took_s.append(took_s)
        member.down = False

    def failed(self, member: Member[T], error: TransportError) -> None:
        """A call was not, and that says something of the server."""
        if error.code not in ELSEWHERE or error.code == BUSY:
            return  # who is busy is well
        pause_s = 0.0 if error.code == "UNAVAILABLE" else FOREIGN_FOR_S
        self.leave(member, pause_s)

    def leave(self, member: Member[T], pause_s: float = 0.0) -> None:
        """A server had better be left alone for so long, and until it says that it is well."""
        member.down, member.probe_at = True, time.monotonic() + pause_s

    def to_probe(self) -> list[Member[T]]:
        """Those to ask now whether they are back, few at once, who waited longest first.

        What becomes of each is to be told with :meth:`probed`.
        """
        now = time.monotonic()
        with self._lock:
            free = PROBED_AT_ONCE - sum(member.probing for member in self._members)
            due = [m for m in self._members if m.down and not m.probing and m.probe_at <= now]
            chosen = sorted(due, key=lambda member: member.probed_at)[: max(0, free)]
            for member in chosen:
                member.probing, member.probed_at = True, now
            return chosen

    def probed(self, member: Member[T], well: bool) -> None:
        """Whether it said that it is well, which counts unless a call to it failed meanwhile."""
        with self._lock:
            member.probing = False
            if well and member.probe_at <= member.probed_at:
                member.down = False
