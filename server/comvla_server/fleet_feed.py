"""What happens in the fleet, as server-sent events for everyone who watches."""

from __future__ import annotations

import asyncio
import contextlib
import json
import secrets
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from comvla.errors import ComVLAError
from comvla_server.fleet import KEPT_SECONDS, Fleet, WatchedRobot, since
from comvla_server.fleet_seconds import COLUMNS

MOST_WATCHERS = 16
"""Pages that may watch at once."""

MOST_WAITING = 16
"""Events that one page may be behind; one more and it is dropped, to begin anew when it can."""

_HEARTBEAT_S = 1.0
# Between two events: a lone step is shown at once, a busy fleet a few times a second.
_PAUSE_S, _PAUSE_OF_MANY_S, _MANY = 0.25, 0.5, 64
# Seconds of history that the first event carries for all robots together, so that encoding it does
# not hold up the robots: ten robots come with all of it.
_FIRST_SECONDS = 2000

Describe = Callable[[], dict[str, Any]]


class TooManyWatchersError(ComVLAError):
    """As many pages watch as may."""


class Watcher:
    """One page's place: a queue that never grows beyond :data:`MOST_WAITING`."""

    def __init__(self) -> None:
        self._events: asyncio.Queue[bytes | None] = asyncio.Queue(MOST_WAITING)
        self.over = False

    async def next(self) -> bytes | None:
        """The next event, None when there will be no more."""
        if self.over and self._events.empty():
            return None
        return await self._events.get()

    def offer(self, event: bytes) -> None:
        """Adds an event; a page that does not keep up is dropped instead."""
        if self._events.full():
            self.drop()
        elif not self.over:
            self._events.put_nowait(event)

    def finish(self) -> None:
        """Ends the stream behind what waits."""
        self.over = True
        if not self._events.full():
            self._events.put_nowait(None)

    def drop(self) -> None:
        """Ends the stream now."""
        while not self._events.empty():
            self._events.get_nowait()
        self.finish()


class FleetFeed:
    """Tells watchers about the fleet. Nothing is collected or encoded while nobody watches.

    An event names the robots that changed, with what may be new of their history: a second that a
    watcher has already is replaced, so events may overlap. The first event of a stream holds it all.

    Args:
        fleet: what is watched.
        describe: the server's own state, for every event.
    """

    def __init__(self, fleet: Fleet, describe: Describe) -> None:
        self._fleet = fleet
        self._describe = describe
        self._watchers: set[Watcher] = set()
        self._changed: dict[int, WatchedRobot] = {}
        self._news = asyncio.Event()
        self._told_s = 0.0
        self._task: asyncio.Task[None] | None = None
        self._boot = secrets.token_hex(8)
        self._closed = False

    @property
    def watchers(self) -> int:
        """Pages that watch."""
        return len(self._watchers)

    def join(self) -> Watcher:
        """A place, with the first event in it. Needs a running event loop.

        Raises:
            TooManyWatchersError: there is none.
        """
        if len(self._watchers) >= MOST_WATCHERS:
            raise TooManyWatchersError(
                f"{len(self._watchers)} pages watch, expected at most {MOST_WATCHERS}: close one, or "
                "look at the dashboards"
            )
        watcher = Watcher()
        self._fleet.forget()
        watcher.offer(self._first_event())
        if self._closed:
            watcher.finish()
            return watcher
        self._watchers.add(watcher)
        self._fleet.on_change = self._note
        if self._task is None or self._task.done():
            self._told_s = self._fleet.clock()
            self._task = asyncio.get_running_loop().create_task(self._tell())
        return watcher

    def part(self, watcher: Watcher) -> None:
        """Gives a place back."""
        self._watchers.discard(watcher)
        if not self._watchers:
            self._fleet.on_change = None
            self._changed.clear()

    async def close(self) -> None:
        """Tells watchers how it ends, and ends every stream."""
        self._closed = True
        if self._task is not None:
            self._task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._task
        event = self._event() if self._watchers else b""
        for watcher in self._watchers:
            watcher.offer(event)
            watcher.finish()

    def _note(self, robot: WatchedRobot | None) -> None:
        if robot is not None:
            self._changed[robot.number] = robot
        self._news.set()

    async def _tell(self) -> None:
        while self._watchers:
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._news.wait(), _HEARTBEAT_S)
            many = len(self._changed) > _MANY
            event = self._event()
            for watcher in list(self._watchers):
                watcher.offer(event)
                if watcher.over:
                    self.part(watcher)
            await asyncio.sleep(_PAUSE_OF_MANY_S if many else _PAUSE_S)

    def _first_event(self) -> bytes:
        robots = list(self._fleet)
        room = min(KEPT_SECONDS, _FIRST_SECONDS // max(1, len(robots)))
        now_s = self._fleet.clock()
        return _encode(
            "hello",
            {
                "boot": self._boot,
                "columns": COLUMNS,
                "kept_seconds": KEPT_SECONDS,
                **self._common(now_s, 0),
                "robots": [_row(robot, int(now_s) - room) for robot in robots],
            },
        )

    def _event(self) -> bytes:
        now_s = self._fleet.clock()
        gone = self._fleet.forget()
        changed, self._changed = self._changed, {}
        self._news.clear()
        from_s, self._told_s = int(self._told_s), now_s
        return _encode(
            "tick",
            {
                **self._common(now_s, from_s),
                "robots": [_row(r, from_s) for n, r in changed.items() if n not in gone],
                "gone": gone,
            },
        )

    def _common(self, now_s: float, from_s: int) -> dict[str, Any]:
        return {
            "now_s": round(now_s, 3),
            "server": {**self._describe(), "watchers": len(self._watchers)},
            "total": asdict(self._fleet.total),
            "seconds": [second.row() for second in since(self._fleet.seconds, from_s)],
            "count": len(self._fleet),
        }


def _row(robot: WatchedRobot, from_s: int) -> dict[str, Any]:
    positions = robot.positions
    return {
        "number": robot.number,
        "owner": robot.owner,
        "name": robot.name,
        "episode": robot.episode,
        "step": robot.step,
        "outcome": robot.outcome,
        "seen_s": round(robot.seen_s, 3),
        "snr_db": robot.snr_db,
        "snr_age_s": robot.snr_age_s,
        "coding": robot.coding,
        "kept": None if positions is None else len(positions),
        "model": "" if robot.model is None else robot.model.name,
        "num_tokens": 0 if robot.model is None else robot.model.num_tokens,
        "total": asdict(robot.total),
        "seconds": [second.row() for second in since(robot.seconds, from_s)],
    }


def _encode(event: str, data: dict[str, Any]) -> bytes:
    """One event; JSON has no line breaks, and all that is not ASCII is escaped."""
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return f"event: {event}\ndata: {text}\n\n".encode()
