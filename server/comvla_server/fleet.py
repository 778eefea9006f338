"""What the robots did lately, for people who watch: bounded, and next to nothing to keep up to date."""

from __future__ import annotations

import math
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from comvla.model_info import ModelInfo
from comvla.v1 import policy_pb2
from comvla_server.calls import CallRecord
from comvla_server.fleet_seconds import CallFigures, Second, Totals
from comvla_server.identity import caller
from comvla_server.refusals import Reason
from comvla_server.validation import SESSION_ID

MOST_ROBOTS = 256
"""Robots with a history; one more drives out the quietest of whoever has most."""

KEPT_SECONDS = 180
"""Length of every history."""

FORGOTTEN_AFTER_S = 60.0
"""Silence after which a robot is taken for gone."""

_INSTRUCTION_CHARS = 200

# Whoever was refused for one of these had a request that this server, or one with the model that it
# names, could have answered. Others may be made up, and nobody gets a row of the table by making
# something up.
_EARNEST = frozenset(
    reason.value
    for reason in (
        Reason.OVERLOAD,
        Reason.PREDICTED_LATE,
        Reason.CONGESTED,
        Reason.FAIR_SHARE,
        Reason.DEADLINE,
        Reason.SUPERSEDED,
        Reason.SHORT,
        Reason.MODEL,
        Reason.UNKNOWN_MODEL,
    )
)
_ANSWERED = frozenset({"ok", "repeat"})
# Nobody bridges more within a silence that is not yet forgotten; larger gaps are made up.
_MOST_BRIDGED = 10_000


@dataclass(eq=False)
class WatchedRobot:
    """One robot through all its episodes.

    Attributes:
        number: of its row, never used again.
        owner: name of its identity; empty where the server asks nobody who they are.
        name: its session without the episode.
        episode: behind the last dot of the session, -1 where there is no number.
        step: last one that it asked for.
        answered_step: last one that was answered, -1 before the first of an episode.
        outcome: of its last call: ok, repeat, or the reason of the refusal.
        seen_s: when that was, seconds since 1970.
        snr_db, snr_age_s: its last report; None where it made none.
        instruction: the last one, cut.
        coding: of what it sends.
        positions: (K,) of its last tokens, most important first.
        model: the model whose tokens these are.
        total: everything since it was first seen.
        seconds: its history.
    """

    number: int
    owner: str
    name: str
    episode: int = -1
    step: int = -1
    answered_step: int = -1
    outcome: str = ""
    seen_s: float = 0.0
    snr_db: float | None = None
    snr_age_s: float | None = None
    instruction: str = ""
    coding: str = ""
    positions: NDArray[np.integer] | None = None
    model: ModelInfo | None = None
    total: Totals = field(default_factory=Totals)
    seconds: deque[Second] = field(default_factory=lambda: deque(maxlen=KEPT_SECONDS))


def robot_of(session_id: str) -> tuple[str, int]:
    """The robot's name and its episode: this project's clients count episodes behind a dot.

    Args:
        session_id: as in a request.

    Returns:
        The session and -1 where it does not end like that.
    """
    name, dot, episode = session_id.rpartition(".")
    if dot and name and episode.isdecimal() and len(episode) <= 9:
        return name, int(episode)
    return session_id, -1


