"""SE(2) poses: round trips, axes, arcs and lengths."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lanenet.geometry.poses import (
    arc_chord,
    between_on_arc,
    compose,
    moved_rigidly,
    path_lengths,
    relative_pose,
)

POSE = st.tuples(st.floats(-500.0, 500.0), st.floats(-500.0, 500.0), st.floats(-20.0, 20.0)).map(np.array)


@settings(max_examples=80, deadline=None)
@given(POSE, POSE)
def test_relative_pose_round_trip(origin, pose):
    relative = relative_pose(origin, pose)
    assert -np.pi < relative[2] <= np.pi
    back = compose(origin, relative)
    np.testing.assert_allclose(back[:2], pose[:2], atol=1e-9)
    assert np.cos(back[2] - pose[2]) == pytest.approx(1.0, abs=1e-12)


def test_relative_pose_is_ahead_then_left():
    origin = np.array([10.0, 20.0, np.pi / 2.0])
    for pose, expected in (
        ([10.0, 25.0, np.pi], [5.0, 0.0, np.pi / 2.0]),
        ([7.0, 20.0, np.pi / 2.0], [0.0, 3.0, 0.0]),
        ([10.0, 20.0, 0.0], [0.0, 0.0, -np.pi / 2.0]),
    ):
        np.testing.assert_allclose(relative_pose(origin, np.array(pose)), expected, atol=1e-12)


def test_many_poses_are_as_one_by_one():
    rng = np.random.default_rng(2)
    a, b = rng.normal(size=(2, 7, 3)) * [100.0, 100.0, 2.0]
    for function in (compose, relative_pose):
        one_by_one = [function(x, y) for x, y in zip(a, b, strict=True)]
        np.testing.assert_allclose(function(a, b), one_by_one, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(function(a[0], b), [function(a[0], y) for y in b], rtol=1e-12, atol=1e-12)


@settings(max_examples=40, deadline=None)
@given(POSE, POSE)
def test_a_rigid_motion_keeps_relative_poses(place, to):
    poses = place + np.array([[0.0, 0.0, 0.0], [5.0, 1.0, 0.3], [9.0, -4.0, 1.0]])
    moved = moved_rigidly(poses, poses[0], to)
    np.testing.assert_allclose(moved[0], to, atol=1e-9)
    np.testing.assert_allclose(
        relative_pose(moved[0], moved[1:]), relative_pose(poses[0], poses[1:]), atol=1e-9
    )


def test_an_arc_ends_on_its_circle():
    radius_cm, heading_rad = 50.0, 0.4
    turn_rad = np.array([-1.5, -0.2, 0.0, 0.7, 3.0])
    chord = arc_chord(np.full(5, heading_rad), np.where(turn_rad == 0.0, 8.0, radius_cm * turn_rad), turn_rad)
    # Centre to the left; a negative turn with a negative length drives the circle backwards.
    end = heading_rad + turn_rad
    expected = radius_cm * np.stack(
        [np.sin(end) - np.sin(heading_rad), np.cos(heading_rad) - np.cos(end)], axis=1
    )
    expected[2] = 8.0 * np.array([np.cos(heading_rad), np.sin(heading_rad)])
    np.testing.assert_allclose(chord, expected, atol=1e-9)


@pytest.mark.parametrize("turn_rad", [-2.0, 0.0, 0.6])
def test_poses_between_lie_on_the_arc(turn_rad):
    start, length_cm = np.array([3.0, -2.0, 0.8]), 12.0
    share = np.linspace(0.0, 1.0, 6)
    expected = np.column_stack(
        [
            start[:2] + arc_chord(np.full(6, start[2]), share * length_cm, share * turn_rad),
            start[2] + share * turn_rad,
        ]
    )
    found = between_on_arc(np.tile(start, (6, 1)), np.tile(expected[-1], (6, 1)), share)
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_path_lengths_add_up():
    poses = np.array([[0.0, 0.0, 0.0], [3.0, 4.0, 1.0], [3.0, 4.0, 2.0], [3.0, 10.0, 2.0]])
    np.testing.assert_allclose(path_lengths(poses), [0.0, 5.0, 5.0, 11.0])
