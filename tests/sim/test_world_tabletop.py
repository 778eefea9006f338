"""The tabletop is solvable, reproducible, and cannot be solved without reading the instruction."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest

pytest.importorskip("metaworld")

from gymnasium.utils.env_checker import check_env

from comvla_sim.worlds import make
from comvla_sim.worlds.base import World
from comvla_sim.worlds.layout import draw_layout

pytestmark = [
    pytest.mark.simulator,
    # pytest undoes the filter that a world sets for its experts' remark about clipping.
    pytest.mark.filterwarnings("ignore:Constant"),
]

TASKS = (
    "drawer-open",
    "drawer-close",
    "button-press",
    "faucet-left",
    "faucet-right",
    "lever-down",
    "window-open",
    "window-close",
)


@pytest.fixture(scope="module")
def blind() -> Iterator[World]:
    """A world that draws nothing: physics is all that most of these claims are about."""
    world = make("tabletop", render=False)
    yield world
    world.close()


@pytest.fixture(scope="module")
def world() -> Iterator[World]:
    world = make("tabletop")
    yield world
    world.close()


def expert_steps(world: World, *, noise: float, seed: int) -> int | None:
    """Steps that the expert needs for the current task, None if it fails."""
    random = np.random.RandomState(seed)
    for steps in range(1, world.max_episode_steps + 1):
        action = world.expert_action() + noise * random.standard_normal(4)
        _, _, terminated, truncated, _ = world.step(action)
        if terminated:
            return steps
        assert truncated == (steps == world.max_episode_steps)
    return None


@pytest.mark.parametrize("task", TASKS)
def test_the_expert_fulfils_every_task_in_spite_of_noise(blind: World, task: str) -> None:
    for seed in range(700_000, 700_008):
        _, info = blind.reset(seed=seed, options={"task": task})
        assert info["task"] == task
        assert expert_steps(blind, noise=0.1, seed=seed) is not None, f"layout {seed}"


def test_the_tasks_are_the_eight_promised_ones(blind: World) -> None:
    assert tuple(task.name for task in blind.tasks) == TASKS


def test_no_task_is_fulfilled_at_the_start(blind: World) -> None:
    for seed in range(200):
        _, info = blind.reset(seed=seed)
        assert not info["success"]
        assert not any(blind.successes().values()), f"layout {seed}"


def test_every_picture_allows_several_instructions(blind: World) -> None:
    fixture = {task.name: task.fixture for task in blind.tasks}
    opposites = (TASKS[0:2], TASKS[3:5], TASKS[6:8])
    for seed in range(100):
        _, info = blind.reset(seed=seed)
        possible = info["possible_tasks"]
        assert info["task"] in possible
        assert len({fixture[name] for name in possible}) >= 2
        for one, other in opposites:
            assert (one in possible) == (other in possible)


def test_asking_for_a_task_changes_the_layout_only_where_it_must() -> None:
    for seed in range(100):
        free = draw_layout(seed)
        for fixture in ("drawer", "button", "faucet", "lever", "window"):
            asked = draw_layout(seed, fixture)
            assert fixture in asked.positions
            if fixture in free.positions:
                assert asked == free


def test_fixtures_keep_their_distance() -> None:
    for seed in range(200):
        places = np.sort([x for x, _, _ in draw_layout(seed).positions.values()])
        assert np.diff(places).min() > 0.2


def test_paraphrases_use_no_word_that_the_instructions_lack(blind: World) -> None:
    known = {word for task in blind.tasks for word in task.instruction.split()}
    for task in blind.tasks:
        assert task.paraphrases
        for sentence in task.paraphrases:
            assert set(sentence.split()) <= known
            assert sentence != task.instruction


def test_only_a_fixture_s_own_tasks_name_it(blind: World) -> None:
    for task in blind.tasks:
        for other in blind.tasks:
            named = other.fixture in task.instruction.split()
            assert named == (other.fixture == task.fixture)


_DIGEST = """
import hashlib, sys
from comvla_sim.worlds import make
world = make("tabletop")
for seed in (5, 900_001):
    observation, info = world.reset(seed=seed)
    for _ in range(3):
        observation, *_ = world.step(world.expert_action())
    digest = hashlib.sha256(observation["images"].tobytes() + observation["proprio"].tobytes())
    print(info["task"], digest.hexdigest())
