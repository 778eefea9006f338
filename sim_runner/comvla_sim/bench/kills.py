"""Closed-loop episodes against a real server that is killed and restarted again and again.

The robot runs as robots do: one client for all episodes, a deadline for each query, and whatever its
``step`` returns is executed. While no answer comes the world goes on: the control periods of the time
that a query took in vain pass, in which the robot holds. From the second such query of an outage on they
pass while the robot waits, as they would: to simulate them afterwards would keep it from asking. What is
compared with the undisturbed run is success on the same tables. An episode's time limit does not run
while no server is there; success within the plain limit is reported beside it.

Recovery counts as for a link that vanishes (:mod:`comvla_sim.netlink.flaps`): from the moment at which
the next server says over a fresh connection that it serves, until the robot has an answer.
"""

from __future__ import annotations

import math
import random
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as FutureTimeoutError
from contextlib import closing
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from comvla_client import ActionChunk, ComVLAClient
from comvla_sim.bench import environment
from comvla_sim.bench.victim import Victim
from comvla_sim.demo.server_process import ServerProcessError
from comvla_sim.experiments.layouts import evaluation_layout
from comvla_sim.experiments.policy import load_edge_half
from comvla_sim.experiments.statistics import mcnemar, wilson_interval
from comvla_sim.netlink.flaps import ALLOWED_PERIODS
from comvla_sim.worlds.base import Task, World

OnEpisode = Callable[[int, int], None]
"""Told how many episodes of how many are done."""

_KILL_BEFORE_QUERY = 2
_KILL_WITHIN_S = 0.03
_CONNECT_WITHIN_S = 30.0


@dataclass(frozen=True)
class KillParameters:
    """The episodes and what happens to their server.

    Attributes:
        kills: of the server, spread over the episodes.
        episodes: each run twice, with and without kills.
        model: ``"mini"`` or a checkpoint.
        world: name of the world.
        token_budget: K of every query.
        deadline_s: of a query.
        seed: chooses tables and moments of the kills.
    """

    kills: int = 10
    episodes: int = 10
    model: str = "mini"
    world: str = "tabletop"
    token_budget: int = 64
    deadline_s: float = 0.4
    seed: int = 0


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
class _Run:
    episodes: list[Episode] = field(default_factory=list)
    outages: list[Outage] = field(default_factory=list)
    exceptions: list[str] = field(default_factory=list)


def run(
    parameters: KillParameters, on_episode: OnEpisode = lambda done, total: None
) -> dict[str, Any]:
    """Runs the episodes without kills, then with.

    Args:
        parameters: what to run.
        on_episode: told of progress.

    Returns:
        An object with ``environment``, ``parameters``, ``rows`` and figures, JSON-able.
    """
    from comvla_sim.worlds import make

    total = 2 * parameters.episodes
    edge = load_edge_half(parameters.model)
    world = make(parameters.world, image_size=edge.info.image_size[0])
    try:
        with Victim(parameters.model) as victim:
            runs: list[_Run] = []
            for kills in (0, parameters.kills):
                done = len(runs) * parameters.episodes
                with closing(_client(victim.target, edge, parameters)) as client:
                    runs.append(
                        _run(world, client, victim, parameters, kills, done, total, on_episode)
                    )
    finally:
        world.close()
    undisturbed, disturbed = runs
    return _result(parameters, undisturbed, disturbed, edge.info.control_period_s)


def _client(target: str, edge: Any, parameters: KillParameters) -> ComVLAClient:
    return ComVLAClient(
        target,
        edge=edge,
        budget=parameters.token_budget,
        deadline_s=parameters.deadline_s,
        seed=parameters.seed,
        connect_timeout_s=_CONNECT_WITHIN_S,
    )


def _run(
    world: World,
    client: ComVLAClient,
    victim: Victim,
    parameters: KillParameters,
    kills: int,
    done: int,
    total: int,
    on_episode: OnEpisode,
) -> _Run:
    run, rng = _Run(), random.Random(parameters.seed)
    tasks: list[Task] = list(world.tasks)
    beside = ThreadPoolExecutor(1, "robot")
    for number in range(parameters.episodes):
        owed = kills * (number + 1) // parameters.episodes - len(run.outages)
        layout = evaluation_layout(parameters.seed, number)
        loop = _Loop(world, client, victim, run, number, rng, beside)
        try:
            loop.begin(layout, tasks[number % len(tasks)])
            loop.drive(owed)
        except ServerProcessError:
            raise
        except Exception as error:  # the claim is that there is none
            run.exceptions.append(f"episode {number}: {type(error).__name__}: {error}")
        run.episodes.append(loop.episode)
        on_episode(done + number + 1, total)
        if kills > len(run.outages):
            victim.prepare()
    beside.shutdown()
    return run


class _Loop:
    """One episode in closed loop."""

    def __init__(
        self,
        world: World,
        client: ComVLAClient,
        victim: Victim,
        run: _Run,
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
        """Puts the table in order."""
        self._client.reset()
        self._observation, _ = self._world.reset(seed=layout_seed, options={"task": task.name})
        self._task = task

    def drive(self, kills: int) -> None:
        """Acts until the task is done or the time is over, and outages with it."""
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


def _result(
    parameters: KillParameters, undisturbed: _Run, disturbed: _Run, period_s: float
) -> dict[str, Any]:
    # One that an exception cut short has no recovery, and counts as none within any time.
    over = [outage for outage in disturbed.outages if outage.down_s > 0.0]
    recoveries = [outage.recovery_s for outage in over]
    rates = []
    rows = []
    for name, one in (("undisturbed", undisturbed), ("with kills", disturbed)):
        count, successes = len(one.episodes), sum(e.success for e in one.episodes)
        low, high = wilson_interval(successes, count)
        rates.append(successes / count)
        rows.append(
            {
                "name": name,
                "kills": len(one.outages),
                "episodes": count,
                "success": successes / count,
                "success_low": low,
                "success_high": high,
                "success_in_plain_limit": sum(e.success_in_plain_limit for e in one.episodes)
                / count,
                "queries": sum(e.queries for e in one.episodes),
                "fallbacks": sum(e.fallbacks for e in one.episodes),
                "held_periods": sum(e.held_periods for e in one.episodes),
                "exceptions": len(one.exceptions),
            }
        )
    paired = mcnemar(*([e.success for e in one.episodes] for one in (undisturbed, disturbed)))
    return {
        "bench": "kills",
        "environment": environment.describe(),
        "parameters": asdict(parameters),
        "rows": rows,
        "points_lost": 100.0 * (rates[0] - rates[1]),
        "only_undisturbed": paired.only_first,
        "only_with_kills": paired.only_second,
        "p_value": paired.p_value,
        "period_s": period_s,
        "recovery_periods_median": float(np.median(recoveries)) / period_s if recoveries else None,
        "recovery_periods_worst": max(recoveries) / period_s if recoveries else None,
        "recovered_within_2_periods": sum(r <= ALLOWED_PERIODS * period_s for r in recoveries),
        "down_s_median": float(np.median([o.down_s for o in over])) if recoveries else None,
        # The others fell when the task was done already: the robot went on asking, the world stood still.
        "kills_in_motion": sum(outage.held_periods > 0 for outage in disturbed.outages),
        "outages": [asdict(outage) for outage in disturbed.outages],
        "exceptions": undisturbed.exceptions + disturbed.exceptions,
    }
