"""Link flaps: the radio vanishes for a moment, again and again, under a robot that goes on.

The robot asks once in every control period. Its link is cut for 0.1 to 3 s at random moments, silently
as in a fade: packets are lost, nobody is told. What is looked at: that nothing raises, that no older
chunk is executed after a newer one, and how long after the link's return the next answer arrives.
"""

from __future__ import annotations

import json
import random
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection
from typing import Any, Literal

from comvla.errors import LinkError
from comvla_client import ComVLAClient
from comvla_client.budget import LinkProfile
from comvla_sim.bench import environment
from comvla_sim.bench.processes import announce, connected
from comvla_sim.netlink.cloud import SYNTHETIC, cloud_server
from comvla_sim.netlink.link import LinkSettings, NamespaceLink
from comvla_sim.netlink.namespaces import enter
from comvla_sim.netlink.realtime import EMULATED, prefer_this_thread, settle, wait_until
from comvla_sim.netlink.synthetic import INSTRUCTION, SyntheticEdge, observation

ALLOWED_PERIODS = 2.0
_UNDISTURBED_S = 1.0  # before the first flap and after the last


@dataclass(frozen=True)
class FlapParameters:
    """How often and how long the link is away.

    Attributes:
        count: flaps.
        shortest_s: shortest time away.
        longest_s: longest time away.
        between_s: the link is there for this long before each flap, on average.
        delay_ms: one-way delay of the link, milliseconds.
        snr_db: constant while the link is there.
        deadline_s: longest that the robot waits for an answer; one control period.
        at: see :meth:`NamespaceLink.set_up_down`.
        seed: of lengths and moments.
        realtime: robot and server run before ordinary processes.
    """

    count: int = 50
    shortest_s: float = 0.1
    longest_s: float = 3.0
    between_s: float = 1.0
    delay_ms: float = 0.0
    snr_db: float = 10.0
    deadline_s: float = 0.05
    at: Literal["robot", "cloud"] = "cloud"
    seed: int = 0
    realtime: bool = False

    def __post_init__(self) -> None:
        if self.count < 1 or not 0.0 < self.shortest_s <= self.longest_s:
            raise LinkError(
                f"expected at least one flap of 0 < shortest_s <= longest_s, got {self.count} of "
                f"{self.shortest_s!r} to {self.longest_s!r} s"
            )


def run(
    parameters: FlapParameters, on_flap: Callable[[int], None] = lambda done: None
) -> dict[str, Any]:
    """Flaps the link and watches the robot.

    Returns:
        ``environment``, ``parameters``, one object for each flap, and a summary, JSON-able.

    Raises:
        LinkError: without root, or where the robot ended with an exception.
    """
    profile = LinkProfile()
    settings = LinkSettings(profile=profile, delay_s=parameters.delay_ms / 1e3)
    dice = random.Random(parameters.seed)
    gaps: list[tuple[float, float]] = []
    with (
        NamespaceLink(settings) as link,
        cloud_server(link.cloud, SYNTHETIC, realtime=parameters.realtime) as target,
        connected(_serve_robot, link.robot, target, parameters, profile) as (robot, _),
    ):
        link.shape(profile.capacity_bits(parameters.snr_db) / 8 / profile.period_s)
        time.sleep(_UNDISTURBED_S)
        for number in range(parameters.count):
            time.sleep(parameters.between_s * dice.uniform(0.5, 1.5))
            # Evenly over the logarithm: as many below half a second as above.
            away_s = (
                parameters.shortest_s
                * (parameters.longest_s / parameters.shortest_s) ** dice.random()
            )
            down = time.monotonic()
            link.set_up_down(False, at=parameters.at)
            wait_until(down + away_s)
            link.set_up_down(True, at=parameters.at)
            gaps.append((down, time.monotonic()))
            on_flap(number + 1)
        time.sleep(_UNDISTURBED_S)
        steps = _steps(robot)
    flaps = [_flap(down, up, steps, profile.period_s) for down, up in gaps]
    return {
        "bench": "flaps",
        "environment": environment.describe(),
        "parameters": asdict(parameters),
        "summary": _summary(flaps, steps),
        "flaps": flaps,
    }


def _flap(down: float, up: float, steps: list[dict[str, Any]], period_s: float) -> dict[str, Any]:
    answered = [step for step in steps if step["source"] == "cloud" and step["ended"] > up]
    recovery_s = answered[0]["ended"] - up if answered else None
    missed = [s for s in steps if down <= s["ended"] <= up and s["source"] != "cloud"]
    return {
        "away_s": up - down,
        "steps_without_answer": len(missed),
        "recovery_s": recovery_s,
        "recovery_periods": None if recovery_s is None else recovery_s / period_s,
    }


def _summary(flaps: list[dict[str, Any]], steps: list[dict[str, Any]]) -> dict[str, Any]:
    recoveries = [flap["recovery_periods"] for flap in flaps]
    known = [periods for periods in recoveries if periods is not None]
    return {
        "flaps": len(flaps),
        "steps": len(steps),
        "answered": sum(step["source"] == "cloud" for step in steps),
        "exceptions": 0,
        "older_after_newer": older_after_newer([step["chunk"] for step in steps]),
        "within_allowed": sum(p is not None and p <= ALLOWED_PERIODS for p in recoveries),
        "allowed_periods": ALLOWED_PERIODS,
        "median_recovery_periods": statistics.median(known) if known else None,
        "worst_recovery_periods": max(known) if len(known) == len(flaps) else None,
        "longest_step_s": max((step["took_s"] for step in steps), default=0.0),
    }


def older_after_newer(chunks: list[int]) -> int:
    """How often an executed action came from an older chunk than one before it; 0 is holding."""
    newest = wrong = 0
    for chunk in chunks:
        wrong += 0 < chunk < newest
        newest = max(newest, chunk)
    return wrong


def _steps(robot: Connection) -> list[dict[str, Any]]:
    try:
        robot.send_bytes(b"end")
        if robot.poll(30.0):
            steps: list[dict[str, Any]] = json.loads(robot.recv_bytes())
            return steps
    except (OSError, EOFError):
        pass
    raise LinkError("the robot ended with an exception, which is above: this is a defect")


def _serve_robot(
    lifeline: Connection, namespace: str, target: str, parameters: FlapParameters, link: LinkProfile
) -> None:
    enter(namespace)
    if parameters.realtime:
        prefer_this_thread(EMULATED)
    edge = SyntheticEdge()
    with ComVLAClient(
        target,
        edge=edge,
        link=link,
        budget=32,
        snr=parameters.snr_db,
        deadline_s=parameters.deadline_s,
        execute=1,
    ) as client:
        settle()
        announce(lifeline, "robot")
        steps = list(_walk(client, lifeline, link.period_s))
        lifeline.send_bytes(json.dumps(steps).encode())


def _walk(client: ComVLAClient, lifeline: Connection, period_s: float) -> Iterator[dict[str, Any]]:
    obs, period = observation(client.info), 0
    start = time.monotonic()
    while not lifeline.poll():
        wait_until(start + period * period_s)
        began = time.monotonic()
        chunk = client.step(obs, INSTRUCTION)
        ended = time.monotonic()
        # A step that overran its period makes the robot skip one, not run after the clock.
        period = max(period + 1, int((ended - start) / period_s) + 1)
        yield {
            "ended": ended,
            "took_s": ended - began,
            "source": chunk.source,
            "reason": chunk.report.fallback_reason,
            "chunk": int(chunk.actions[0, 0]),
        }
    lifeline.recv_bytes()