world.close()
"""


def test_a_seed_gives_the_same_episode_and_pictures_in_every_process(world: World) -> None:
    command = [sys.executable, "-c", _DIGEST]
    other = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split("\n")
    for line, seed in zip(other, (5, 900_001), strict=False):
        world.reset(seed=77)  # what happened before must not matter
        observation, info = world.reset(seed=seed)
        for _ in range(3):
            observation, *_ = world.step(world.expert_action())
        digest = hashlib.sha256(observation["images"].tobytes() + observation["proprio"].tobytes())
        assert line == f"{info['task']} {digest.hexdigest()}"


def test_two_worlds_in_one_process_draw_what_each_sees(world: World) -> None:
    expected = world.reset(seed=11)[0]["images"]
    other = make("tabletop", image_size=64)
    try:
        small = other.reset(seed=12)[0]["images"]
        assert small.shape == (2, 64, 64, 3)
        np.testing.assert_array_equal(world.observe()["images"], expected)
        np.testing.assert_array_equal(other.observe()["images"], small)
    finally:
        other.close()
    np.testing.assert_array_equal(world.observe()["images"], expected)


def test_observations_lie_in_the_declared_spaces(world: World) -> None:
    observation, _ = world.reset(seed=1)
    assert observation in world.observation_space
    assert observation["images"].shape == (2, 128, 128, 3)
    assert observation["images"].std() > 20  # a picture, not a blank
    assert world.expert_action() in world.action_space
    assert world.control_period_s == pytest.approx(0.0125)


def test_gymnasiums_own_checker_finds_nothing_wrong(blind: World) -> None:
    check_env(blind, skip_render_check=True)


def test_a_point_is_projected_to_where_it_appears(world: World) -> None:
    """The top of the button is red, and so is the picture where the projection puts it."""
    for seed in range(3):
        world.reset(seed=seed, options={"task": "button-press"})
        _, top, _, _ = world.points_of_interest("button-press")
        images = world.observe()["images"]
        # Four centimetres behind the handle point of Meta-World, which hovers above the button.
        places = world.project([top - (0, 0, 0.04)])[:, 0]
        for image, (u, v) in zip(images, places, strict=True):
            red, green, blue = image[int(v * 128), int(u * 128)].astype(int)
            assert red > 100
            assert red > 2 * max(green, blue)


def test_a_chunk_is_the_same_as_its_steps(world: World) -> None:
    world.reset(seed=3)
    start = world.get_state()
    actions = []
    for _ in range(8):
        actions.append(world.expert_action())
        one_by_one = world.step(actions[-1])
    world.set_state(start)
    at_once = world.step_chunk(actions)
    np.testing.assert_array_equal(at_once[0]["images"], one_by_one[0]["images"])
    np.testing.assert_array_equal(at_once[0]["proprio"], one_by_one[0]["proprio"])
    assert at_once[1:4] == one_by_one[1:4]
    assert at_once[4]["steps"] == 8
    assert at_once[4]["successes"] == one_by_one[4]["successes"]


def test_a_chunk_stops_at_success(blind: World) -> None:
    blind.reset(seed=4, options={"task": "drawer-close"})
    start = blind.get_state()
    needed = expert_steps(blind, noise=0.0, seed=0)
    assert needed is not None
    blind.set_state(start)
    for _ in range(needed - 1):
        *_, terminated, _, info = blind.step(blind.expert_action())
        assert not terminated
        assert not info["success"]
    action = blind.expert_action()
    _, reward, terminated, truncated, info = blind.step_chunk([action] * 5)
    assert (reward, terminated, truncated, info["steps"]) == (1.0, True, False, 1)
    assert info["success"]
    assert info["successes"]["drawer-close"]


def test_a_chunk_stops_at_the_last_step_of_the_episode(blind: World) -> None:
    blind.reset(seed=4)
    idle = np.zeros((blind.max_episode_steps - 1, 4))
    *_, truncated, info = blind.step_chunk(idle)
    assert not truncated
    _, reward, terminated, truncated, info = blind.step_chunk(np.zeros((3, 4)))
    assert (reward, terminated, truncated, info["steps"]) == (0.0, False, True, 1)


def test_going_back_to_a_state_repeats_what_followed(blind: World) -> None:
    blind.reset(seed=9)
    for _ in range(30):
        blind.advance(blind.expert_action())
    state = blind.get_state()

    def future() -> np.ndarray:
        seen = []
        for _ in range(20):
            action = blind.expert_action()
            blind.advance(action)
            seen.append([*action, *blind.observe()["proprio"]])
        return np.array(seen)

    first = future()
    blind.set_state(state)
    np.testing.assert_array_equal(future(), first)


def test_a_state_of_another_episode_is_refused(blind: World) -> None:
    blind.reset(seed=1)
    state = blind.get_state()
    blind.reset(seed=2)
    with pytest.raises(ValueError, match="another episode"):
        blind.set_state(state)


def test_without_rendering_pictures_are_black(blind: World) -> None:
    observation, _ = blind.reset(seed=1)
    assert observation in blind.observation_space
    assert not observation["images"].any()


def test_without_a_seed_layouts_differ_and_follow_the_last_seed(blind: World) -> None:
    def two_more() -> list[np.ndarray]:
        blind.reset(seed=6)
        return [blind.reset()[0]["proprio"] for _ in range(2)]

    first, second = two_more()
    assert not np.array_equal(first, second)
    np.testing.assert_array_equal(two_more(), [first, second])


def test_wrong_use_is_refused_with_a_remedy(blind: World) -> None:
    with pytest.raises(ValueError, match="drawer-open"):
        blind.reset(seed=0, options={"task": "make-coffee"})
    with pytest.raises(ValueError, match="understands 'task'"):
        blind.reset(seed=0, options={"tasks": "drawer-open"})
    with pytest.raises(ValueError, match="integer in"):
        blind.reset(seed=-1)
    _, info = blind.reset(seed=0)
    absent = next(name for name in TASKS if name not in info["possible_tasks"])
    with pytest.raises(ValueError, match="not on this table"):
        blind.expert_action(absent)
    for action in ([0, 0, 0], [0, 0, 0, np.nan]):
        with pytest.raises(ValueError, match="4 finite numbers"):
            blind.step(action)
    with pytest.raises(ValueError, match="a chunk is"):
        blind.step_chunk(np.zeros((0, 4)))
    fresh = make("tabletop", render=False)
    with pytest.raises(RuntimeError, match="reset"):
        fresh.step(np.zeros(4))
    fresh.close()