class Fleet:
    """Robots, and the seconds of all of them together. Used from one event loop only.

    Each call costs a few additions, whoever watches. What is kept is bounded by robots x seconds.

    Args:
        clock: seconds since 1970 that never run backwards.
        most_robots: see :data:`MOST_ROBOTS`.

    Attributes:
        total: everything since the start.
        seconds: what happened lately, oldest first; seconds without a call are left out.
        on_change: called after each call with the robot it was of, if it was any robot's.
    """

    def __init__(
        self, clock: Callable[[], float] | None = None, most_robots: int = MOST_ROBOTS
    ) -> None:
        self.clock = clock or _steady_clock()
        self.total = Totals()
        self.seconds: deque[Second] = deque(maxlen=KEPT_SECONDS)
        self.on_change: Callable[[WatchedRobot | None], None] | None = None
        self._most_robots = most_robots
        # By owner, and quietest first, so that one identity cannot crowd the others out.
        self._owners: dict[str, OrderedDict[str, WatchedRobot]] = {}
        self._by_number: dict[int, WatchedRobot] = {}
        self._next_number = 1

    def __len__(self) -> int:
        return len(self._by_number)

    def __iter__(self) -> Iterator[WatchedRobot]:
        """In the order in which they came."""
        return iter(self._by_number.values())

    def robot(self, number: int) -> WatchedRobot | None:
        """The robot of a row, None where it has left."""
        return self._by_number.get(number)

    def note(
        self,
        request: policy_pb2.InferRequest,
        call: CallRecord,
        outcome: str,
        response: policy_pb2.InferResponse | None,
    ) -> None:
        """A call has ended.

        Args:
            request: what was asked; not trusted.
            call: what it brought.
            outcome: ok, repeat, or the reason of the refusal.
            response: None where it was refused.
        """
        now_s = self.clock()
        robot = self._find(request.session_id, outcome)
        snr_db = request.snr_db if request.HasField("snr_db") else None
        if snr_db is not None and not math.isfinite(snr_db):
            snr_db = None
        figures = CallFigures(call.payload_bytes, call.wire_bytes, snr_db)
        if response is not None:
            figures.note_answer(response)
        if robot is not None:
            robot.snr_db = snr_db
            figures.bridged = _describe(robot, request, call, outcome, now_s)
            robot.total.add(figures)
            _current(robot.seconds, now_s).add(figures)
        self.total.add(figures)
        _current(self.seconds, now_s).add(figures)
        if self.on_change is not None:
            self.on_change(robot)

    def forget(self) -> list[int]:
        """Lets go of robots that have been silent for long.

        Returns:
            Their numbers.
        """
        horizon_s = self.clock() - FORGOTTEN_AFTER_S
        gone = [robot for robot in self if robot.seen_s < horizon_s]
        for robot in gone:
            self._remove(robot)
        return [robot.number for robot in gone]

    def _find(self, session_id: str, outcome: str) -> WatchedRobot | None:
        owner = caller().name
        name, _ = robot_of(session_id)
        robots = self._owners.get(owner)
        robot = None if robots is None else robots.get(name)
        if robot is not None:
            assert robots is not None
            robots.move_to_end(name)
            return robot
        if outcome not in _ANSWERED and outcome not in _EARNEST:
            return None
        if not SESSION_ID.fullmatch(session_id):
            return None
        return self._add(owner, name)

    def _add(self, owner: str, name: str) -> WatchedRobot:
        if len(self) >= self._most_robots:
            self.forget()
        if len(self) >= self._most_robots:
            most = max(self._owners.values(), key=len)
            self._remove(next(iter(most.values())))
        robot = WatchedRobot(self._next_number, owner, name)
        self._next_number += 1
        self._owners.setdefault(owner, OrderedDict())[name] = robot
        self._by_number[robot.number] = robot
        return robot

    def _remove(self, robot: WatchedRobot) -> None:
        robots = self._owners[robot.owner]
        del robots[robot.name]
        if not robots:
            del self._owners[robot.owner]
        del self._by_number[robot.number]


def since(seconds: deque[Second], at_s: int) -> Iterable[Second]:
    """The seconds of a history from one on, oldest first."""
    found = []
    for second in reversed(seconds):
        if second.at_s < at_s:
            break
        found.append(second)
    return reversed(found)


def _describe(
    robot: WatchedRobot,
    request: policy_pb2.InferRequest,
    call: CallRecord,
    outcome: str,
    now_s: float,
) -> int:
    """Notes a robot's last call. Returns how many steps it had to bridge before an answer."""
    _, episode = robot_of(request.session_id)
    if episode != robot.episode:
        robot.episode, robot.answered_step = episode, -1
    robot.step, robot.outcome, robot.seen_s = request.step, outcome, now_s
    age_s = request.snr_age_s
    robot.snr_age_s = age_s if request.HasField("snr_age_s") and math.isfinite(age_s) else None
    bridged = 0
    if outcome == "ok":
        if robot.answered_step >= 0:
            bridged = min(_MOST_BRIDGED, max(0, request.step - robot.answered_step - 1))
        robot.answered_step = request.step
    if call.model is not None:  # read, so it is what the model can take
        robot.model, robot.coding = call.model, call.coding
        robot.instruction = request.instruction[:_INSTRUCTION_CHARS]
        robot.positions = call.positions
    return bridged


def _current(seconds: deque[Second], now_s: float) -> Second:
    at_s = int(now_s)
    if not seconds or seconds[-1].at_s != at_s:
        seconds.append(Second(at_s))
    return seconds[-1]


def _steady_clock() -> Callable[[], float]:
    """Seconds since 1970 by the clock of the start: nobody sets this one."""
    offset_s = time.time() - time.monotonic()
    return lambda: offset_s + time.monotonic()
