"""Which table layouts an evaluation uses, kept apart from those of the training."""

from __future__ import annotations

from comvla_sim.experiments.errors import EvaluationError

FIRST_EVALUATION_LAYOUT = 1_000_000
"""Below are the layouts that demonstrations and their validation may use; none is evaluated on."""

LAYOUTS_PER_SEED = 10_000
MAX_EPISODES = LAYOUTS_PER_SEED // 2

_MAX_SEED = (2**32 - FIRST_EVALUATION_LAYOUT) // LAYOUTS_PER_SEED - 1


def evaluation_layout(seed: int, episode: int) -> int:
    """The layout of an episode: the same for every method, K, instruction and condition.

    Args:
        seed: of the evaluation, from 0.
        episode: 0 to ``MAX_EPISODES - 1``.

    Raises:
        EvaluationError: a seed or an episode that has no layout of its own.
    """
    return _layout(seed, episode, 0)


def foreign_layout(seed: int, episode: int) -> int:
    """A layout that no episode of this seed is run in, for pictures of somewhere else."""
    return _layout(seed, episode, MAX_EPISODES)


def _layout(seed: int, episode: int, offset: int) -> int:
    if not 0 <= seed <= _MAX_SEED:
        raise EvaluationError(f"--seed must be from 0 to {_MAX_SEED}, got {seed}")
    if not 0 <= episode < MAX_EPISODES:
        raise EvaluationError(
            f"a seed has {MAX_EPISODES} evaluation layouts, episode {episode} was asked for: "
            "use fewer --episodes and several --seed"
        )
    return FIRST_EVALUATION_LAYOUT + seed * LAYOUTS_PER_SEED + offset + episode
