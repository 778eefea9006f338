"""The real LIBERO: frames, proprioception and protocol as published; an expert; a policy over gRPC.

Skipped where LIBERO's environment (``make libero``) or its assets are missing.
"""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from comvla.errors import ComVLAError
from comvla_client import ComVLAClient
from comvla_server.background import BackgroundServer
from comvla_server.engine import Engine
from comvla_server.settings import ServerSettings
from comvla_sim.worlds import make
from comvla_sim.worlds.libero.assets import AUTHENTIC, find_assets
from comvla_sim.worlds.libero.conventions import axis_angle
from comvla_sim.worlds.libero.environment import CHILD, LiberoEnvironment, default_home
from comvla_sim.worlds.libero.errors import AssetsError
from comvla_sim.worlds.libero.rollout import run_expert
from comvla_sim.worlds.libero.world import LiberoWorld

ENVIRONMENT = LiberoEnvironment(default_home())
REFERENCE = Path(__file__).with_name("libero_reference.py")
ON_THE_STOVE = "pick_up_the_black_bowl_on_the_stove_and_place_it_on_the_plate"
IN_THE_DRAWER = (
    "pick_up_the_black_bowl_in_the_top_drawer_of_the_wooden_cabinet_and_place_it_on_the_plate"
)


def why_not() -> str | None:
    try:
        ENVIRONMENT.require()
        find_assets(ENVIRONMENT.package(), ENVIRONMENT.unpacked_assets)
    except ComVLAError as error:
        return str(error)
    return None


REASON = why_not()
pytestmark = [
    pytest.mark.simulator,
    pytest.mark.skipif(REASON is not None, reason=REASON or ""),
]


@pytest.fixture(scope="module")
def drawn() -> Iterator[LiberoWorld]:
    world = make("libero:libero_spatial:plain")
    assert isinstance(world, LiberoWorld)
    yield world
    world.close()


@pytest.fixture(scope="module")
def physics() -> Iterator[LiberoWorld]:
    world = LiberoWorld("libero_spatial", render=False)
    yield world
    world.close()


def repeat(values: list[float], times: int) -> npt.NDArray[np.float64]:
    return np.tile(np.array(values), (times, 1))


# ---------------------------------------------------------------- what the world shows


def test_the_suite_is_the_published_one(physics: LiberoWorld) -> None:
    assert len(physics.tasks) == 10
    assert physics.tasks[0].instruction == (
        "pick up the black bowl between the plate and the ramekin and place it on the plate"
    )
    assert physics.versions["mujoco"] == "3.3.2"
    assert physics.versions["robosuite"] == "1.4.0"


def test_frames_are_the_simulators_own_turned_by_half_a_turn(drawn: LiberoWorld) -> None:
    observation, info = drawn.reset(options={"task": ON_THE_STOVE, "init_state": 0})
    raw = drawn.raw_frames()
    assert observation["images"].shape == (2, 256, 256, 3)
    np.testing.assert_array_equal(observation["images"], raw[:, ::-1, ::-1])
    assert raw.std() > 20, "the pictures show something"
    assert info["assets"] == drawn.assets
    assert info["rendering"] == "plain"


def test_the_hand_is_seen_where_the_projection_says(drawn: LiberoWorld) -> None:
    drawn.reset(options={"task": ON_THE_STOVE, "init_state": 0})
    before, place = drawn.observe()["images"], drawn.points_of_interest(ON_THE_STOVE)[:1]
    here = drawn.project(place)[0, 0]
    # Sideways, so that left and right would be told apart.
    after = drawn.step_chunk(repeat([0, 1, 0, 0, 0, 0, -1], 8))[0]["images"]
    there = drawn.project(drawn.points_of_interest(ON_THE_STOVE)[:1])[0, 0]
    changed = np.abs(after[0].astype(int) - before[0].astype(int)).sum(-1) > 60
    rows, columns = np.nonzero(changed)
    centre = np.array([np.median(columns), np.median(rows)]) / 256
    middle = (here + there) / 2
    assert np.linalg.norm(there - here) > 0.08
    # The hand is long: what moves reaches from the fingertips upwards, but not sideways.
    assert abs(centre[0] - middle[0]) < 0.08
    assert -0.25 < centre[1] - middle[1] < 0.05
    moved = [np.abs(after[i].astype(int) - before[i].astype(int)).mean() for i in range(2)]
    assert moved[1] > 2 * moved[0], "the second view is the one that moves with the hand"


