from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lanenet.calibration.lens import (
    camera_of_lens,
    mounting_from_pose,
    moved_points,
    pose_from_mounting,
    pose_of_plane,
    project_points,
    rotation_from_vector,
    vector_from_rotation,
)
from lanenet.geometry.camera import CameraModel, Mounting

LENSES: dict[CameraModel, np.ndarray] = {
    "fisheye": np.array([180.0, 183.0, 321.0, 242.0, -0.03, 0.008, -0.002, 0.0002]),
    "pinhole": np.array([400.0, 405.0, 321.0, 242.0, -0.25, 0.06, 0.0012, -0.0007, -0.004]),
}
POINTS = np.array([[3.0, 1.0, 9.0], [-4.0, 2.0, 8.0], [0.5, -3.0, 10.0], [0.0, 0.0, 5.0], [2.0, 3.0, 7.0]])
#: Past 90 degrees, which only a fisheye sees.
BEHIND = np.array([[5.0, 1.0, -1.0], [-6.0, 2.0, -0.5]])
angle = st.floats(-0.6, 0.6)
length = st.floats(-30.0, 30.0)


@pytest.mark.parametrize("model", ["fisheye", "pinhole"])
def test_projection_is_the_cameras(model: CameraModel) -> None:
    points = np.concatenate([POINTS, BEHIND]) if model == "fisheye" else POINTS
    pixels, _, _ = project_points(model, LENSES[model], points)
    camera = camera_of_lens(model, LENSES[model], (640, 480))
    np.testing.assert_allclose(pixels, camera.project_rays(points), rtol=0, atol=1e-6)


@pytest.mark.parametrize("model", ["fisheye", "pinhole"])
def test_derivatives_are_those_of_differences(model: CameraModel) -> None:
    points = np.concatenate([POINTS[[0, 1, 2, 4]], BEHIND]) if model == "fisheye" else POINTS
    lens, step = LENSES[model], 1e-6
    _, by_point, by_lens = project_points(model, lens, points)
    for k in range(3):
        move = step * np.eye(3)[k]
        ends = [project_points(model, lens, points + s * move)[0] for s in (1, -1)]
        np.testing.assert_allclose(by_point[:, :, k], (ends[0] - ends[1]) / (2 * step), rtol=1e-5, atol=1e-5)
    for k in range(len(lens)):
        move = step * np.eye(len(lens))[k]
        ends = [project_points(model, lens + s * move, points)[0] for s in (1, -1)]
        np.testing.assert_allclose(by_lens[:, :, k], (ends[0] - ends[1]) / (2 * step), rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("vector", [[0.3, -0.2, 1.1], [0.0, 0.0, 0.0], [3.0, 0.1, 0.0]])
def test_a_pose_and_its_derivatives(vector: list[float]) -> None:
    pose, step = np.array([*vector, 1.0, 2.0, 3.0]), 1e-6
    plane = POINTS[:, :2]
    moved, by_pose = moved_points(pose, plane)
    axes = rotation_from_vector(pose[:3])[:, :2]
    np.testing.assert_allclose(moved, plane @ axes.T + pose[3:], atol=1e-12)
    np.testing.assert_allclose(vector_from_rotation(rotation_from_vector(pose[:3])), vector, atol=1e-9)
    for k in range(6):
        move = step * np.eye(6)[k]
        difference = moved_points(pose + move, plane)[0] - moved_points(pose - move, plane)[0]
        np.testing.assert_allclose(by_pose[:, :, k], difference / (2 * step), atol=1e-5)


@settings(max_examples=50)
@given(st.floats(5.0, 40.0), st.floats(-0.2, 1.4), angle, angle, length, length)
def test_mounting_and_pose_undo_each_other(
    height: float, pitch: float, roll: float, yaw: float, ahead: float, right: float
) -> None:
    mounting = Mounting(height, pitch, roll, yaw, ahead, right)
    found = mounting_from_pose(pose_from_mounting(mounting))
    for name in mounting.__dataclass_fields__:
        assert getattr(found, name) == pytest.approx(getattr(mounting, name), abs=1e-6), name


@settings(max_examples=50)
@given(st.floats(5.0, 40.0), st.floats(0.0, 1.2), angle, angle)
def test_a_plane_is_found_from_its_rays(height: float, pitch: float, roll: float, yaw: float) -> None:
    mounting = Mounting(height, pitch, roll, yaw, 2.0, -1.0)
    # Points beside and behind the camera as well: rays in any direction count.
    points = np.array([[-30.0, 5.0], [30.0, 10.0], [0.0, 60.0], [20.0, -8.0], [-10.0, 30.0]])
    solid = np.column_stack([points, np.zeros(len(points))])
    rays = (solid - mounting.position_car_cm) @ mounting.camera_from_car.T
    pose = pose_of_plane(points, rays / np.linalg.norm(rays, axis=1, keepdims=True))
    assert pose is not None
    np.testing.assert_allclose(moved_points(pose, points)[0], rays, atol=1e-6)


def test_points_on_a_line_are_no_plane() -> None:
    line = np.stack([np.arange(6.0), 2.0 * np.arange(6.0)], axis=1)
    rays = np.column_stack([line - [2.0, 4.0], np.full(6, 10.0)])
    assert pose_of_plane(line, rays / np.linalg.norm(rays, axis=1, keepdims=True)) is None
    assert pose_of_plane(np.zeros((5, 2)), np.full((5, 3), np.nan)) is None
