"""LIBERO's conventions, one by one, against numbers worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from comvla_sim.worlds.libero.conventions import (
    MAX_STEPS,
    axis_angle,
    gripper_from_policy,
    proprioception,
    upright,
)
from comvla_sim.worlds.libero.rotations import matrix, rotation_vector
from comvla_sim.worlds.libero.scene import Cameras

UNIT = st.floats(-1, 1, allow_nan=False)


def test_a_policy_opens_with_one_and_libero_with_minus_one() -> None:
    chunk = np.full((5, 7), 0.25)
    chunk[:, 6] = [1.0, 0.0, 0.51, 0.49, 0.5]
    converted = gripper_from_policy(chunk)
    np.testing.assert_array_equal(converted[:, 6], [-1, 1, -1, 1, 0])
    np.testing.assert_array_equal(converted[:, :6], chunk[:, :6])
    assert chunk[0, 6] == 1.0, "the policy's own array stays as it is"
    assert gripper_from_policy(chunk[0]).shape == (7,)
    assert not np.signbit(converted[4, 6])


def test_frames_are_turned_by_half_a_turn() -> None:
    frames = np.arange(2 * 3 * 4 * 3, dtype=np.uint8).reshape(2, 3, 4, 3)
    turned = upright(frames)
    np.testing.assert_array_equal(turned[1, 0, 0], frames[1, 2, 3])
    np.testing.assert_array_equal(turned[0], frames[0][::-1, ::-1])
    assert turned.flags.c_contiguous


@pytest.mark.parametrize(
    ("quaternion", "expected"),
    [
        ((0, 0, 0, 1), (0, 0, 0)),
        ((0, 0, 0, -1), (0, 0, 0)),
        ((1, 0, 0, 0), (np.pi, 0, 0)),
        ((0, np.sin(0.2), 0, np.cos(0.2)), (0, 0.4, 0)),
        # No sign is chosen: more than half a turn stays more than half a turn.
        ((0, 0, np.sin(2.0), np.cos(2.0)), (0, 0, 4.0)),
        ((0, 0, 0, 1.0000001), (0, 0, 0)),
    ],
)
def test_orientations_become_axis_times_angle(
    quaternion: tuple[float, ...], expected: tuple[float, ...]
) -> None:
    np.testing.assert_allclose(axis_angle(quaternion), expected, atol=1e-12)


def test_proprioception_is_position_then_orientation_then_fingers() -> None:
    values = proprioception([1, 2, 3], [1, 0, 0, 0], [0.04, -0.03])
    np.testing.assert_allclose(values, [1, 2, 3, np.pi, 0, 0, 0.04, -0.03], rtol=1e-6)
    assert values.dtype == np.float32


def test_step_limits_are_those_of_the_evaluation() -> None:
    assert MAX_STEPS == {
        "libero_spatial": 220,
        "libero_object": 280,
        "libero_goal": 300,
        "libero_10": 520,
    }


@given(st.tuples(UNIT, UNIT, UNIT, UNIT).filter(lambda q: sum(x * x for x in q) > 0.01))
def test_a_rotation_and_its_vector_belong_together(values: tuple[float, ...]) -> None:
    quaternion = np.array(values) / np.linalg.norm(values)
    rotation = matrix(quaternion)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    angle = float(np.linalg.norm(axis_angle(quaternion)))
    short = min(angle, 2 * np.pi - angle)
    # Near half a turn the axis cannot be read off the matrix's skew part.
    if short < 3.0:
        assert np.linalg.norm(rotation_vector(rotation)) == pytest.approx(short, abs=1e-6)


def test_points_appear_where_the_turned_pictures_show_them() -> None:
    # A camera at z = 2 that looks straight down, its right side along x and its top along y.
    cameras = Cameras(np.array([[0, 0, 2.0]]), np.eye(3)[None], np.array([90.0]))
    uv = cameras.project([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 3]])[0]
    np.testing.assert_allclose(uv[0], [0.5, 0.5])
    np.testing.assert_allclose(
        uv[1], [0.25, 0.5], err_msg="right in the world, left in the picture"
    )
    np.testing.assert_allclose(uv[2], [0.5, 0.25], err_msg="what is up stays up")
    assert np.isnan(uv[3]).all()
