"""Open-loop execution: the chunk, its rest, then holding."""

from __future__ import annotations

import numpy as np
import pytest
from client_stubs import INFO

from comvla_client.queue import ActionQueue

CHUNK = np.arange(32, dtype=np.float32).reshape(8, 4) + 1
HOLD = np.array([0, 0, 0, 32], dtype=np.float32)  # the gripper, last dimension, keeps its value


def popped(queue: ActionQueue) -> list[list[float]]:
    rows = []
    while (row := queue.pop()) is not None:
        rows.append(row.tolist())
    return rows


def test_a_chunk_is_executed_row_by_row() -> None:
    queue = ActionQueue(INFO)
    queue.accept(CHUNK)
    assert popped(queue) == CHUNK.tolist()


def test_fewer_rows_are_executed_where_told() -> None:
    queue = ActionQueue(INFO, execute=3)
    queue.accept(CHUNK)
    assert popped(queue) == CHUNK[:3].tolist()


def test_the_rest_comes_before_holding() -> None:
    queue = ActionQueue(INFO, execute=3)
    queue.accept(CHUNK)
    actions, planned, source = queue.fall_back()
    assert (planned, source) == (5, "rest")
    np.testing.assert_array_equal(actions[:5], CHUNK[3:])
    np.testing.assert_array_equal(actions[5:], np.tile(HOLD, (3, 1)))
    assert popped(queue) == CHUNK[3:6].tolist()
    actions, planned, source = queue.fall_back()
    assert (planned, source) == (2, "rest")
    assert popped(queue) == CHUNK[6:].tolist()
    actions, planned, source = queue.fall_back()
    assert (planned, source) == (0, "hold")
    np.testing.assert_array_equal(actions, np.tile(HOLD, (8, 1)))
    assert popped(queue) == [HOLD.tolist()], "while holding it asks again after every period"


def test_a_chunk_executed_whole_leaves_no_rest() -> None:
    queue = ActionQueue(INFO)
    queue.accept(CHUNK)
    assert queue.fall_back()[1:] == (0, "hold")


def test_before_the_first_answer_nothing_moves() -> None:
    actions, planned, source = ActionQueue(INFO).fall_back()
    assert (planned, source) == (0, "hold")
    np.testing.assert_array_equal(actions, np.zeros((8, 4), np.float32))
    assert actions.dtype == np.float32


def test_a_hold_of_ones_own_is_used() -> None:
    queue = ActionQueue(INFO, execute=7, hold=[1.0, 2.0, 3.0, 4.0])
    queue.accept(CHUNK)
    actions, planned, _ = queue.fall_back()
    assert planned == 1
    np.testing.assert_array_equal(actions[1:], np.tile([1, 2, 3, 4], (7, 1)))


def test_what_the_robot_does_with_its_actions_stays_its_own_affair() -> None:
    queue, mine = ActionQueue(INFO, execute=4), CHUNK.copy()
    queue.accept(mine)
    mine[:] = -1
    row = queue.pop()
    assert row is not None
    row[:] = -1
    assert popped(queue) == CHUNK[1:4].tolist()
    rest = queue.fall_back()[0]
    np.testing.assert_array_equal(rest[:4], CHUNK[4:])
    rest[:] = -1
    np.testing.assert_array_equal(queue.fall_back()[0], np.tile(HOLD, (8, 1)))


def test_clear_forgets_everything() -> None:
    queue = ActionQueue(INFO, execute=2)
    queue.accept(CHUNK)
    queue.clear()
    assert queue.pop() is None
    assert queue.fall_back()[1:] == (0, "hold")


@pytest.mark.parametrize("execute", [0, -1, 9])
def test_execute_lies_within_the_chunk(execute: int) -> None:
    with pytest.raises(ValueError, match="1 to 8"):
        ActionQueue(INFO, execute=execute)


@pytest.mark.parametrize("hold", [[1.0], [1.0] * 5, [float("nan")] * 4])
def test_a_hold_fits_the_robot(hold: list[float]) -> None:
    with pytest.raises(ValueError, match="4 finite numbers"):
        ActionQueue(INFO, hold=hold)
