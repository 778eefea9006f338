"""Several Meta-World fixtures on one table: the picture does not tell the task, only words do.

A plain Meta-World scene holds one object, and a policy trained there ignores its instruction. Here
up to six instructions make sense in one and the same picture. The robot, the fixtures, the control
of the hand, the experts and the criteria of success are Meta-World's.
"""

from __future__ import annotations

from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
import numpy.typing as npt

from comvla_sim.worlds.base import Task
from comvla_sim.worlds.experts import metaworld_expert
from comvla_sim.worlds.fixtures import FIXTURES, MANOEUVRES, Manoeuvre, Poses
from comvla_sim.worlds.layout import Layout, draw_layout
from comvla_sim.worlds.mujoco_world import MujocoWorld

PHYSICS_STEPS = 5
"""Physics steps of 2.5 ms in a control period, as ``SawyerXYZEnv`` has them."""

_HAND_LOW = np.array([-0.5, 0.40, 0.05])
_HAND_HIGH = np.array([0.5, 1.0, 0.5])
_METRES_PER_ACTION = 0.01
_HAND_QUATERNION = (1.0, 0.0, 1.0, 0.0)
_CLAW_SPAN_M = 0.1
_HAND_SETTLING_STEPS = 50
# ``SawyerMocapBase.reset_mocap_welds``: no offset between hand and mocap body, torque scale 5.
_WELD = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 5.0)


def scene_xml(assets: Path) -> str:
    """The scene: Meta-World's room and robot with all five fixtures.

    Args:
        assets: Meta-World's folder ``assets``. Files are named absolutely, so nothing has to be
            written or linked anywhere.
    """

    def include(*parts: str) -> str:
        return f"<include file={quoteattr(str(assets.joinpath(*parts)))}/>"

    # Meta-World names meshes and textures relative to its environment files in sawyer_xyz.
    base = quoteattr(str(assets / "sawyer_xyz"))
    fixtures = FIXTURES.values()
    needs = "".join(include("objects", "assets", fixture.dependencies) for fixture in fixtures)
    bodies = "".join(
        f"<body name={quoteattr(fixture.body)} {fixture.attributes}>"
        f"{include('objects', 'assets', fixture.file)}{fixture.children}</body>"
        for fixture in fixtures
    )
    return f"""<mujoco>
      <compiler meshdir={base} texturedir={base}/>
      {include("scene", "basic_scene.xml")}{needs}
      {include("objects", "assets", "xyz_base_dependencies.xml")}
      <worldbody>{include("objects", "assets", "xyz_base.xml")}{bodies}</worldbody>
      <actuator>
        <position ctrllimited="true" ctrlrange="-1 1" joint="r_close" kp="400" user="1"/>
        <position ctrllimited="true" ctrlrange="-1 1" joint="l_close" kp="400" user="1"/>
      </actuator>
      <equality><weld body1="mocap" body2="hand" solref="0.02 1"/></equality>
    </mujoco>"""


