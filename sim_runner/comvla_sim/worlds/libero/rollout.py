"""Episodes of the scripted expert: whether the world can be solved at all, and by whom."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from typing import Any

from comvla_sim.worlds.libero.errors import ExpertError
from comvla_sim.worlds.libero.world import LiberoWorld


def run_expert(world: LiberoWorld, task: str, init_state: int) -> dict[str, Any]:
    """One episode of the expert through the world's own interface.

    Args:
        world: is reset here.
        task: name of a task.
        init_state: one of its fixed initial states.

    Returns:
        JSON values: ``task``, ``instruction``, ``init_state``, ``success``, ``steps``, ``grasps``
        (how many it took), ``reason`` (why it was not tried, or None), the world's labels, and the
        seconds that resetting and stepping took.
    """
    started_s = time.perf_counter()
    _, info = world.reset(seed=0, options={"task": task, "init_state": init_state})
    reset_s = time.perf_counter() - started_s
    steps, success, reason = 0, False, None
    while steps < world.max_episode_steps and not success:
        try:
            action = world.expert_action()
        except ExpertError as error:
            reason = str(error)
            break
        _, _, success, _, step_info = world.step(action)
        steps += step_info["steps"]
    return {
        "task": task,
        "instruction": info["instruction"],
        "init_state": init_state,
        "success": success,
        "steps": steps,
        "grasps": world.expert_grasps,
        "reason": reason,
        **world.labels,
        "reset_s": round(reset_s, 3),
        "stepping_s": round(time.perf_counter() - started_s - reset_s, 3),
    }


def run_experts(
    world: LiberoWorld, tasks: Sequence[str], init_states: Sequence[int]
) -> Iterator[dict[str, Any]]:
    """Episodes of every task from every initial state, task by task."""
    for task in tasks:
        for init_state in init_states:
            yield run_expert(world, task, init_state)
