"""LIBERO behind the interface of every world, with the protocol of OpenVLA-OFT's evaluation."""

from __future__ import annotations

from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from comvla_sim.worlds.base import NUM_VIEWS, Info, Observation, Task, World
from comvla_sim.worlds.libero.child.framing import Message
from comvla_sim.worlds.libero.conventions import (
    ACTION_DIM,
    MAX_STEPS,
    gripper_from_policy,
    proprioception,
    upright,
)
from comvla_sim.worlds.libero.errors import ProtocolError
from comvla_sim.worlds.libero.expert import Expert
from comvla_sim.worlds.libero.launch import Launch, launch_from_environment
from comvla_sim.worlds.libero.process import SimulatorProcess
from comvla_sim.worlds.libero.scene import Cameras, Reading, Scene

SUITES = tuple(MAX_STEPS)
IMAGE_SIZE = 256
"""Side of the pictures in the evaluation of OpenVLA-OFT."""

FULL, PLAIN = "full", "plain"
RENDERINGS = (FULL, PLAIN)
"""``"plain"`` leaves out shadows, reflections and multisampling, which saves half of the time."""

# The hand's reach, angles of up to a turn, and fingers of a few centimetres.
_PROPRIO_LOW = (-2.0, -2.0, -2.0, -7.0, -7.0, -7.0, -0.1, -0.1)
_PROPRIO_HIGH = (2.0, 2.0, 3.0, 7.0, 7.0, 7.0, 0.1, 0.1)


