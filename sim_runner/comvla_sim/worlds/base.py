"""What every world is: a Gymnasium environment with pictures, proprioception and an instruction."""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

Observation = dict[str, npt.NDArray[Any]]
Info = dict[str, Any]
StepResult = tuple[Observation, float, bool, bool, Info]

ACTION_DIM = 4
"""Of Meta-World's arm: motion of the hand along x, y, z (1 is one centimetre a step) and the
gripper (1 closes)."""

NUM_VIEWS = 2


@dataclass(frozen=True)
class Task:
    """Something a robot can be told to do.

    Attributes:
        name: the identifier, e.g. ``"drawer-open"``.
        instruction: the sentence a policy gets.
        paraphrases: other sentences with the same meaning.
        fixture: the thing that the task is about.
    """

    name: str
    instruction: str
    paraphrases: tuple[str, ...]
    fixture: str


@dataclass(frozen=True)
class WorldState:
    """A moment of an episode, as :meth:`World.get_state` returns it. Valid in that episode only."""

    simulator: npt.NDArray[np.float64]
    steps: int
    episode: int
    extra: Any = None


class World(gymnasium.Env[Observation, npt.NDArray[np.float32]]):
    """A simulated robot before a table, told in words what to do.

    Observations are ``{"images": (2, S, S, 3) uint8 RGB, "proprio": (P,) float32}``. Actions are
    (A,) float32 in [-1, 1]. The reward is 1 in the step in which the current task succeeds, which
    also terminates the episode, else 0.

    Subclasses set :attr:`tasks` and implement the abstract methods.

    Args:
        image_size: side of a picture in pixels.
        render: False saves the drawing: the images of every observation are then black.
        action_dim: A.
        proprio_low: (P,) least values of the proprioception.
        proprio_high: (P,) greatest values.
    """

    tasks: tuple[Task, ...]
    control_period_s: float
    max_episode_steps: int
    labels: Mapping[str, str] = MappingProxyType({})
    """What has to be said with every figure measured here; it goes into info and result rows."""
    versions: Mapping[str, str] = MappingProxyType({})
    """Of a simulator that runs in another Python than this one."""
    model: Any = None
    data: Any = None
    observation_space: spaces.Dict  # type: ignore[assignment]

    def __init__(
        self,
        *,
        image_size: int,
        render: bool,
        action_dim: int,
        proprio_low: Sequence[float],
        proprio_high: Sequence[float],
    ) -> None:
        if image_size < 1:
            raise ValueError(f"image_size must be at least 1 pixel, got {image_size}")
        self.image_size = image_size
        self.action_dim = action_dim
        pictures = (NUM_VIEWS, image_size, image_size, 3)
        low, high = np.asarray(proprio_low, np.float32), np.asarray(proprio_high, np.float32)
        self.observation_space = spaces.Dict(
            {
                "images": spaces.Box(0, 255, pictures, np.uint8),
                "proprio": spaces.Box(low, high),
            }
        )
        self.action_space = spaces.Box(-1.0, 1.0, (action_dim,), np.float32)
        self._render = render
        self._task: Task | None = None
        self._steps = 0
        self._episode = 0

    # ---------------------------------------------------------------- what a subclass implements

    @abc.abstractmethod
    def _arrange(self, seed: int, task: Task | None) -> Task:
        """Puts the layout of ``seed`` on the table and returns the task, drawn if None."""

    @abc.abstractmethod
    def _advance(self, action: npt.NDArray[np.float64]) -> None:
        """Moves the simulation by one control period. ``action`` is (A,) in [-1, 1]."""

    @abc.abstractmethod
    def _fulfilled(self, task: Task) -> bool:
        """Whether the present state fulfils ``task``, which is possible in this layout."""

    @abc.abstractmethod
    def possible_tasks(self) -> tuple[Task, ...]:
        """The tasks that the present layout allows, in the order of :attr:`tasks`."""

    @abc.abstractmethod
    def expert_action(self, task: Task | str | None = None) -> npt.NDArray[np.float32]:
        """(A,) what a scripted expert does now for ``task``, by default the current one."""

    @abc.abstractmethod
    def points_of_interest(self, task: Task | str) -> npt.NDArray[np.float64]:
        """(4, 3) in metres: the hand, the object to touch, its goal, and the fixture's centre."""

    @abc.abstractmethod
    def _proprio(self) -> npt.NDArray[np.float32]:
        """(P,) what the policy is told about the robot."""

    @abc.abstractmethod
    def _pictures(self) -> npt.NDArray[np.uint8]:
        """(2, S, S, 3) RGB of the present state; called only where there is drawing."""

    @abc.abstractmethod
    def project(self, points: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """(views, n, 2): where points (n, 3) appear, u rightwards and v downwards in [0, 1]."""

    @abc.abstractmethod
    def _simulator_state(self) -> npt.NDArray[np.float64]:
        """(n,) everything that the simulator needs to come back to this moment."""

    @abc.abstractmethod
    def _set_simulator_state(self, state: npt.NDArray[np.float64]) -> None:
        """Puts back what :meth:`_simulator_state` returned."""

    def _extra_state(self) -> Any:
        """Whatever the subclass keeps outside MuJoCo's state and changes during an episode."""
        return None

    def _set_extra_state(self, extra: Any) -> None:
        """Puts back what :meth:`_extra_state` returned."""

    # ---------------------------------------------------------------- the public interface

    @property
    def task(self) -> Task:
        """The current task. RuntimeError before the first reset."""
        if self._task is None:
            raise RuntimeError("no episode is running: call reset() first")
        return self._task

    def find_task(self, task: Task | str | None) -> Task:
        """The task of that name, or the current one for None; ValueError for an unknown name."""
        if task is None:
            return self.task
        name = task if isinstance(task, str) else task.name
        for known in self.tasks:
            if known.name == name:
                return known
        raise ValueError(f"unknown task {name!r}; this world has {[t.name for t in self.tasks]}")

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, Info]:
        """Starts an episode.

        Args:
            seed: names the layout; the same seed gives the same layout and picture everywhere.
                None draws one.
            options: ``{"task": name}`` asks for a task; the layout of ``seed`` is changed only
                where the task's fixture is not part of it. Without it the seed also draws a task.

        Returns:
            The first observation, and info with ``task``, ``instruction``, ``success`` (False) and
            ``possible_tasks``.

        Raises:
            ValueError: for an unknown task or option, or a seed outside [0, 2**32).
        """
        options = dict(options or {})
        name = options.pop("task", None)
        if options:
            raise ValueError(f"unknown options {sorted(options)}; reset() understands 'task'")
        task = None if name is None else self.find_task(name)
        if seed is not None and not 0 <= seed < 2**32:
            raise ValueError(f"a seed is an integer in [0, 2**32), got {seed}")
        super().reset(seed=seed)
        if seed is None:
            seed = int(self.np_random.integers(2**32))
        self._task = self._arrange(seed, task)
        self._steps = 0
        self._episode += 1
        done = [name for name, fulfilled in self.successes().items() if fulfilled]
        if done:
            raise RuntimeError(f"layout {seed} starts with {done} fulfilled; its ranges are wrong")
        info: Info = {
            "task": self._task.name,
            "instruction": self._task.instruction,
            "success": False,
            "possible_tasks": tuple(t.name for t in self.possible_tasks()),
            **self.labels,
        }
        return self.observe(), info

    def advance(self, action: npt.ArrayLike) -> None:
        """Executes one action without drawing a picture; values beyond [-1, 1] are clipped."""
        checked = np.asarray(action, dtype=np.float64)
        if checked.shape != (self.action_dim,) or not np.isfinite(checked).all():
            raise ValueError(f"an action is {self.action_dim} finite numbers, got {action!r}")
        if self._task is None:
            raise RuntimeError("no episode is running: call reset() first")
        self._advance(np.clip(checked, -1.0, 1.0))
        self._steps += 1

    def step(self, action: npt.ArrayLike) -> StepResult:
        """Executes one action (A,). Info holds ``success`` and ``successes`` of possible tasks."""
        return self.step_chunk(np.asarray(action)[None])

    def step_chunk(self, actions: npt.ArrayLike | Sequence[npt.ArrayLike]) -> StepResult:
        """Executes actions (H, A) one after another and draws once, at the end.

        Stops early when the task succeeds or the episode is over; ``info["steps"]`` says how many
        actions were executed.
        """
        chunk = np.asarray(actions, dtype=np.float64)
        if chunk.ndim != 2 or not len(chunk):
            raise ValueError(
                f"a chunk is (H, {self.action_dim}) with H >= 1, got shape {chunk.shape}"
            )
        success = truncated = False
        executed = 0
        for action in chunk:
            self.advance(action)
            executed += 1
            success = self._fulfilled(self.task)
            truncated = not success and self._steps >= self.max_episode_steps
            if success or truncated:
                break
        info: Info = {
            "success": success,
            "successes": self.successes(),
            "steps": executed,
            **self.labels,
        }
        return self.observe(), float(success), success, truncated, info

    def successes(self) -> dict[str, bool]:
        """For every possible task, whether the present state fulfils it."""
        return {task.name: self._fulfilled(task) for task in self.possible_tasks()}

    def observe(self) -> Observation:
        """The observation of the present state."""
        if self._render:
            return {"images": self._pictures(), "proprio": self._proprio()}
        black = np.zeros((NUM_VIEWS, self.image_size, self.image_size, 3), np.uint8)
        return {"images": black, "proprio": self._proprio()}

    def proprio(self) -> npt.NDArray[np.float32]:
        """The proprioception (P,) of the present state, without a picture of it."""
        return self._proprio()

    def from_policy(self, actions: npt.ArrayLike) -> npt.NDArray[Any]:
        """Actions (..., A) as a policy of this world says them, in this world's own convention."""
        return np.asarray(actions)

    def get_state(self) -> WorldState:
        """The present moment, to come back to with :meth:`set_state` within this episode."""
        return WorldState(self._simulator_state(), self._steps, self._episode, self._extra_state())

    def set_state(self, state: WorldState) -> None:
        """Goes back to a moment of this episode. ValueError for a state of another episode."""
        if state.episode != self._episode:
            raise ValueError(
                "this state belongs to another episode: the fixtures may stand elsewhere now"
            )
        self._set_simulator_state(state.simulator)
        self._steps = state.steps
        self._set_extra_state(state.extra)

    def close(self) -> None:
        """Frees what the world holds; harmless when repeated."""
