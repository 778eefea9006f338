"""LIBERO's episodes as OpenVLA-OFT's evaluation runs them."""

from __future__ import annotations

import gc
import os
from typing import Any

import mujoco
import numpy as np

from . import libero_api
from .camera import LazyCamera, camera_poses
from .framing import Message
from .init_states import read_init_states
from .options import Options
from .server import AssetsMissing
from .things import Things

SEED = 0
"""``env.seed(0)`` of the evaluation."""

SETTLING_STEPS = 10
SETTLING_ACTION = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0)
"""Stand still with an open gripper while what the initial state left in the air comes down."""


class Simulation:
    """A suite's simulator: one environment at a time, made anew when the task changes.

    Args:
        options: from the parent.
    """

    def __init__(self, options: Options) -> None:
        self._options = options
        libero_api.use_assets(options.assets)
        self._folder = libero_api.package_folder()
        self._names = libero_api.task_names(options.suite)
        self._task: int | None = None
        self._env: Any = None
        self._camera: LazyCamera | None = None
        self._things: Things | None = None
        self._observation: Any = None
        self._met: list[bool] = []
        libero_api.load()

    # ---------------------------------------------------------------- requests

    def ready(self) -> Message:
        """The tasks of the suite, and versions."""
        tasks = [
            {
                "name": name,
                "instruction": libero_api.instruction_of(name),
                "init_states": len(self._init_states(name)),
            }
            for name in self._names
        ]
        return Message("ok", {"tasks": tasks, "versions": libero_api.versions()})

    def reset(self, request: Message) -> Message:
        """Starts the episode of a task (index) and an initial state (index)."""
        task, init_state = int(request.fields["task"]), int(request.fields["init_state"])
        if self._task != task:
            self._make(task)
        self._place_fixtures(init_state)
        state = self._init_states(self._names[task])[init_state]
        self._observation = self._env.set_init_state(state)
        for _ in range(SETTLING_STEPS):
            self._advance(SETTLING_ACTION)
        things = self._things
        assert things is not None
        fields = {"things": things.names, "sizes": things.sizes(), "goal": self._goal()}
        points = {f"points/{name}": grid for name, grid in things.points().items()}
        base = np.asarray(self._env.env.robots[0].base_pos, np.float64)
        return Message("ok", fields, {**self._reading(), **points, "base": base})

    def step(self, request: Message) -> Message:
        """Executes one action (7,)."""
        self._advance(request.arrays["action"])
        return Message("ok", {}, self._reading())

    def draw(self, request: Message) -> Message:
        """Pictures that belong to the last reading."""
        del request
        if self._camera is None:
            raise RuntimeError("this simulator was started without pictures")
        return Message("ok", {}, {"frames": self._camera.draw()})

    def cameras(self, request: Message) -> Message:
        """Where the cameras are."""
        del request
        return Message("ok", {}, camera_poses(self._env.env))

    def get_state(self, request: Message) -> Message:
        """MuJoCo's state and what robosuite keeps beside it."""
        del request
        env = self._env.env
        robot, data = env.robots[0], env.sim.data._data
        kind = mujoco.mjtState.mjSTATE_INTEGRATION
        buffer = np.empty(mujoco.mj_stateSize(env.sim.model._model, kind))
        mujoco.mj_getState(env.sim.model._model, data, buffer, kind)
        gripper = np.asarray(robot.gripper.current_action, np.float64)
        beside = [robot.controller.goal_pos, robot.controller.goal_ori.reshape(9), gripper]
        return Message("ok", {}, {"state": np.concatenate([*beside, buffer])})

    def set_state(self, request: Message) -> Message:
        """Back to a moment of this episode."""
        env = self._env.env
        robot, data = env.robots[0], env.sim.data._data
        grip = len(robot.gripper.current_action)
        position, rotation, gripper, state = np.split(
            request.arrays["state"], np.cumsum([3, 9, grip])
        )
        mujoco.mj_setState(env.sim.model._model, data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
        mujoco.mj_forward(env.sim.model._model, data)
        robot.gripper.current_action = gripper.copy()
        robot.controller.update(force=True)
        robot.controller.goal_pos = position.copy()
        robot.controller.goal_ori = rotation.reshape(3, 3).copy()
        env._update_observables(force=True)
        self._observation = env._get_observations()
        self._met = self._goals_met()
        return Message("ok", {}, self._reading())

    # ---------------------------------------------------------------- how it is done

    def _init_states(self, name: str) -> np.ndarray[Any, np.dtype[np.float64]]:
        folder = self._folder / "init_files" / self._options.suite
        return read_init_states(folder / f"{name}.pruned_init")

    def _make(self, task: int) -> None:
        self._task = None
        if self._env is not None:
            self._env.close()
        self._env = self._camera = self._things = None
        gc.collect()  # the old OpenGL context must be gone before there is a new one
        options = self._options
        path = self._folder / "bddl_files" / options.suite / f"{self._names[task]}.bddl"
        try:
            self._env = libero_api.make_environment(str(path), offscreen=options.render)
        except (OSError, ValueError) as error:
            missing = _missing_asset(error, options.assets)
            if missing is None:
                raise
            raise AssetsMissing(missing) from error
        if options.render:
            self._camera = LazyCamera(self._env.env, options.image_size, plain=options.plain)
        self._things = Things(self._env.env)
        # robosuite's own list grows with every reset that rebuilds the model; see _place_fixtures.
        self._samplers = list(self._env.env.object_property_initializers)
        self._gripper_at_rest = np.array(self._env.env.robots[0].gripper.current_action)
        self._task = task

    def _place_fixtures(self, init_state: int) -> None:
        """Resets, with fixtures where the evaluation has them in its episode of this number.

        An initial state does not say where stoves and cabinets stand: every reset draws that, and
        the evaluation resets once more for each episode after one ``env.seed(0)``. Each of its
        resets also appends a task's samplers for drawers and knobs to robosuite's list once more,
        and all of them draw. Repeating the draws alone, without rebuilding the model, takes
        milliseconds and gives the same places.
        """
        env = self._env.env
        self._env.seed(SEED)
        for earlier in range(init_state):
            env.object_property_initializers = self._samplers * (earlier + 2)
            env._reset_internal()
        env.object_property_initializers = self._samplers * (init_state + 2)
        self._env.reset()
        # The evaluation rebuilds the gripper; here it would still be on its way of the last episode.
        env.robots[0].gripper.current_action = self._gripper_at_rest.copy()

    def _advance(self, action: Any) -> None:
        self._observation, _, done, _ = self._env.step(np.asarray(action, np.float64))
        self._met = [True] * len(self._goal()) if done else self._goals_met()

    def _goal(self) -> list[list[str]]:
        return [list(part) for part in self._env.env.parsed_problem["goal_state"]]

    def _goals_met(self) -> list[bool]:
        return [bool(self._env.env._eval_predicate(part)) for part in self._goal()]

    def _reading(self) -> dict[str, Any]:
        seen, things = self._observation, self._things
        assert things is not None
        return {
            "eef_pos": np.asarray(seen["robot0_eef_pos"], np.float64),
            "eef_quat": np.asarray(seen["robot0_eef_quat"], np.float64),
            "gripper_qpos": np.asarray(seen["robot0_gripper_qpos"], np.float64),
            "met": np.asarray(self._met, np.bool_),
            "poses": things.poses(),
        }


def _missing_asset(error: Exception, assets: str) -> str | None:
    """The file that is missing, if ``error`` is about one of the assets."""
    named = getattr(error, "filename", None)
    if isinstance(error, FileNotFoundError) and str(named).startswith(assets):
        return os.path.relpath(str(named), assets)
    text = str(error)
    if "rror opening file" not in text or assets not in text:
        return None
    # MuJoCo: Error opening file '/folder/of/assets/textures/wood.png'
    return text[text.index(assets) + len(assets) :].split("'")[0].strip("/\n ")
