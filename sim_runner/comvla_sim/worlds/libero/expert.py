"""A scripted expert for tasks that put things somewhere.

It knows the poses of everything, which a policy does not: above, down, grasp, lift, above the
target, lower, release; and again with another grasp if the thing slipped or missed.
"""

from __future__ import annotations

import copy
import enum
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from comvla_sim.worlds.libero.errors import ExpertError
from comvla_sim.worlds.libero.grasps import Grasp, find_grasps, turn_from_rest
from comvla_sim.worlds.libero.rotations import matrix, rotation_vector
from comvla_sim.worlds.libero.scene import Float64s, Reading, Scene

_METRES_PER_ACTION = 0.05
_RADIANS_PER_ACTION = 0.5
_OPEN, _CLOSE = -1.0, 1.0

_ABOVE_M = 0.08
_CARRY_M = 0.10
_DESCENT_M = 0.25
_NEAR_M = 0.012
_TOUCH_M = 0.006
_TURN_DONE = 0.08
_GRASP_STEPS = 10
_RELEASE_STEPS = 10
_LOST_M = 0.05
_STUCK_STEPS = 4
_SETTLED_STEPS = 8
_STUCK_M = 0.0008
_PHASE_STEPS = 50
_REST_M = 0.04
_GAIN = 0.2
_TURN_GAIN = 2.0

# How the hand is turned when its fingers are along y and it points down.
_REST = np.diag([1.0, -1.0, -1.0])


class Phase(enum.Enum):
    """What the expert is about."""

    ABOVE = enum.auto()
    DOWN = enum.auto()
    GRASP = enum.auto()
    LIFT = enum.auto()
    CARRY = enum.auto()
    LOWER = enum.auto()
    RELEASE = enum.auto()
    RETREAT = enum.auto()


@dataclass(frozen=True)
class _Motion:
    """Where to go: a position in metres, how fast at most (1 is full), and the gripper."""

    target: Float64s
    speed: float
    gripper: float


