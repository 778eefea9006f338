"""Several worlds in processes of their own behave like one world each, also when they fail."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

pytest.importorskip("metaworld")

from comvla_sim.worlds import make, vector
from comvla_sim.worlds.vector import VectorWorld, WorkerError

pytestmark = [
    pytest.mark.simulator,
    # pytest undoes the filter that a world sets for its experts' remark about clipping.
    pytest.mark.filterwarnings("ignore:Constant"),
]


@pytest.fixture(scope="module")
def worlds() -> Iterator[VectorWorld]:
    with VectorWorld("tabletop", 2, image_size=32) as worlds:
        yield worlds


def test_each_world_does_what_a_single_world_does(worlds: VectorWorld) -> None:
    single = make("tabletop", image_size=32)
    chunk = np.full((8, 4), 0.3, np.float32)
    resets = worlds.reset([7, 8], [None, "window-open"])
    steps = worlds.step_chunk([chunk, chunk[:3]])
    for number, (seed, options, actions) in enumerate(
        [(7, None, chunk), (8, {"task": "window-open"}, chunk[:3])]
    ):
        observation, info = single.reset(seed=seed, options=options)
        np.testing.assert_array_equal(resets[number][0]["images"], observation["images"])
        assert resets[number][1] == info
        after = single.step_chunk(actions)
        step = steps[number]
        assert step is not None
        np.testing.assert_array_equal(step[0]["images"], after[0]["images"])
        assert step[1:] == after[1:]
    single.close()


def test_a_world_can_rest(worlds: VectorWorld) -> None:
    worlds.reset([1, 2])
    resting, moving = worlds.step_chunk([None, np.zeros((2, 4))])
    assert resting is None
    assert moving is not None
    assert moving[4]["steps"] == 2


def test_an_error_in_a_world_is_raised_here_and_harms_no_other(worlds: VectorWorld) -> None:
    worlds.reset([1, 2])
    with pytest.raises(WorkerError, match=r"(?s)world 1 \(tabletop\): ValueError.*Traceback"):
        worlds.step_chunk([np.zeros((1, 4)), np.zeros((1, 3))])
    assert all(step is not None for step in worlds.step_chunk([np.zeros((1, 4))] * 2))


def test_the_number_of_arguments_is_checked(worlds: VectorWorld) -> None:
    with pytest.raises(ValueError, match="expected 2 seeds"):
        worlds.reset([1])
    with pytest.raises(ValueError, match="expected 2 chunks"):
        worlds.step_chunk([None])


def test_ctrl_c_ends_the_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(number: int) -> None:
        raise KeyboardInterrupt

    # A busy machine may take longer than a person at the keyboard would wait.
    monkeypatch.setattr(vector, "_CLOSING_TIMEOUT_S", 60.0)
    worlds = VectorWorld("tabletop", 1, render=False)
    monkeypatch.setattr(worlds, "_receive", interrupted)
    with pytest.raises(KeyboardInterrupt):
        worlds.reset([0])
    assert not worlds._processes[0].is_alive()
    assert worlds._processes[0].exitcode == 0


def test_a_world_that_cannot_be_made_is_an_error_at_once() -> None:
    with pytest.raises(WorkerError, match="unknown world 'kitchen'"):
        VectorWorld("kitchen", 1)
    with pytest.raises(ValueError, match="at least 1"):
        VectorWorld("tabletop", 0)


def test_a_killed_process_is_noticed_and_closing_is_harmless() -> None:
    worlds = VectorWorld("tabletop", 1, render=False)
    worlds._processes[0].kill()
    with pytest.raises(WorkerError, match="exit code -9"):
        worlds.reset([0])
    worlds.close()
    worlds.close()
    with pytest.raises(RuntimeError, match="closed"):
        worlds.reset([0])
