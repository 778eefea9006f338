"""LIBERO's world through the interface of all worlds, with a stand-in for the simulator."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from libero_fakes import SIZE, fake_world

from comvla_sim.worlds import make, names
from comvla_sim.worlds.libero.errors import ExpertError, ProtocolError
from comvla_sim.worlds.libero.world import LiberoWorld

UP = np.array([0, 0, 1.0, 0, 0, 0, -1])


@pytest.fixture
def world() -> Iterator[LiberoWorld]:
    made = fake_world()
    yield made
    made.close()


def test_an_episode_has_the_observations_of_openvla_oft(world: LiberoWorld) -> None:
    observation, info = world.reset(seed=3, options={"task": "task_2"})
    assert observation in world.observation_space
    assert observation["images"].shape == (2, SIZE, SIZE, 3)
    np.testing.assert_array_equal(observation["images"], world.raw_frames()[:, ::-1, ::-1])
    agentview, wrist = observation["images"]
    assert (agentview[0, 0, 0], agentview[0, 0, 1]) == (SIZE - 1, SIZE - 1)
    assert (agentview[0, 0, 2], wrist[0, 0, 2]) == (7, 9), "agentview comes first"
    np.testing.assert_allclose(
        observation["proprio"], [-0.2, 0.03, 1.1, np.pi, 0, 0, 0.04, -0.04], rtol=1e-6
    )
    assert info == {
        "task": "task_2",
        "instruction": "do task 2",
        "success": False,
        "possible_tasks": ("task_2",),
        "assets": "stand-in",
        "rendering": "full",
        "init_state": 3,
    }


@pytest.mark.parametrize(
    ("seed", "options", "task", "init_state"),
    [
        (7, {"task": "task_1"}, "task_1", 7),
        (1_000_049, {"task": "task_1"}, "task_1", 49),
        (50, {"task": "task_1"}, "task_1", 0),
        (7, {"task": "task_1", "init_state": 31}, "task_1", 31),
        (49, {}, "task_0", 49),
        (50, {}, "task_1", 0),
        (500, {}, "task_0", 0),
    ],
)
def test_seeds_and_options_choose_among_the_fixed_initial_states(
    world: LiberoWorld, seed: int, options: dict[str, object], task: str, init_state: int
) -> None:
    _, info = world.reset(seed=seed, options=options)
    assert (info["task"], info["init_state"]) == (task, init_state)


@pytest.mark.parametrize("init_state", [-1, 50, "3", 1.0])
def test_an_initial_state_that_does_not_exist_is_refused(
    world: LiberoWorld, init_state: object
) -> None:
    with pytest.raises(ValueError, match="initial states 0 to 49"):
        world.reset(options={"task": "task_0", "init_state": init_state})


def test_unknown_tasks_options_suites_and_renderings_are_named(world: LiberoWorld) -> None:
    with pytest.raises(ValueError, match="unknown task 'pour the tea'"):
        world.reset(options={"task": "pour the tea"})
    with pytest.raises(ValueError, match="unknown options"):
        world.reset(options={"speed": 2})
    with pytest.raises(ValueError, match="libero_spatial, libero_object, libero_goal, libero_10"):
        LiberoWorld("libero_90")
    with pytest.raises(ValueError, match="full, plain"):
        LiberoWorld("libero_goal", rendering="sketchy")
    with pytest.raises(ValueError, match="libero:libero_spatial"):
        make("libero:kitchen")
    assert "libero:libero_10" in names()


@pytest.mark.parametrize(("suite", "limit"), [("libero_spatial", 220), ("libero_10", 520)])
def test_an_episode_ends_at_the_limit_of_its_suite(suite: str, limit: int) -> None:
    world = fake_world(suite=suite)
    world.reset(seed=0)
    still = np.zeros((limit - 1, 7))
    *_, terminated, truncated, info = world.step_chunk(still)
    assert (terminated, truncated, info["steps"]) == (False, False, limit - 1)
    *_, terminated, truncated, info = world.step_chunk(still[:8])
    assert (terminated, truncated, info["steps"]) == (False, True, 1)
    world.close()


def test_a_chunk_stops_at_the_first_success(world: LiberoWorld) -> None:
    world.reset(seed=0, options={"task": "task_0"})
    _, reward, terminated, truncated, info = world.step_chunk(np.tile(UP, (25, 1)))
    assert (reward, terminated, truncated) == (1.0, True, False)
    assert info["steps"] == 21
    assert info["successes"] == {"task_0": True}
    assert info["assets"] == "stand-in"


def test_a_policys_gripper_is_converted_and_the_worlds_own_is_not(world: LiberoWorld) -> None:
    world.reset(seed=0)
    policy_says_close = np.zeros((2, 7), np.float32)
    actions = world.from_policy(policy_says_close)
    np.testing.assert_array_equal(actions[:, 6], [1, 1])
    observation, *_ = world.step_chunk(actions)
    np.testing.assert_allclose(observation["proprio"][6:], [0.02, -0.02], atol=1e-7)


def test_a_moment_can_be_returned_to_within_its_episode_only(world: LiberoWorld) -> None:
    world.reset(seed=0, options={"task": "task_0"})
    world.step_chunk(np.tile(UP, (4, 1)))
    state, action = world.get_state(), world.expert_action()
    before = world.observe()["proprio"]
    world.step_chunk(np.tile(UP, (25, 1)))
    assert world.successes() == {"task_0": True}
    world.set_state(state)
    assert world.successes() == {"task_0": False}
    np.testing.assert_array_equal(world.observe()["proprio"], before)
    np.testing.assert_array_equal(world.expert_action(), action)
    world.reset(seed=1)
    with pytest.raises(ValueError, match="another episode"):
        world.set_state(state)


def test_the_points_of_interest_are_hand_object_goal_and_object(world: LiberoWorld) -> None:
    world.reset(seed=0, options={"task": "task_0"})
    bowl, plate = [0.05, 0.1, 0.9], [0.05, 0.3, 0.9]
    np.testing.assert_allclose(
        world.points_of_interest("task_0"), [[-0.2, 0, 1.1], bowl, plate, bowl]
    )
    assert world.project([bowl, plate]).shape == (2, 2, 2)


def test_the_expert_refuses_what_it_was_never_taught(world: LiberoWorld) -> None:
    world.reset(seed=0, options={"task": "task_9"})
    with pytest.raises(ExpertError, match="open drawer"):
        world.expert_action()
    np.testing.assert_allclose(world.points_of_interest("task_9")[1], [0.3, 0, 1])


def test_before_the_first_reset_there_is_nothing_to_see(world: LiberoWorld) -> None:
    for ask in (world.observe, world.expert_action, lambda: world.advance(UP)):
        with pytest.raises(RuntimeError, match="call reset"):
            ask()


def test_without_drawing_the_pictures_are_black_and_the_simulator_is_not_asked() -> None:
    world = fake_world()
    world._render = False
    assert not world.reset(seed=0)[0]["images"].any()
    world.close()


@pytest.mark.parametrize("behaviour", ["odd-greeting", "odd-scene", "odd-reading"])
def test_answers_that_make_no_sense_are_errors_of_the_protocol(behaviour: str) -> None:
    with pytest.raises(ProtocolError):
        fake_world(behaviour).reset(seed=0)


def test_no_step_after_closing(world: LiberoWorld) -> None:
    world.reset(seed=0)
    world.close()
    with pytest.raises(RuntimeError, match="closed"):
        world.advance(UP)
