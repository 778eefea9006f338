"""Worlds are found by name, and plain Meta-World tasks behave like the tabletop."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("metaworld")

from comvla_sim.worlds import make, names

pytestmark = [
    pytest.mark.simulator,
    # pytest undoes the filter that a world sets for its experts' remark about clipping.
    pytest.mark.filterwarnings("ignore:Constant"),
]


def test_the_names_are_the_tabletop_all_of_meta_world_and_the_suites_of_libero() -> None:
    assert names()[0] == "tabletop"
    assert "metaworld:drawer-open-v3" in names()
    assert sum(name.startswith("metaworld:") for name in names()) == 50
    assert [name for name in names() if name.startswith("libero:")] == [
        f"libero:libero_{suite}" for suite in ("spatial", "object", "goal", "10")
    ]


@pytest.mark.parametrize("name", ["kitchen", "metaworld:make-coffee-v3", "metaworld:", ""])
def test_an_unknown_name_is_answered_with_what_exists(name: str) -> None:
    with pytest.raises(ValueError, match="tabletop, metaworld:assembly-v3"):
        make(name)


def test_an_image_size_of_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="image_size"):
        make("tabletop", image_size=0)


@pytest.mark.parametrize(
    ("name", "instruction"),
    [("drawer-open-v3", "open the drawer"), ("plate-slide-back-v3", "plate slide back")],
)
def test_the_expert_solves_a_plain_task(name: str, instruction: str) -> None:
    world = make(f"metaworld:{name}", render=False)
    for seed in (0, 1):
        _, info = world.reset(seed=seed)
        assert info["instruction"] == instruction
        assert info["possible_tasks"] == (name,)
        terminated = truncated = False
        while not (terminated or truncated):
            *_, terminated, truncated, info = world.step(world.expert_action())
        assert info["successes"] == {name: True}
    world.close()


def test_a_plain_task_is_reproducible_and_can_be_branched() -> None:
    world = make("metaworld:button-press-v3", image_size=48)
    first = world.reset(seed=4)[0]["images"]
    assert not np.array_equal(world.reset(seed=5)[0]["images"], first)
    observation, _ = world.reset(seed=4)
    np.testing.assert_array_equal(observation["images"], first)
    assert observation in world.observation_space
    state = world.get_state()
    chunk = [world.expert_action()] * 8
    after = world.step_chunk(chunk)[0]
    world.set_state(state)
    np.testing.assert_array_equal(world.observe()["images"], first)
    again = world.step_chunk(chunk)[0]
    np.testing.assert_array_equal(again["images"], after["images"])
    assert world.points_of_interest("button-press-v3").shape == (4, 3)
    world.close()