class Tabletop(MujocoWorld):
    """The world ``"tabletop"``: five fixtures, eight tasks, two or three fixtures at a time.

    Args:
        image_size: side of a picture in pixels.
        render: False saves the drawing: images are then black.
    """

    tasks = tuple(manoeuvre.task for manoeuvre in MANOEUVRES)
    max_episode_steps = 160

    def __init__(self, *, image_size: int = 128, render: bool = True) -> None:
        super().__init__(image_size=image_size, render=render)
        mujoco = self._mujoco
        # Meta-World imports mujoco, so it has to come after the OpenGL library is chosen.
        from metaworld.asset_path_utils import ENV_ASSET_DIR_V3

        self.model = mujoco.MjModel.from_xml_string(scene_xml(Path(ENV_ASSET_DIR_V3)))
        self.data = mujoco.MjData(self.model)
        self.model.eq_data[self.model.eq_type == mujoco.mjtEq.mjEQ_WELD] = _WELD
        self.control_period_s = PHYSICS_STEPS * float(self.model.opt.timestep)
        self._poses = Poses(self.model, self.data)
        self._manoeuvres = {manoeuvre.task.name: manoeuvre for manoeuvre in MANOEUVRES}
        self._joint_addresses = {
            name: self._joint_address(fixture.joint) for name, fixture in FIXTURES.items()
        }
        self._body_ids = {name: self.model.body(f.body).id for name, f in FIXTURES.items()}
        self.layout: Layout | None = None

    def _joint_address(self, joint: str) -> int:
        owner = joint.removeprefix("body:")
        index = self.model.joint(joint).id if owner == joint else self.model.body(owner).jntadr[0]
        return int(self.model.jnt_qposadr[index])

    # ---------------------------------------------------------------- arranging the table

    def _arrange(self, seed: int, task: Task | None) -> Task:
        mujoco, model, data = self._mujoco, self.model, self.data
        layout = draw_layout(seed, None if task is None else task.fixture)
        self.layout = layout
        for number, (name, body) in enumerate(self._body_ids.items()):
            # Absent fixtures wait under the floor, apart from one another: were they in one place,
            # their moving parts would collide and triple the cost of every step.
            parked = (2.0 * number - 4.0, 4.0, -5.0)
            model.body_pos[body] = layout.positions.get(name, parked)
        mujoco.mj_resetData(model, data)
        self._settle_hand(np.asarray(layout.hand))
        for name, address in self._joint_addresses.items():
            data.qpos[address] = layout.joints[name]
        data.qvel[:] = 0
        mujoco.mj_forward(model, data)
        possible = self.possible_tasks()
        return task or possible[int(layout.task_draw * len(possible))]

    def _settle_hand(self, position: npt.NDArray[np.float64]) -> None:
        """Lets the weld pull the open hand to its start."""
        for _ in range(_HAND_SETTLING_STEPS):
            self._simulate(position, gripper=-1.0)

    def possible_tasks(self) -> tuple[Task, ...]:
        """The tasks whose fixture is on the table, in the order of :attr:`tasks`."""
        if self.layout is None:
            return ()
        return tuple(task for task in self.tasks if task.fixture in self.layout.positions)

    # ---------------------------------------------------------------- moving

    def _simulate(self, mocap: npt.NDArray[np.float64], gripper: float) -> None:
        data = self.data
        data.mocap_pos[0] = mocap
        data.mocap_quat[0] = _HAND_QUATERNION
        data.ctrl[:] = (gripper, -gripper)
        self._mujoco.mj_step(self.model, data, nstep=PHYSICS_STEPS)

    def _advance(self, action: npt.NDArray[np.float64]) -> None:
        mocap = self.data.mocap_pos[0] + _METRES_PER_ACTION * action[:3]
        self._simulate(np.clip(mocap, _HAND_LOW, _HAND_HIGH), float(action[3]))
        # mj_step leaves positions one physics step behind qpos. Bring them up to date, so that
        # experts and pictures see the same whether a state was reached or restored.
        self._mujoco.mj_kinematics(self.model, self.data)

    # ---------------------------------------------------------------- measuring

    def _present(self, task: Task | str | None) -> Manoeuvre:
        found = self.find_task(task)
        if self.layout is None or found.fixture not in self.layout.positions:
            possible = [t.name for t in self.possible_tasks()]
            raise ValueError(
                f"task {found.name!r} needs the {found.fixture}, which is not on this table, only "
                f"{possible} are possible; reset(options={{'task': {found.name!r}}}) puts it there"
            )
        return self._manoeuvres[found.name]

    def _fulfilled(self, task: Task) -> bool:
        manoeuvre = self._manoeuvres[task.name]
        error = manoeuvre.error_m(manoeuvre.handle(self._poses), manoeuvre.goal(self._poses))
        return error <= manoeuvre.tolerance_m

    def _gripper(self) -> float:
        """Opening of the gripper in [0, 1], as in Meta-World's observation."""
        span = np.linalg.norm(self._poses.body("rightclaw") - self._poses.body("leftclaw"))
        return float(np.clip(span / _CLAW_SPAN_M, 0.0, 1.0))

    def _proprio(self) -> npt.NDArray[np.float32]:
        return np.array([*self._poses.body("hand"), self._gripper()], np.float32)

    def points_of_interest(self, task: Task | str) -> npt.NDArray[np.float64]:
        """(4, 3) in metres: the hand, the handle to touch, its goal, and the fixture's centre."""
        manoeuvre = self._present(task)
        fixture = FIXTURES[manoeuvre.task.fixture]
        return np.stack(
            [
                self._poses.body("hand"),
                manoeuvre.handle(self._poses),
                manoeuvre.goal(self._poses),
                self._poses.body(fixture.body) + np.asarray(fixture.centre),
            ]
        )

    def expert_action(self, task: Task | str | None = None) -> npt.NDArray[np.float32]:
        """(4,) what Meta-World's expert for ``task`` (default: the current one) does now."""
        manoeuvre = self._present(task)
        return metaworld_expert(
            manoeuvre.policy,
            hand=self._poses.body("hand"),
            gripper=self._gripper(),
            handle=manoeuvre.handle(self._poses),
            goal=manoeuvre.goal(self._poses),
        )
