"""What the demo shows: which instructions, on which tables, over which link."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from comvla_client import LinkProfile
from comvla_sim.channel import RicianChannel
from comvla_sim.experiments.errors import EvaluationError
from comvla_sim.experiments.layouts import MAX_EPISODES, evaluation_layout
from comvla_sim.worlds import Task

LINK = LinkProfile(bandwidth_hz=0.88e6, period_s=0.05, efficiency=0.38)
"""The paper's 20 MHz scaled to tokens of 96 instead of 2176 values, so that K* is the same."""

RICIAN_K = 3.0
DOPPLER_HZ = 10.0

MIN_TOKENS = 16
"""The policy was not trained with fewer. In a deeper fade the robot holds for a period instead."""

DEADLINE_S = 10.0
"""Simulated time stands still while the policy computes: a busy machine shall not change the film."""


def fading(mean_snr_db: float, seed: int) -> RicianChannel:
    """The demo's kind of radio channel.

    Raises:
        LinkError: a mean SNR that is not finite.
    """
    return RicianChannel(mean_snr_db, DOPPLER_HZ, LINK.period_s, seed, rician_k=RICIAN_K)


@dataclass(frozen=True)
class Scene:
    """One episode of the demo.

    Attributes:
        number: from 0.
        task: what the robot is told.
        layout_seed: names the table; never one of the training's.
        channel_seed: names the course of the fading.
    """

    number: int
    task: Task
    layout_seed: int
    channel_seed: int

    def channel(self, mean_snr_db: float) -> RicianChannel:
        """The radio channel of this episode."""
        return fading(mean_snr_db, self.channel_seed)


def scenes(tasks: Sequence[Task], *, seed: int, episodes: int) -> list[Scene]:
    """Episodes that name another fixture each, as long as there are any.

    Args:
        tasks: of the world.
        seed: chooses instructions, tables and fading.
        episodes: how many.

    Raises:
        EvaluationError: fewer than one episode, or more than a seed has tables for.
    """
    if not 1 <= episodes <= MAX_EPISODES:
        raise EvaluationError(f"--episodes must be from 1 to {MAX_EPISODES}, got {episodes}")
    evaluation_layout(seed, 0)  # refuses a seed that has no tables
    random = np.random.RandomState(seed)
    fixtures = list(dict.fromkeys(task.fixture for task in tasks))
    order = [fixtures[i] for i in random.permutation(len(fixtures))]
    chosen = []
    for number in range(episodes):
        fixture = order[number % len(order)]
        about_it = [task for task in tasks if task.fixture == fixture]
        chosen.append(
            Scene(
                number=number,
                task=about_it[random.randint(len(about_it))],
                layout_seed=evaluation_layout(seed, number),
                channel_seed=evaluation_layout(seed, number),
            )
        )
    return chosen
