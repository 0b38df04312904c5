from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from boards import BOARD, MOUNTING, fisheye_of

from lanenet.calibration.chessboard import BoardView
from lanenet.calibration.ground import calibrate_ground, points_of_floor_board
from lanenet.errors import CalibrationError
from lanenet.geometry.camera import Camera, Mounting

GRID_CM = np.stack(np.meshgrid(np.linspace(-30.0, 30.0, 4), np.linspace(15.0, 70.0, 4)), axis=-1).reshape(
    -1, 2
)


def camera_and_points(noise_px: float = 0.0) -> tuple[Camera, np.ndarray]:
    rng = np.random.default_rng(5)
    camera = fisheye_of(170.0, rng)
    pixels = camera.project_ground(GRID_CM)
    return camera, pixels + rng.normal(0.0, 1.0, pixels.shape) * noise_px


def lens_only(camera: Camera) -> Camera:
    return Camera(camera.model, camera.width, camera.height, camera.K, camera.D, Mounting(20.0), 26.0)


def test_exact_points_give_the_exact_mounting() -> None:
    camera, pixels = camera_and_points()
    found = calibrate_ground(lens_only(camera), GRID_CM, pixels)
    for name, value in vars(MOUNTING).items():
        assert getattr(found.camera.mounting, name) == pytest.approx(value, abs=1e-5), name
    assert found.rms_px < 1e-6 and found.used.all()


def test_noise_stays_within_the_stated_uncertainty() -> None:
    camera, pixels = camera_and_points(0.3)
    found = calibrate_ground(lens_only(camera), GRID_CM, pixels)
    for name, value in vars(MOUNTING).items():
        assert abs(getattr(found.camera.mounting, name) - value) < 4.0 * found.sigma[name], name
    assert found.sigma["height_cm"] < 0.5
    assert 0.2 < found.rms_px < 0.6
    assert set(found.residuals) >= {"ground_rms_px", "height_sigma_cm", "pitch_down_sigma_rad"}


def test_false_points_are_left_out() -> None:
    camera, pixels = camera_and_points(0.1)
    pixels[[2, 9, 14]] += [[40.0, 5.0], [-25.0, 10.0], [0.0, 60.0]]
    found = calibrate_ground(lens_only(camera), GRID_CM, pixels)
    assert np.flatnonzero(~found.used).tolist() == [2, 9, 14]
    assert found.camera.mounting.height_cm == pytest.approx(MOUNTING.height_cm, abs=0.3)


def test_points_that_decide_nothing_are_refused() -> None:
    camera, pixels = camera_and_points()
    lens = lens_only(camera)
    with pytest.raises(CalibrationError, match="3 ground point"):
        calibrate_ground(lens, GRID_CM[:3], pixels[:3])
    with pytest.raises(CalibrationError, match="on one line"):
        calibrate_ground(lens, GRID_CM[:4], pixels[:4])
    with pytest.raises(CalibrationError, match="mirrored"):
        calibrate_ground(lens, GRID_CM * [-1.0, 1.0], pixels)
    with pytest.raises(CalibrationError, match="point 1: pixel"):
        calibrate_ground(lens, GRID_CM, pixels + [1000.0, 0.0])
    with pytest.raises(CalibrationError, match="not finite"):
        calibrate_ground(lens, np.full_like(GRID_CM, np.nan), pixels)


def test_random_points_give_an_error_and_no_camera() -> None:
    rng = np.random.default_rng(0)
    lens = lens_only(camera_and_points()[0])
    for _ in range(5):
        with pytest.raises(CalibrationError):
            calibrate_ground(lens, rng.uniform(-50.0, 50.0, (12, 2)), rng.uniform(0.0, 470.0, (12, 2)))


@pytest.mark.parametrize("order", ["as is", "turned", "flipped", "upright"])
def test_a_board_on_the_floor_gives_ground_points(order: str) -> None:
    camera, _ = camera_and_points()
    points = np.array([-10.0, 25.0]) + BOARD.points_cm()
    if order == "upright":
        points = np.array([-10.0, 25.0]) + BOARD.points_cm()[:, ::-1]
    corners = camera.project_ground(points)
    # A finder may start at any corner; the board's own numbering is not the car's.
    grid = corners.reshape(6, 9, 2)
    if order == "turned":
        grid = grid[::-1, ::-1]
    if order == "flipped":
        grid = grid[:, ::-1]
    view = BoardView("floor", 640, 480, BOARD.points_cm(), grid.reshape(-1, 2).copy())
    found_cm, pixels = points_of_floor_board(view, BOARD, (-10.0, 25.0))
    np.testing.assert_allclose(camera.project_ground(found_cm), pixels, atol=1e-9)
    found = calibrate_ground(lens_only(camera), found_cm, pixels)
    assert found.camera.mounting.height_cm == pytest.approx(MOUNTING.height_cm, abs=1e-4)


def reference(folder: Path, name: str) -> tuple[Camera, np.ndarray, np.ndarray]:
    """Camera of the data set, corners of its cloth in the reference's picture and in the image."""
    storage = cv2.FileStorage(str(folder / "yaml" / f"{name}.yaml"), cv2.FILE_STORAGE_READ)
    K, H = storage.getNode("camera_matrix").mat(), storage.getNode("project_matrix").mat()
    D = storage.getNode("dist_coeffs").mat().ravel()
    scale, shift = (storage.getNode(key).mat().ravel() for key in ("scale_xy", "shift_xy"))
    camera = Camera("fisheye", 960, 640, K, D, Mounting(20.0), 260.0)
    right = 900.0 if name in ("front", "back") else 1300.0
    cloth = np.stack(np.meshgrid(np.arange(300.0, right + 1, 40.0), np.arange(300.0, 461.0, 40.0)), axis=-1)
    flat = cv2.perspectiveTransform(cloth.reshape(1, -1, 2), np.linalg.inv(H))[0]
    rays = np.column_stack(
        [(flat - K[[0, 1], [2, 2]] * 1.0 - shift) / (K[[0, 1], [0, 1]] * scale), np.ones(len(flat))]
    )
    return camera, cloth.reshape(-1, 2), camera.project_rays(rays)


@pytest.mark.parametrize("name", ["front", "back", "left", "right"])
def test_the_cloth_of_a_real_fisheye_becomes_square(shared_data: Path, name: str) -> None:
    camera, cloth_px, pixels = reference(shared_data / "fisheye_ground", name)
    # The reference's picture has v downwards; its pixels are close to centimetres.
    found = calibrate_ground(camera, cloth_px * [1.0, -1.0], pixels)
    # The reference joins a free homography to four clicked corners; a camera that stands somewhere has two
    # degrees of freedom less, and differs from it where the cloth leaves the field of its four corners.
    distance = np.linalg.norm(found.residuals_px, axis=1)
    assert np.median(distance) < 1.0
    assert 60.0 < found.camera.mounting.height_cm < 110.0


def test_points_in_metres_are_refused() -> None:
    camera, pixels = camera_and_points()
    with pytest.raises(CalibrationError, match="in centimetres"):
        calibrate_ground(lens_only(camera), 0.01 * GRID_CM, pixels)
