"""One episode in closed loop with a server that is killed now and then.

The robot runs as robots do: a deadline for each query, and whatever its ``step`` returns is executed.
While no answer comes the world goes on: the control periods of the time that a query took in vain pass,
in which the robot holds. From the second such query of an outage on they pass while the robot waits, as
they would: to simulate them afterwards would keep it from asking.
"""

from __future__ import annotations

import math
import random
import time
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as FutureTimeoutError
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from comvla_client import ActionChunk, ComVLAClient
from comvla_sim.bench.victim import Victim
from comvla_sim.worlds.base import Task, World

_KILL_BEFORE_QUERY = 2
_KILL_WITHIN_S = 0.03


@dataclass
class Outage:
    """One kill.

    Attributes:
        episode: in which it happened.
        down_s: from the kill until the server was back.
        recovery_s: from then until the robot had an answer; 0 where it had one before the server
            even said that it is ready.
        held_periods: in which the robot had no answer to act on.
    """

    episode: int
    down_s: float = 0.0
    recovery_s: float = 0.0
    held_periods: int = 0


@dataclass
class Episode:
    """What came of one.

    Attributes:
        success: within its time limit, which stands still while no server is there.
        success_in_plain_limit: within the world's own.
        periods: that passed.
        held_periods: of those, without an answer to act on.
        outage_periods: of those, while no server was there.
        queries, fallbacks: asked, and not answered.
    """

    success: bool = False
    success_in_plain_limit: bool = False
    periods: int = 0
    held_periods: int = 0
    outage_periods: int = 0
    queries: int = 0
    fallbacks: int = 0


@dataclass
class Run:
    """Episodes that one client drove, one after another.

    Attributes:
        episodes: that are over.
        outages: one for each kill so far.
        exceptions: what the client raised, in words; the claim is that there are none.
    """

    episodes: list[Episode] = field(default_factory=list)
    outages: list[Outage] = field(default_factory=list)
    exceptions: list[str] = field(default_factory=list)


class ClosedLoop:
    """One episode in closed loop.

    Args:
        world: in which the robot acts.
        client: drives the robot.
        victim: the server.
        run: what the episode belongs to; takes down its outages.
        number: of the episode, from 0.
        rng: draws the moments of the kills.
        beside: one thread, in which the robot waits while the world goes on.

    Attributes:
        episode: what came of it so far.
    """

    def __init__(
        self,
        world: World,
        client: ComVLAClient,
        victim: Victim,
        run: Run,
        number: int,
        rng: random.Random,
        beside: ThreadPoolExecutor,
    ) -> None:
        self._world, self._client, self._victim, self._run = world, client, victim, run
        self._number, self._rng, self._beside = number, rng, beside
        self._waiting = False
        self._outage: Outage | None = None
        self._task: Task | None = None
        self.episode = Episode()

    def begin(self, layout_seed: int, task: Task) -> None:
        """Puts the table in order.

        Args:
            layout_seed: of the table.
            task: what the robot is told to do.
        """
        self._client.reset()
        self._observation, _ = self._world.reset(seed=layout_seed, options={"task": task.name})
        self._task = task

    def drive(self, kills: int) -> None:
        """Acts until the task is done or the time is over, and outages with it.

        Args:
            kills: of the server that belong to this episode.

        Raises:
            ServerProcessError: the server did not come back.
        """
        episode, limit = self.episode, self._world.max_episode_steps
        due_at = self._pause()
        while not episode.success and episode.periods - episode.outage_periods < limit:
            if kills and self._outage is None and episode.queries >= due_at:
                self._kill()
                kills -= 1
            began = time.monotonic()
            chunk, passed = self._step()
            if self._account(chunk, began):
                due_at = episode.queries + self._pause()
            if episode.success:  # reached while the robot held
                break
            if chunk.source == "cloud":
                rows = chunk.actions[: max(1, chunk.planned)]
            else:
                took_s = time.monotonic() - began
                held = max(1, math.ceil(took_s / self._client.info.control_period_s)) - passed
                rest = chunk.actions[: chunk.planned]
                hold = np.tile(self._client.hold_action, (max(0, held - len(rest)), 1))
                rows = np.concatenate([rest, hold])
            self._execute(rows, answered=chunk.source == "cloud")
            self._observation = self._world.observe()
        # A kill that found no moment, or whose server is not back yet, belongs to this episode too.
        while kills or self._outage is not None:
            if self._outage is None:
                self._kill()
                kills -= 1
            began = time.monotonic()
            self._account(self._ask(), began)

    def _pause(self) -> int:
        """Answered queries before a kill."""
        return self._rng.randint(1, _KILL_BEFORE_QUERY)

    def _kill(self) -> None:
        self._outage = Outage(self._number)
        self._run.outages.append(self._outage)
        self._victim.kill_and_restart(self._rng.uniform(0.0, _KILL_WITHIN_S))

    def _step(self) -> tuple[ActionChunk, int]:
        """An answer or none, and the periods that passed in the world meanwhile."""
        if not (self._waiting and self._outage is not None):
            return self._ask(), 0
        period_s, passed = self._client.info.control_period_s, 0
        began = time.monotonic()
        call: Future[ActionChunk] = self._beside.submit(self._ask)
        while True:
            next_s = began + (passed + 1) * period_s - time.monotonic()
            try:
                return call.result(max(0.0, next_s)), passed
            except FutureTimeoutError:
                if call.done():  # just now, or with the client's own error
                    return call.result(), passed
                passed += 1
                if not self.episode.success:
                    self._execute(self._client.hold_action[None], answered=False)

    def _ask(self) -> ActionChunk:
        assert self._task is not None
        return self._client.step(self._observation, self._task.instruction)

    def _account(self, chunk: ActionChunk, began: float) -> bool:
        """Counts a query that began then; whether it ended an outage."""
        now = time.monotonic()
        self.episode.queries += 1
        self._waiting = chunk.source != "cloud"
        if self._waiting:
            self.episode.fallbacks += 1
            self._victim.check()
            return False
        outage, victim = self._outage, self._victim
        # An answer that came just before the blow is none after it.
        if outage is not None and victim.struck and (victim.up_again or began > victim.killed_at):
            victim.wait_until_back()  # the robot may be the first to notice
            outage.down_s = victim.back_at - victim.killed_at
            outage.recovery_s = max(0.0, now - victim.back_at)
            self._outage = None
            return True
        return False

    def _execute(self, rows: Any, answered: bool) -> None:
        episode, world = self.episode, self._world
        for action in rows:
            world.advance(action)
            episode.periods += 1
            if not answered:
                episode.held_periods += 1
                if self._outage is not None:
                    episode.outage_periods += 1
                    self._outage.held_periods += 1
            assert self._task is not None
            if world.successes()[self._task.name]:
                episode.success = True
                episode.success_in_plain_limit = episode.periods <= world.max_episode_steps
                break
