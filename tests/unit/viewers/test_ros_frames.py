"""Frames of ROS against those of this project."""

from __future__ import annotations

import numpy as np
import pytest
from small_map import CAMERA
from watched import rotation

from lanenet.geometry.frames import map_from_car
from lanenet.viewers.ros_frames import base_from_car_m, camera_in_base_m, map_m, pose_m, quaternion


def test_ahead_is_x_left_is_y_and_the_origin_is_the_rear_axle() -> None:
    # 30 cm ahead of the front axle and 20 cm to the right; the wheelbase is 25 cm.
    np.testing.assert_allclose(base_from_car_m(np.array([[20.0, 30.0]]), 25.0), [[0.55, -0.20, 0.0]])


def test_points_come_to_the_same_place_by_the_pose_of_ros() -> None:
    rng = np.random.default_rng(0)
    points_cm = rng.uniform(-100.0, 100.0, (20, 2))
    for heading in (0.3, -2.0, 9.0):
        pose = np.array([120.0, -50.0, heading])
        position, q = pose_m(pose)
        by_ros = base_from_car_m(points_cm, 17.0) @ rotation(q).T + position
        np.testing.assert_allclose(by_ros, map_m(map_from_car(points_cm, pose, 17.0)), atol=1e-12)


def test_the_optical_frame_sees_the_road_where_the_camera_does() -> None:
    camera = CAMERA.with_mounting(yaw_rad=0.1, roll_rad=-0.05, right_of_centre_cm=2.0)
    points_cm = np.array([[0.0, 30.0], [-15.0, 40.0], [20.0, 60.0]])
    position, q = camera_in_base_m(camera)
    in_optical = (base_from_car_m(points_cm, camera.wheelbase_cm) - position) @ rotation(q)
    assert (in_optical[:, 2] > 0.0).all()
    np.testing.assert_allclose(camera.project_rays(in_optical), camera.project_ground(points_cm), atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_quaternions_turn_as_their_matrices(seed: int) -> None:
    matrix = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    matrix *= np.sign(np.linalg.det(matrix))
    q = quaternion(matrix)
    assert np.linalg.norm(q) == pytest.approx(1.0) and q[3] >= 0.0
    np.testing.assert_allclose(rotation(q), matrix, atol=1e-12)