class Expert:
    """Does the task of a scene, step by step.

    Args:
        scene: what is on the table.
        first_grasp: how many of the grasps to leave out, for another try at the same episode.

    Raises:
        ExpertError: the goal is not only to put things on or in something.
    """

    def __init__(self, scene: Scene, *, first_grasp: int = 0) -> None:
        for part in scene.goal:
            movable = len(part) == 3 and scene.things[part[1]].kind == "object"
            if part[0] not in ("on", "in") or not movable:
                raise ExpertError(
                    f"the expert puts things on or in something; the goal is {' '.join(part)!r}"
                )
        self._scene = scene
        self._phase = Phase.ABOVE
        self._began = 0
        self._attempt = first_grasp
        self._goal = 0
        self._grasp: Grasp | None = None
        self._lift_z = 0.0
        self._held = np.zeros(3)
        self._heights: list[float] = []
        self._bias = np.zeros(3)
        self._last_step = -1
        self._last_action: npt.NDArray[np.float32] = np.zeros(7, np.float32)

    @property
    def attempt(self) -> int:
        """How many grasps it has left behind."""
        return self._attempt

    @property
    def phase(self) -> Phase:
        """What it is about."""
        return self._phase

    def copy(self) -> Expert:
        """Another one in the same state of mind."""
        return copy.copy(self)

    def act(self, reading: Reading, step: int) -> npt.NDArray[np.float32]:
        """What to do now.

        Args:
            reading: the present moment.
            step: its number; asking twice in one step gives the same answer.

        Returns:
            (7,) in LIBERO's convention.
        """
        if step != self._last_step:
            self._last_step = step
            # A finished phase passes on at once, so that no step is lost between them.
            for _ in Phase:
                before = self._phase
                motion = self._plan(reading, step)
                if self._phase is before:
                    break
            self._last_action = self._towards(reading, motion)
        return np.array(self._last_action)

    # ---------------------------------------------------------------- what to do

    def _enter(self, phase: Phase, step: int) -> None:
        self._phase = phase
        self._began = step
        self._heights = []
        self._bias = np.zeros(3)

    def _again(self, step: int) -> None:
        """From the start, with the next grasp."""
        self._attempt += 1
        self._grasp = None
        self._enter(Phase.RETREAT, step)

    def _plan(self, reading: Reading, step: int) -> _Motion:
        """Where to go in this phase; enters the next one if this one is done."""
        if self._grasp is None or self._phase is Phase.ABOVE:
            self._goal = int(np.argmin(reading.met))
        thing = self._pose(reading, self._scene.goal[self._goal][1])
        target = self._pose(reading, self._scene.goal[self._goal][2])
        hand = reading.eef_pos
        late = step - self._began > _PHASE_STEPS
        plan = {
            Phase.ABOVE: self._above,
            Phase.DOWN: self._down,
            Phase.GRASP: self._hold,
            Phase.LIFT: self._lift,
            Phase.CARRY: self._carry,
            Phase.LOWER: self._lower,
            Phase.RELEASE: self._release,
            Phase.RETREAT: self._retreat,
        }[self._phase]
        if late and self._phase is not Phase.RETREAT:
            self._again(step)
            plan = self._retreat
        return plan(reading, hand, thing, target, step)

    def _above(
        self, reading: Reading, hand: Float64s, thing: Float64s, target: Float64s, step: int
    ) -> _Motion:
        del target
        self._grasp = self._choose(reading)
        goal = thing + self._grasp.offset + np.array([0, 0, _ABOVE_M])
        turn = np.linalg.norm(rotation_vector(self._wanted() @ matrix(reading.eef_quat).T))
        if np.linalg.norm(goal[:2] - hand[:2]) < _NEAR_M and turn < _TURN_DONE:
            self._enter(Phase.DOWN, step)
        # Not lower before it is over the place.
        if np.linalg.norm(goal[:2] - hand[:2]) > 3 * _NEAR_M:
            goal[2] = max(goal[2], min(hand[2], goal[2] + 0.05))
        return _Motion(goal, 1.0, _OPEN)

    def _down(
        self, reading: Reading, hand: Float64s, thing: Float64s, target: Float64s, step: int
    ) -> _Motion:
        del reading, target
        assert self._grasp is not None
        goal = thing + self._grasp.offset
        there = hand[2] - goal[2] < _TOUCH_M and np.linalg.norm(goal[:2] - hand[:2]) < _NEAR_M
        if there or self._stuck(hand, _SETTLED_STEPS):
            self._lift_z = float(hand[2])
            self._held = goal
            self._enter(Phase.GRASP, step)
        return _Motion(goal, 0.7, _OPEN)

    def _hold(
        self, reading: Reading, hand: Float64s, thing: Float64s, target: Float64s, step: int
    ) -> _Motion:
        del reading, thing, target
        if step - self._began >= _GRASP_STEPS:
            self._enter(Phase.LIFT, step)
        return _Motion(np.array([*self._held[:2], hand[2]]), 0.3, _CLOSE)

    def _lift(
        self, reading: Reading, hand: Float64s, thing: Float64s, target: Float64s, step: int
    ) -> _Motion:
        del reading
        assert self._grasp is not None
        height = max(self._lift_z, float(target[2])) + _CARRY_M
        if np.linalg.norm(thing + self._grasp.offset - hand) > _LOST_M:
            self._again(step)
        elif hand[2] > height - 0.02:
            self._enter(Phase.CARRY, step)
        return _Motion(np.array([hand[0], hand[1], height]), 1.0, _CLOSE)

    def _carry(
        self, reading: Reading, hand: Float64s, thing: Float64s, target: Float64s, step: int
    ) -> _Motion:
        del reading
        error = target[:2] - thing[:2]
        # High where it came from, low where it goes: a high hand is a stretched arm.
        above = max(self._lift_z - float(target[2]), 0.0)
        far = float(np.clip(np.linalg.norm(error) / _DESCENT_M, 0.0, 1.0))
        height = float(target[2]) + above * far + _CARRY_M
        assert self._grasp is not None
        if np.linalg.norm(thing - hand) > np.linalg.norm(self._grasp.offset) + _LOST_M:
            self._again(step)
        elif np.linalg.norm(error) < _NEAR_M:
            self._enter(Phase.LOWER, step)
        return _Motion(np.array([*(hand[:2] + error), height]), 1.0, _CLOSE)

    def _lower(
        self, reading: Reading, hand: Float64s, thing: Float64s, target: Float64s, step: int
    ) -> _Motion:
        del reading
        if self._stuck(hand, _STUCK_STEPS):
            self._enter(Phase.RELEASE, step)
        goal = np.array([*(hand[:2] + target[:2] - thing[:2]), hand[2] - 0.03])
        return _Motion(goal, 0.6, _CLOSE)

    def _release(
        self, reading: Reading, hand: Float64s, thing: Float64s, target: Float64s, step: int
    ) -> _Motion:
        del reading, thing, target
        if step - self._began >= _RELEASE_STEPS:
            self._again(step)
        return _Motion(hand, 0.0, _OPEN)

    def _retreat(
        self, reading: Reading, hand: Float64s, thing: Float64s, target: Float64s, step: int
    ) -> _Motion:
        del reading, target
        height = float(thing[2]) + 0.15
        if hand[2] > height - 0.02 or step - self._began > 20:
            self._enter(Phase.ABOVE, step)
        return _Motion(np.array([hand[0], hand[1], height]), 1.0, _OPEN)

    # ---------------------------------------------------------------- how to do it

    def _pose(self, reading: Reading, name: str) -> Float64s:
        """(3,) the position of a thing."""
        return np.array(reading.poses[self._scene.things[name].index, :3])

    def _choose(self, reading: Reading) -> Grasp:
        """The grasp of this attempt, for the thing as it lies now."""
        name = self._scene.goal[self._goal][1]
        origin = self._pose(reading, name)
        corners = {
            other: thing.points @ matrix(reading.poses[thing.index, 3:]).T
            + reading.poses[thing.index, :3]
            - origin
            for other, thing in self._scene.things.items()
            if len(thing.points) and other != name
        }
        others = np.concatenate(list(corners.values())) if corners else np.empty((0, 3))
        thing = self._scene.things[name]
        rotation = matrix(reading.poses[thing.index, 3:])
        grasps = find_grasps(thing.points, rotation, others, self._scene.base - origin)
        if not grasps:
            raise ExpertError(f"{name} is too wide for the gripper, and has no rim")
        return grasps[self._attempt % len(grasps)]

    def _stuck(self, hand: Float64s, steps: int) -> bool:
        """Whether the hand has not come down for so many steps, because something bears it."""
        self._heights.append(float(hand[2]))
        if len(self._heights) <= 2 * steps:
            return False
        return self._heights[-1 - steps] - self._heights[-1] < steps * _STUCK_M

    def _wanted(self) -> Float64s:
        """The rotation (3, 3) that the hand should have."""
        turn = turn_from_rest(self._grasp.direction) if self._grasp is not None else 0.0
        cos, sin = np.cos(turn), np.sin(turn)
        return np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ _REST

    def _towards(self, reading: Reading, motion: _Motion) -> npt.NDArray[np.float32]:
        error = motion.target - reading.eef_pos
        # The controller comes to rest up to two centimetres off its goal where the arm is stretched,
        # so what remains is added up.
        if np.linalg.norm(error) < _REST_M:
            self._bias = np.clip(self._bias + _GAIN * error, -_REST_M, _REST_M)
        move = (error + self._bias) / _METRES_PER_ACTION
        longest = float(np.abs(move).max())
        if longest > motion.speed:
            move = move * (motion.speed / longest)
        turn = rotation_vector(self._wanted() @ matrix(reading.eef_quat).T) / _RADIANS_PER_ACTION
        action = np.array([*move, *np.clip(_TURN_GAIN * turn, -0.5, 0.5), motion.gripper])
        return action.astype(np.float32)