def test_proprioception_is_position_orientation_fingers(physics: LiberoWorld) -> None:
    first = physics.reset(options={"task": ON_THE_STOVE, "init_state": 0})[0]["proprio"]
    for axis in range(3):
        action = [0.0] * 6 + [-1.0]
        action[axis] = 0.6
        before = physics.observe()["proprio"]
        after = physics.step_chunk(repeat(action, 4))[0]["proprio"]
        moved = after[:3] - before[:3]
        assert np.argmax(np.abs(moved)) == axis
        assert moved[axis] > 0.01
    reading = physics.reading
    proprio = physics.observe()["proprio"]
    np.testing.assert_allclose(proprio[3:6], axis_angle(reading.eef_quat), rtol=1e-6)
    assert np.linalg.norm(first[3:6]) == pytest.approx(np.pi, abs=0.15), "it points down"
    before = physics.observe()["proprio"]
    turned = physics.step_chunk(repeat([0, 0, 0, 0, 0, 0.5, -1], 4))[0]["proprio"]
    assert np.linalg.norm(turned[3:6] - before[3:6]) > 0.05


def test_the_gripper_follows_a_policys_word(physics: LiberoWorld) -> None:
    physics.reset(options={"task": ON_THE_STOVE, "init_state": 0})
    policy = np.zeros((12, 7), np.float32)
    closed = physics.step_chunk(physics.from_policy(policy))[0]["proprio"]
    policy[:, 6] = 1.0
    opened = physics.step_chunk(physics.from_policy(policy))[0]["proprio"]
    assert closed[6] < 0.01
    assert closed[7] > -0.01
    assert opened[6] > 0.035
    assert opened[7] < -0.035


