"""Plain Meta-World environments behind the same interface: one fixture, one task, one sentence.

Here the picture alone tells what to do, so a policy needs no language. For anything about the
influence of words use the tabletop.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import numpy.typing as npt

from comvla_sim.worlds.base import Task
from comvla_sim.worlds.mujoco_world import MujocoWorld
from comvla_sim.worlds.rendering import load_mujoco

# Where the name, read aloud, is no English sentence. Others are their name without dashes.
_INSTRUCTIONS = {
    "assembly-v3": "put the ring onto the peg",
    "basketball-v3": "throw the ball through the hoop",
    "bin-picking-v3": "move the cube into the other bin",
    "box-close-v3": "put the lid on the box",
    "button-press-topdown-v3": "press the button from above",
    "button-press-v3": "press the button",
    "coffee-button-v3": "press the button of the coffee machine",
    "coffee-pull-v3": "pull the mug from the coffee machine",
    "coffee-push-v3": "push the mug under the coffee machine",
    "dial-turn-v3": "turn the dial",
    "disassemble-v3": "take the ring off the peg",
    "door-close-v3": "close the door",
    "door-lock-v3": "lock the door",
    "door-open-v3": "open the door",
    "door-unlock-v3": "unlock the door",
    "drawer-close-v3": "close the drawer",
    "drawer-open-v3": "open the drawer",
    "faucet-close-v3": "turn the faucet off",
    "faucet-open-v3": "turn the faucet on",
    "hammer-v3": "hammer the nail",
    "handle-press-v3": "press the handle down",
    "handle-pull-v3": "pull the handle up",
    "lever-pull-v3": "pull the lever up",
    "peg-insert-side-v3": "insert the peg from the side",
    "pick-place-v3": "pick up the puck and place it at the goal",
    "push-v3": "push the puck to the goal",
    "reach-v3": "reach the goal",
    "shelf-place-v3": "place the cube on the shelf",
    "soccer-v3": "push the ball into the goal",
    "sweep-into-v3": "sweep the cube into the hole",
    "window-close-v3": "close the window",
    "window-open-v3": "open the window",
}


@functools.cache
def task_names() -> tuple[str, ...]:
    """Names of Meta-World's tasks, such as ``"drawer-open-v3"``."""
    load_mujoco(render=False)  # before Meta-World imports mujoco itself
    from metaworld.env_dict import ENV_CLS_MAP
    from metaworld.policies import ENV_POLICY_MAP

    return tuple(sorted(name for name in ENV_CLS_MAP if name in ENV_POLICY_MAP))


class SingleTask(MujocoWorld):
    """The world ``"metaworld:NAME"``: Meta-World's own environment of that name.

    Success is what the environment reports after a step, hence always False before the first one.

    Args:
        name: one of :func:`task_names`.
        image_size: side of a picture in pixels.
        render: False saves the drawing: images are then black.
    """

    def __init__(self, name: str, *, image_size: int = 128, render: bool = True) -> None:
        super().__init__(image_size=image_size, render=render)
        from metaworld.env_dict import ENV_CLS_MAP
        from metaworld.policies import ENV_POLICY_MAP

        sentence = _INSTRUCTIONS.get(name, name.removesuffix("-v3").replace("-", " "))
        self.tasks = (Task(name, sentence, (), name.removesuffix("-v3")),)
        self._env: Any = ENV_CLS_MAP[name]()
        # Ask for the goal in the observation (some experts need it), for a new layout at every
        # reset, and for one that the seed decides. The class has no public way to say so.
        self._env._partially_observable = False
        self._env.__dict__.pop("sawyer_observation_space", None)
        self._env._set_task_called = True
        self._env._freeze_rand_vec = False
        self._env.seeded_rand_vec = True
        self.model, self.data = self._env.model, self._env.data
        self.control_period_s = float(self._env.dt)
        self.max_episode_steps = int(self._env.max_path_length)
        expert_class: Any = ENV_POLICY_MAP[name]
        self._expert = expert_class()
        self._flat = np.zeros(39)
        self._success = False

    def _arrange(self, seed: int, task: Task | None) -> Task:
        self._env.seed(seed)
        self._flat, _ = self._env.reset()
        self._mujoco.mj_forward(self.model, self.data)
        self._success = False
        return self.tasks[0]

    def possible_tasks(self) -> tuple[Task, ...]:
        """The one task of this world."""
        return self.tasks

    def _advance(self, action: npt.NDArray[np.float64]) -> None:
        self._flat, _, _, _, info = self._env.step(action.astype(np.float32))
        self._success = bool(info["success"])

    def _fulfilled(self, task: Task) -> bool:
        return self._success

    def _proprio(self) -> npt.NDArray[np.float32]:
        now = self._env._get_curr_obs_combined_no_goal()
        return np.asarray(now[:4], np.float32)

    def points_of_interest(self, task: Task | str) -> npt.NDArray[np.float64]:
        """(4, 3) in metres: the hand, the first object, the goal, and the object again."""
        self.find_task(task)
        thing = np.asarray(self._env._get_pos_objects(), np.float64)[:3]
        hand = np.asarray(self._env.get_endeff_pos(), np.float64)
        return np.stack([hand, thing, np.asarray(self._env._target_pos, np.float64), thing])

    def expert_action(self, task: Task | str | None = None) -> npt.NDArray[np.float32]:
        """(4,) what Meta-World's expert does now."""
        self.find_task(task)
        action = np.clip(self._expert.get_action(self._flat), -1.0, 1.0)
        return np.asarray(action, np.float32)

    def _extra_state(self) -> Any:
        env = self._env
        return (self._flat.copy(), env._prev_obs.copy(), env.curr_path_length, self._success)

    def _set_extra_state(self, extra: Any) -> None:
        flat, previous, length, self._success = extra
        self._flat, self._env._prev_obs = flat.copy(), previous.copy()
        self._env.curr_path_length = length

    def close(self) -> None:
        """Frees the renderer and the environment."""
        super().close()
        self._env.close()
