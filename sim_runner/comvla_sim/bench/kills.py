"""Closed-loop episodes against a real server that is killed and restarted again and again.

One client drives all episodes (:mod:`comvla_sim.bench.closed_loop`). What is compared with the
undisturbed run is success on the same tables. An episode's time limit does not run while no server is
there; success within the plain limit is reported beside it.

Recovery counts as for a link that vanishes (:mod:`comvla_sim.netlink.flaps`): from the moment at which
the next server says over a fresh connection that it serves, until the robot has an answer.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from comvla_client import ComVLAClient
from comvla_sim.bench import environment
from comvla_sim.bench.closed_loop import ClosedLoop, Episode, Outage, Run
from comvla_sim.bench.victim import Victim
from comvla_sim.demo.server_process import ServerProcessError
from comvla_sim.experiments.layouts import evaluation_layout
from comvla_sim.experiments.policy import load_edge_half
from comvla_sim.experiments.statistics import mcnemar, wilson_interval
from comvla_sim.netlink.flaps import ALLOWED_PERIODS
from comvla_sim.worlds.base import Task, World

__all__ = ["Episode", "KillParameters", "OnEpisode", "Outage", "run"]

OnEpisode = Callable[[int, int], None]
"""Told how many episodes of how many are done."""

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
            runs: list[Run] = []
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
) -> Run:
    run, rng = Run(), random.Random(parameters.seed)
    tasks: list[Task] = list(world.tasks)
    beside = ThreadPoolExecutor(1, "robot")
    for number in range(parameters.episodes):
        owed = kills * (number + 1) // parameters.episodes - len(run.outages)
        layout = evaluation_layout(parameters.seed, number)
        loop = ClosedLoop(world, client, victim, run, number, rng, beside)
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


def _result(
    parameters: KillParameters, undisturbed: Run, disturbed: Run, period_s: float
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