def test_an_episode_is_the_same_whatever_ran_before(physics: LiberoWorld) -> None:
    options = {"task": IN_THE_DRAWER, "init_state": 2}
    chunk = repeat([0.5, -0.3, -0.8, 0, 0, 0, 1], 5)

    def play() -> tuple[Any, ...]:
        physics.reset(options=dict(options))
        physics.step_chunk(chunk)
        return physics.observe()["proprio"], physics.reading.poses

    first = play()
    physics.reset(options={"task": IN_THE_DRAWER, "init_state": 7})
    physics.step_chunk(chunk)
    for a, b in zip(first, play(), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_moment_can_be_returned_to(physics: LiberoWorld) -> None:
    physics.reset(options={"task": ON_THE_STOVE, "init_state": 1})
    physics.step_chunk(repeat([0.4, 0.2, -0.7, 0, 0, 0.2, 1], 6))
    state = physics.get_state()
    chunk = repeat([-0.4, 0.1, 0.3, 0, 0.1, 0, 1], 6)
    physics.step_chunk(chunk)
    poses, hand = physics.reading.poses, physics.reading.eef_pos
    physics.step_chunk(chunk)
    physics.set_state(state)
    physics.step_chunk(chunk)
    np.testing.assert_allclose(physics.reading.poses, poses, atol=1e-9)
    # robosuite samples on a clock that is not part of the state: a physics step sooner or later.
    np.testing.assert_allclose(physics.reading.eef_pos, hand, atol=2e-3)


@pytest.mark.slow
@pytest.mark.timeout(1200)  # the reference draws every step
def test_frames_and_proprioception_equal_the_evaluation_loop_bit_for_bit(tmp_path: Path) -> None:
    size, episodes = 64, 2
    out = tmp_path / "reference.npz"
    assets = find_assets(ENVIRONMENT.package(), ENVIRONMENT.unpacked_assets)
    arguments = [str(assets.folder), "libero_spatial", IN_THE_DRAWER, str(episodes), str(size)]
    subprocess.run(
        [str(ENVIRONMENT.python), str(REFERENCE), str(CHILD.parent), *arguments, str(out)],
        env=ENVIRONMENT.variables(render=True),
        check=True,
        capture_output=True,
    )
    reference = np.load(out)
    spec = importlib.util.spec_from_file_location("libero_reference", REFERENCE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    world = LiberoWorld("libero_spatial", image_size=size)
    seen = []
    for episode in range(episodes):
        options = {"task": IN_THE_DRAWER, "init_state": episode}
        seen.append(world.reset(options=options)[0])
        seen.append(world.step_chunk(module.ACTIONS)[0])
    world.close()
    for ours, frames, proprio in zip(seen, reference["frames"], reference["proprio"], strict=True):
        np.testing.assert_array_equal(ours["images"], frames)
        np.testing.assert_array_equal(ours["proprio"], proprio.astype(np.float32))


def test_what_a_suite_lacks_is_named() -> None:
    if find_assets(ENVIRONMENT.package(), ENVIRONMENT.unpacked_assets).label == AUTHENTIC:
        pytest.skip("the authentic assets lack nothing")
    world = LiberoWorld("libero_object", render=False)
    with pytest.raises(AssetsError, match=r"lack scenes/.*--download"):
        world.reset(seed=0)
    world.close()


# ---------------------------------------------------------------- who can solve it


def test_the_expert_solves_episodes_through_the_same_interface(physics: LiberoWorld) -> None:
    tasks = [physics.tasks[index].name for index in (0, 2, 3, 8)]
    rows = [run_expert(physics, task, init_state) for task in tasks for init_state in (0, 1)]
    assert sum(row["success"] for row in rows) >= 7
    assert all(row["assets"] == physics.assets for row in rows)
    assert all(row["steps"] <= 220 for row in rows)


@dataclass
class Recording:
    """What passed between world and policy."""

    raw: list[npt.NDArray[np.uint8]] = field(default_factory=list)
    observations: list[dict[str, npt.NDArray[Any]]] = field(default_factory=list)
    chunks: list[npt.NDArray[np.float32]] = field(default_factory=list)
    fingers: list[npt.NDArray[np.float64]] = field(default_factory=list)
    steps: int = 0


def golden_checkpoint(folder: Path) -> Path:
    """The tiny OpenVLA-OFT with reference outputs, with a tokenizer; skips where it is missing."""
    path = Path(__file__).parents[1] / "vla" / "reference_data.py"
    spec = importlib.util.spec_from_file_location("libero_reference_data", path)
    assert spec is not None
    assert spec.loader is not None
    data = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = data
    spec.loader.exec_module(data)
    if not (data.GOLDEN / "ckpt_oft").is_dir():
        pytest.skip("no reference data: point COMVLA_GOLDEN at the folder with ckpt_oft")
    checkpoint: Path = data.checkpoint(folder, "oft")
    return checkpoint


@pytest.mark.slow
def test_an_episode_of_openvla_oft_over_grpc(drawn: LiberoWorld, tmp_path: Path) -> None:
    from comvla_vla import load_cloud, load_edge

    source = golden_checkpoint(tmp_path / "checkpoint")
    edge, cloud = load_edge(source), load_cloud(source)
    observation, info = drawn.reset(options={"task": ON_THE_STOVE, "init_state": 0})
    seen, done = Recording(), False
    settings = ServerSettings(port=0, admin_port=0)
    with (
        BackgroundServer(Engine(cloud), settings) as server,
        ComVLAClient(
            server.target, edge=edge, budget=64, selector="hard_voting", deadline_s=60.0
        ) as client,
    ):
        while not done:
            seen.raw.append(drawn.raw_frames())
            seen.observations.append(observation)
            chunk = client.step(observation, info["instruction"])
            assert chunk.report.source == "cloud", chunk.report
            assert chunk.report.tokens == 64
            seen.chunks.append(chunk.actions)
            fingers = drawn.reading.gripper_qpos
            observation, _, success, truncated, step = drawn.step_chunk(
                drawn.from_policy(chunk.actions)
            )
            seen.fingers.append(drawn.reading.gripper_qpos - fingers)
            seen.steps += step["steps"]
            done = success or truncated
    assert seen.steps == 220 or success
    assert len(seen.chunks) == -(-seen.steps // 8), "eight actions of each chunk, open loop"
    for raw, shown, actions in zip(seen.raw, seen.observations, seen.chunks, strict=True):
        np.testing.assert_array_equal(shown["images"], raw[:, ::-1, ::-1])
        assert shown["images"].dtype == np.uint8
        assert shown["proprio"].shape == (8,)
        assert shown["proprio"].dtype == np.float32
        assert actions.shape == (8, 7)
        assert actions.dtype == np.float32
    # The gripper moved the way the policy said, wherever a chunk said one thing throughout.
    for actions, moved, shown in zip(seen.chunks, seen.fingers, seen.observations, strict=True):
        words = actions[:, 6] > 0.5
        if words.all():
            assert moved[0] > -2e-3
        elif not words.any() and shown["proprio"][6] > 0.01:
            assert moved[0] < -1e-3
    frames = np.stack([shown["images"][0] for shown in seen.observations]).astype(int)
    assert np.abs(np.diff(frames, axis=0)).max() > 50, "the robot moved before the camera"