class LiberoWorld(World):
    """The worlds ``"libero:SUITE"`` and ``"libero:SUITE:plain"``.

    An episode starts from one of the suite's fixed initial states (50 for each task): state
    ``seed % 50``, or the one that ``reset(options={"init_state": i})`` names. It is as in
    OpenVLA-OFT's evaluation: ``env.seed(0)``, 10 settling steps, 256×256 pictures turned by 180
    degrees, at most 220 (spatial), 280 (object), 300 (goal) or 520 (libero_10) steps, and success
    at the first moment at which the goal is fulfilled.

    Images are (agentview, wrist). The proprioception (8,) is the hand's position, its orientation
    as axis times angle, and the fingers. Actions (7,) are in LIBERO's convention, in which +1
    closes the gripper; :meth:`from_policy` converts a policy's.

    Args:
        suite: one of :data:`SUITES`.
        image_size: side of a picture in pixels.
        render: False saves the drawing: images are then black.
        rendering: ``"full"`` as the benchmark draws, or ``"plain"``.
        launch: how to start the simulator; by default from LIBERO's own environment.

    Raises:
        ValueError: an unknown suite or rendering.
        DependencyError, AssetsError: LIBERO is not set up here; the message says what to do.
        LiberoError: the simulator did not start.
    """

    control_period_s = 0.05

    def __init__(
        self,
        suite: str,
        *,
        image_size: int = IMAGE_SIZE,
        render: bool = True,
        rendering: str = FULL,
        launch: Launch | None = None,
    ) -> None:
        if suite not in SUITES:
            raise ValueError(f"unknown LIBERO suite {suite!r}; there are: {', '.join(SUITES)}")
        if rendering not in RENDERINGS:
            raise ValueError(f"unknown rendering {rendering!r}; there are: {', '.join(RENDERINGS)}")
        super().__init__(
            image_size=image_size,
            render=render,
            action_dim=ACTION_DIM,
            proprio_low=_PROPRIO_LOW,
            proprio_high=_PROPRIO_HIGH,
        )
        self.suite = suite
        self.max_episode_steps = MAX_STEPS[suite]
        if launch is None:
            launch = launch_from_environment(
                suite, image_size, render=render, plain=rendering == PLAIN
            )
        self.assets = launch.assets
        """``"authentic"`` or ``"stand-in"``."""
        self.labels = MappingProxyType({"assets": launch.assets, "rendering": rendering})
        self._simulator = SimulatorProcess(launch.command, launch.variables)
        self.tasks, self._init_states, self.versions = _read_greeting(self._simulator)
        self._reading: Reading | None = None
        self._scene: Scene | None = None
        self._pictures_now: npt.NDArray[np.uint8] | None = None
        self._expert: Expert | None = None
        self._chosen_init_state: int | None = None
        self.init_state = 0
        """Which of the task's fixed initial states this episode started from."""

    # ---------------------------------------------------------------- episodes

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, Info]:
        """Starts an episode.

        Args:
            seed: initial state ``seed % 50``; without a task, the task as well. None draws one.
            options: ``{"task": name}`` and ``{"init_state": index}``, which goes before the seed.

        Returns:
            The first observation, and info with ``init_state``, ``assets`` and what
            :meth:`World.reset` puts there.

        Raises:
            ValueError: an unknown task or option, or an initial state that does not exist.
            LiberoError: the simulator failed.
        """
        options = dict(options or {})
        self._chosen_init_state = options.pop("init_state", None)
        observation, info = super().reset(seed=seed, options=options)
        return observation, {**info, "init_state": self.init_state}

    def _arrange(self, seed: int, task: Task | None) -> Task:
        if task is None:
            # Seeds that follow each other go through the initial states of one task first.
            task = self.tasks[seed // max(self._init_states) % len(self.tasks)]
        index = self.tasks.index(task)
        states = self._init_states[index]
        chosen = self._chosen_init_state
        if chosen is not None and not (isinstance(chosen, int) and 0 <= chosen < states):
            raise ValueError(
                f"task {task.name!r} has initial states 0 to {states - 1}, got {chosen!r}"
            )
        self.init_state = seed % states if chosen is None else chosen
        fields = {"task": index, "init_state": self.init_state}
        answer = self._simulator.ask("reset", fields, timeout_s=600.0)  # it may compile for long
        self._scene = Scene.from_message(answer)
        self._expert = None
        self._take(answer)
        return task

    def possible_tasks(self) -> tuple[Task, ...]:
        """The current task: only its own goal is watched, though others may share its scene."""
        return () if self._task is None else (self._task,)

    def from_policy(self, actions: npt.ArrayLike) -> npt.NDArray[Any]:
        """Actions (..., 7) of an OpenVLA-OFT policy with the gripper as LIBERO wants it."""
        return gripper_from_policy(actions)

    def _advance(self, action: npt.NDArray[np.float64]) -> None:
        self._take(self._simulator.ask("step", arrays={"action": action}))

    def _take(self, answer: Message) -> None:
        self._reading = Reading.from_message(answer)
        self._pictures_now = None

    # ---------------------------------------------------------------- measuring

    @property
    def reading(self) -> Reading:
        """The present moment as the simulator knows it. RuntimeError before the first reset."""
        if self._reading is None:
            raise RuntimeError("no episode is running: call reset() first")
        return self._reading

    @property
    def scene(self) -> Scene:
        """What is on the table. RuntimeError before the first reset."""
        if self._scene is None:
            raise RuntimeError("no episode is running: call reset() first")
        return self._scene

    def _fulfilled(self, task: Task) -> bool:
        del task
        return self.reading.success

    def _proprio(self) -> npt.NDArray[np.float32]:
        reading = self.reading
        return proprioception(reading.eef_pos, reading.eef_quat, reading.gripper_qpos)

    def raw_frames(self) -> npt.NDArray[np.uint8]:
        """(2, S, S, 3) the simulator's own frames of the present moment, upside down."""
        answer = self._simulator.ask("draw")
        frames = answer.arrays.get("frames")
        shape = (NUM_VIEWS, self.image_size, self.image_size, 3)
        if frames is None or frames.shape != shape or frames.dtype != np.uint8:
            raise ProtocolError(f"expected frames of shape {shape} uint8 from the simulator")
        return np.asarray(frames)

    def _pictures(self) -> npt.NDArray[np.uint8]:
        if self._pictures_now is None:
            self._pictures_now = upright(self.raw_frames())
        return np.array(self._pictures_now)

    def project(self, points: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """(views, n, 2): where points (n, 3) appear, u rightwards and v downwards in [0, 1]."""
        arrays = self._simulator.ask("cameras").arrays
        return Cameras(arrays["positions"], arrays["rotations"], arrays["fovy_deg"]).project(points)

    def points_of_interest(self, task: Task | str) -> npt.NDArray[np.float64]:
        """(4, 3) in metres: the hand, the object to move, where it goes, and the object again."""
        self.find_task(task)
        reading, scene = self.reading, self.scene
        # The first part of the goal that is still to do; the last one when all are done.
        index = int(np.argmin(reading.met)) if not reading.success else len(scene.goal) - 1
        names = scene.goal[index][1:]
        first, last = (
            reading.poses[scene.things[name].index, :3] for name in (names[0], names[-1])
        )
        return np.stack([reading.eef_pos, first, last, first])

    def expert_action(self, task: Task | str | None = None) -> npt.NDArray[np.float32]:
        """(7,) what the scripted expert does now.

        Raises:
            ExpertError: it does not know how to do this task.
        """
        self.find_task(task)
        if self._expert is None:
            self._expert = Expert(self.scene)
        return self._expert.act(self.reading, self._steps)

    @property
    def expert_grasps(self) -> int:
        """How many grasps the expert has begun in this episode."""
        return 0 if self._expert is None else self._expert.attempt + 1

    # ---------------------------------------------------------------- coming back

    def _simulator_state(self) -> npt.NDArray[np.float64]:
        return np.asarray(self._simulator.ask("get_state").arrays["state"])

    def _set_simulator_state(self, state: npt.NDArray[np.float64]) -> None:
        self._take(self._simulator.ask("set_state", arrays={"state": state}))

    def _extra_state(self) -> Any:
        return None if self._expert is None else self._expert.copy()

    def _set_extra_state(self, extra: Any) -> None:
        self._expert = None if extra is None else extra.copy()

    def close(self) -> None:
        """Ends the simulator's process; harmless when repeated."""
        self._simulator.close()


def _read_greeting(
    simulator: SimulatorProcess,
) -> tuple[tuple[Task, ...], tuple[int, ...], dict[str, str]]:
    """The suite's tasks, how many initial states each has, and versions."""
    fields = simulator.greeting.fields
    try:
        tasks = tuple(Task(t["name"], t["instruction"], (), t["name"]) for t in fields["tasks"])
        states = tuple(int(t["init_states"]) for t in fields["tasks"])
        versions = {str(name): str(version) for name, version in fields["versions"].items()}
        if not tasks or min(states) < 1:
            raise ValueError("no tasks")
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        simulator.close()
        raise ProtocolError(f"the simulator introduced itself oddly: {error!r}") from error
    return tasks, states, versions
