from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from lanenet.geometry.frames import (
    car_from_map,
    left_from_donkey,
    map_from_car,
    map_from_car_directions,
    wrap_angle,
)

WHEELBASE_CM = 26.0

lengths_cm = st.floats(-1000.0, 1000.0)
headings_rad = st.floats(-20.0, 20.0)
points_cm = hnp.arrays(np.float64, st.tuples(st.integers(0, 8), st.just(2)), elements=lengths_cm)
poses = st.tuples(lengths_cm, lengths_cm, headings_rad).map(np.array)


def test_map_from_car_puts_the_car_frame_at_the_front_axle() -> None:
    # Heading along map x: ahead is +x, and right of the car is -y.
    at_origin = map_from_car(np.array([[0.0, 0.0], [10.0, 5.0]]), np.zeros(3), WHEELBASE_CM)
    np.testing.assert_allclose(at_origin, [[26.0, 0.0], [31.0, -10.0]], atol=1e-12)
    # Heading along map y, rear axle at (100, 200): ahead is +y, right is +x.
    turned = map_from_car(np.array([[0.0, 0.0], [10.0, 5.0]]), np.array([100.0, 200.0, np.pi / 2]), 26.0)
    np.testing.assert_allclose(turned, [[100.0, 226.0], [110.0, 231.0]], atol=1e-12)


def test_car_from_map_sees_the_rear_axle_behind_the_origin() -> None:
    pose = np.array([12.0, -7.0, 0.8])
    np.testing.assert_allclose(car_from_map(pose[None, :2], pose, WHEELBASE_CM), [[0.0, -26.0]], atol=1e-12)


@given(points_cm, poses, st.floats(1.0, 60.0))
def test_map_and_car_undo_each_other(points: np.ndarray, pose: np.ndarray, wheelbase_cm: float) -> None:
    there = map_from_car(points, pose, wheelbase_cm)
    np.testing.assert_allclose(car_from_map(there, pose, wheelbase_cm), points, atol=1e-9)
    back = car_from_map(points, pose, wheelbase_cm)
    np.testing.assert_allclose(map_from_car(back, pose, wheelbase_cm), points, atol=1e-9)


@given(points_cm, poses)
def test_map_from_car_keeps_distances_and_turning_sense(points: np.ndarray, pose: np.ndarray) -> None:
    moved = map_from_car(points, pose, WHEELBASE_CM)
    d_car, d_map = np.diff(points, axis=0), np.diff(moved, axis=0)
    np.testing.assert_allclose(np.linalg.norm(d_map, axis=1), np.linalg.norm(d_car, axis=1), atol=1e-9)
    # Both frames are right-handed with z up, so the transform is a rotation and not a mirror image.
    cross_car = d_car[:-1, 0] * d_car[1:, 1] - d_car[:-1, 1] * d_car[1:, 0]
    cross_map = d_map[:-1, 0] * d_map[1:, 1] - d_map[:-1, 1] * d_map[1:, 0]
    np.testing.assert_allclose(cross_map, cross_car, atol=1e-5)


@given(points_cm, poses)
def test_directions_turn_like_differences_of_points(points: np.ndarray, pose: np.ndarray) -> None:
    origin = map_from_car(np.zeros((1, 2)), pose, WHEELBASE_CM)
    expected = map_from_car(points, pose, WHEELBASE_CM) - origin
    np.testing.assert_allclose(map_from_car_directions(points, float(pose[2])), expected, atol=1e-9)


@pytest.mark.parametrize(
    ("angle", "wrapped"),
    [
        (0.0, 0.0),
        (np.pi, np.pi),
        (-np.pi, np.pi),
        (3 * np.pi, np.pi),
        (1.5 * np.pi, -0.5 * np.pi),
        (-1.5 * np.pi, 0.5 * np.pi),
        (np.deg2rad(179) - np.deg2rad(-179), np.deg2rad(-2)),
    ],
)
def test_wrap_angle_values(angle: float, wrapped: float) -> None:
    np.testing.assert_allclose(wrap_angle(np.array([angle])), [wrapped], atol=1e-12)


@given(hnp.arrays(np.float64, st.integers(0, 8), elements=st.floats(-1e4, 1e4)))
def test_wrap_angle_stays_in_range_and_keeps_the_direction(angles: np.ndarray) -> None:
    wrapped = wrap_angle(angles)
    assert np.all((wrapped >= -np.pi) & (wrapped <= np.pi))
    np.testing.assert_allclose(np.cos(wrapped), np.cos(angles), atol=1e-9)
    np.testing.assert_allclose(np.sin(wrapped), np.sin(angles), atol=1e-9)


def test_donkeycars_left_is_positive():
    np.testing.assert_array_equal(left_from_donkey(np.array([-1.0, 0.25])), [1.0, -0.25])
