"""``comvla-sim demo --fleet N``: robots that go on and on, for whoever watches the server's page."""

from __future__ import annotations

import contextlib
import itertools
import math
import multiprocessing
import signal
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import cast

from comvla.errors import ComVLAError
from comvla_client import ComVLAClient
from comvla_client.edge import EdgeModel
from comvla_client.transport import GrpcTransport
from comvla_sim import worlds
from comvla_sim.demo.episode import Episode, run_episode
from comvla_sim.demo.scenario import LINK, MIN_TOKENS, Scene, fading, scenes
from comvla_sim.experiments.layouts import MAX_EPISODES
from comvla_sim.link import EnforcedLink

_SPREAD_DB = 6.0
_DEADLINE_S = 2.0
_STOPS_WITHIN_S = 10.0
_SUCCESS = b"+"


class FleetError(ComVLAError, RuntimeError):
    """A robot of the fleet ended by itself."""


class _Stopped(Exception):
    """The fleet is called back."""


@dataclass(frozen=True)
class FleetPlan:
    """Which robots, where.

    Attributes:
        target: the server's gRPC address.
        model: mini or a checkpoint folder.
        robots: how many.
        mean_snr_db: of the robot in the middle; the others stand up to 6 dB nearer or further away.
        seed: of tables and fading.
    """

    target: str
    model: str
    robots: int
    mean_snr_db: float
    seed: int

    def snr_db(self, number: int) -> float:
        """Mean SNR of a robot's link, dB."""
        if self.robots == 1:
            return self.mean_snr_db
        return self.mean_snr_db + _SPREAD_DB * (2 * number / (self.robots - 1) - 1)


class FleetOfRobots:
    """Arms in closed loop and in real time, each in a process of its own; a context manager.

    Each obeys one instruction after the other on tables of its own, over a fading link of its own.
    A process, because each renders its own cameras, and off-screen rendering is one thread's affair.

    Args:
        plan: which robots.
        on_episode: called with whether a robot succeeded, after each episode.
    """

    def __init__(self, plan: FleetPlan, on_episode: Callable[[bool], None]) -> None:
        self._plan = plan
        self._on_episode = on_episode
        self._robots: list[tuple[BaseProcess, Connection]] = []

    def __enter__(self) -> FleetOfRobots:
        context = multiprocessing.get_context("spawn")
        for number in range(self._plan.robots):
            ours, theirs = context.Pipe()
            robot = context.Process(target=_live, args=(theirs, self._plan, number), daemon=True)
            robot.start()
            theirs.close()
            self._robots.append((robot, ours))
        return self

    def __exit__(self, *_: object) -> None:
        for _robot, lifeline in self._robots:
            lifeline.close()  # the robot sees it in its next control period
        for robot, _lifeline in self._robots:
            robot.join(_STOPS_WITHIN_S)
            if robot.is_alive():
                robot.terminate()
                robot.join()

    def watch(self, seconds: float | None, well: Callable[[], bool]) -> None:
        """Returns when the time is over, or something is no longer well.

        Raises:
            FleetError: a robot ended by itself.
        """
        until = math.inf if seconds is None else time.monotonic() + seconds
        lifelines = {lifeline: number for number, (_, lifeline) in enumerate(self._robots)}
        while well() and (left := until - time.monotonic()) > 0:
            for ready in wait(list(lifelines), timeout=min(left, 0.2)):
                lifeline = cast(Connection, ready)
                try:
                    self._on_episode(lifeline.recv_bytes() == _SUCCESS)
                except (EOFError, OSError):
                    if not well():
                        return
                    raise FleetError(
                        f"arm-{lifelines[lifeline] + 1} ended by itself: its own message is above"
                    ) from None


def _live(lifeline: Connection, plan: FleetPlan, number: int) -> None:
    """One robot, until its lifeline is cut."""
    import torch

    from comvla_sim.experiments.policy import load_edge_half

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's; it cuts the lifeline
    torch.set_num_threads(1)  # small pictures: more threads only wait for each other
    with contextlib.suppress(_Stopped):
        _work(lifeline, plan, number, load_edge_half(plan.model))


def _work(lifeline: Connection, plan: FleetPlan, number: int, edge: EdgeModel) -> None:
    channel = fading(plan.snr_db(number), seed=plan.seed * MAX_EPISODES + number)
    link = EnforcedLink(GrpcTransport(plan.target), channel, LINK)
    client = ComVLAClient(
        link,
        edge=edge,
        link=LINK,
        budget="framed",
        min_tokens=MIN_TOKENS,
        deadline_s=_DEADLINE_S,
        seed=number,
        session_id=f"arm-{number + 1}",
    )
    world = worlds.make("tabletop", image_size=edge.info.image_size[0])
    with client, contextlib.closing(world):
        for scene in _endless(scenes(world.tasks, seed=plan.seed, episodes=64), number):
            pace = _Pace(lifeline, LINK.period_s)
            episode = run_episode(world, client, scene, link=link, on_period=pace)
            try:
                lifeline.send_bytes(_SUCCESS if episode.success else b"-")
            except OSError:
                return
            client.reset()


class _Pace:
    """Lets simulated time pass no quicker than real time, and no longer than wanted."""

    def __init__(self, lifeline: Connection, period_s: float) -> None:
        self._lifeline = lifeline
        self._period_s = period_s
        self._began_s = time.monotonic()

    def __call__(self, episode: Episode) -> None:
        late_s = time.monotonic() - self._began_s - episode.periods * self._period_s
        if late_s > self._period_s:  # a busy machine goes slower, it does not catch up
            self._began_s += late_s
        if self._lifeline.poll(max(0.0, -late_s)):  # nothing is ever said on it: this is its end
            raise _Stopped


def _endless(program: Sequence[Scene], number: int) -> itertools.cycle[Scene]:
    """A robot's scenes: each begins elsewhere in the same program."""
    at = (5 * number) % len(program)
    return itertools.cycle([*program[at:], *program[:at]])
