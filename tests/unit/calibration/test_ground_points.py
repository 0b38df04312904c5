from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from chessboards import BOARD, MOUNTING, fisheye_of

from lanenet.calibration.chessboard import BoardView
from lanenet.calibration.ground import calibrate_ground, points_of_floor_board
from lanenet.calibration.lens import moved_points, pose_from_mounting, project_points
from lanenet.errors import CalibrationError
from lanenet.geometry.camera import Camera, Mounting

GRID_CM = np.stack(np.meshgrid(np.linspace(-30.0, 30.0, 4), np.linspace(15.0, 70.0, 4)), axis=-1).reshape(
    -1, 2
)

PINHOLE = Camera(
    "pinhole",
    640,
    480,
    np.array([[420.0, 0.0, 325.0], [0.0, 423.0, 236.0], [0.0, 0.0, 1.0]]),
    np.array([-0.12, 0.02, 0.001, -0.0005, 0.0]),
    MOUNTING,
    26.0,
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
    for name, value in dataclasses.asdict(MOUNTING).items():
        assert getattr(found.camera.mounting, name) == pytest.approx(value, abs=1e-5), name
    assert found.rms_px < 1e-6 and found.used.all()


def test_noise_stays_within_the_stated_uncertainty() -> None:
    camera, pixels = camera_and_points(0.3)
    found = calibrate_ground(lens_only(camera), GRID_CM, pixels)
    for name, value in dataclasses.asdict(MOUNTING).items():
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
    with pytest.raises(CalibrationError, match="point 1: pixel"):
        calibrate_ground(lens, GRID_CM, pixels + [1000.0, 0.0])
    with pytest.raises(CalibrationError, match="not finite"):
        calibrate_ground(lens, np.full_like(GRID_CM, np.nan), pixels)


def test_random_points_give_an_error_and_no_camera() -> None:
    rng = np.random.default_rng(0)
    lens = lens_only(camera_and_points()[0])
    for _ in range(3):
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


def test_points_in_metres_are_refused() -> None:
    camera, pixels = camera_and_points()
    with pytest.raises(CalibrationError, match="in centimetres"):
        calibrate_ground(lens_only(camera), 0.01 * GRID_CM, pixels)


def seen(camera: Camera, points_cm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points that lie in the image, and their pixels."""
    pixels = camera.project_ground(points_cm)
    with np.errstate(invalid="ignore"):
        inside = ((pixels >= 0.0) & (pixels <= [camera.width - 1, camera.height - 1])).all(axis=1)
    return points_cm[inside], pixels[inside]


@pytest.mark.parametrize("model", ["fisheye", "pinhole"])
@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("x", "mirrored.*x_cm counts to the left"),
        ("y", "mirrored.*y_cm counts backwards"),
        ("xy", "mirrored.*x_cm and y_cm are swapped"),
        ("v", "mirrored.*v_px counts upwards"),
        ("both", "look backwards, 17[0-9] degrees.*both have the wrong sign"),
    ],
)
def test_false_axes_are_named(model: str, fault: str, message: str) -> None:
    camera = camera_and_points()[0] if model == "fisheye" else PINHOLE
    points, pixels = seen(camera, GRID_CM)
    pixels = pixels + np.random.default_rng(0).normal(0.0, 0.3, pixels.shape)
    flipped = {
        "x": (points * [-1.0, 1.0], pixels),
        "y": (points * [1.0, -1.0], pixels),
        "xy": (points[:, ::-1].copy(), pixels),
        "v": (points, [0.0, camera.height - 1.0] + pixels * [1.0, -1.0]),
        "both": (-points, pixels),
    }
    with pytest.raises(CalibrationError, match=message):
        calibrate_ground(lens_only(camera), *flipped[fault])


def test_swapped_pixel_columns_are_named() -> None:
    camera, pixels = camera_and_points()
    # All of them inside the image still, then some outside it.
    low = pixels[:, 0] < camera.height
    with pytest.raises(CalibrationError, match=r"mirrored.*u_px and v_px are swapped"):
        calibrate_ground(lens_only(camera), GRID_CM[low], pixels[low, ::-1].copy())
    with pytest.raises(CalibrationError, match=r"outside the image.*u_px and v_px swapped"):
        calibrate_ground(lens_only(camera), GRID_CM, pixels[:, ::-1].copy())
    with pytest.raises(CalibrationError, match=r"outside the image.*x_cm, y_cm hold the pixels"):
        calibrate_ground(lens_only(camera), pixels, GRID_CM)


@pytest.mark.parametrize(("yaw_deg", "side"), [(120.0, "120 degrees to the left"), (-150.0, "150 .* right")])
def test_a_camera_that_looks_backwards_is_refused(yaw_deg: float, side: str) -> None:
    camera = camera_and_points()[0].with_mounting(yaw_rad=float(np.deg2rad(yaw_deg)))
    angle = np.deg2rad(yaw_deg)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    points, pixels = seen(camera, GRID_CM @ turn.T)
    with pytest.raises(CalibrationError, match=f"look backwards, {side}"):
        calibrate_ground(lens_only(camera), points, pixels)


@pytest.mark.parametrize("yaw_deg", [80.0, -80.0])
def test_a_camera_that_looks_aside_is_found(yaw_deg: float) -> None:
    angle = float(np.deg2rad(yaw_deg))
    camera = camera_and_points()[0].with_mounting(yaw_rad=angle)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    points, pixels = seen(camera, GRID_CM @ turn.T)
    found = calibrate_ground(lens_only(camera), points, pixels).camera.mounting
    assert found.yaw_rad == pytest.approx(angle, abs=1e-5)


def test_points_behind_the_camera_are_named() -> None:
    points, pixels = seen(PINHOLE, GRID_CM)
    # Two points whose y_cm lost its way: the camera stands 3 cm ahead of the front axle.
    false = points.copy()
    false[[1, 4], 1] = [-40.0, -25.0]
    found = calibrate_ground(lens_only(PINHOLE), false, pixels)
    assert np.flatnonzero(~found.used).tolist() == [1, 4]
    assert np.flatnonzero(found.behind).tolist() == [1, 4]
    assert found.camera.mounting.height_cm == pytest.approx(MOUNTING.height_cm, abs=1e-3)


def test_points_past_the_fold_of_a_lens_are_left_out() -> None:
    # theta (1 - 0.16 theta^2) grows up to 1.44 rad; beyond, a point comes out where another one belongs.
    K = np.array([[180.0, 0.0, 319.5], [0.0, 180.0, 239.5], [0.0, 0.0, 1.0]])
    camera = Camera("fisheye", 640, 480, K, np.array([-0.16, 0.0, 0.0, 0.0]), Mounting(18.0, 0.45), 26.0)
    points = np.concatenate([GRID_CM, [[60.0, -10.0], [90.0, -15.0]]])
    seen_before = np.isfinite(camera.project_ground(points)).all(axis=1)
    assert seen_before.tolist() == [True] * len(GRID_CM) + [False] * 2
    rays = moved_points(pose_from_mounting(camera.mounting), points)[0]
    pixels = project_points("fisheye", np.array([180.0, 180.0, 319.5, 239.5, *camera.D]), rays)[0]
    found = calibrate_ground(lens_only(camera), points, pixels)
    assert (found.used == seen_before).all() and (found.behind == ~seen_before).all()
    assert found.camera.mounting.height_cm == pytest.approx(18.0, abs=1e-4)
    few = np.array([0, 3, 12, len(GRID_CM), len(GRID_CM) + 1])
    with pytest.raises(CalibrationError, match="3 of 5 points lie in the camera's sight"):
        calibrate_ground(lens_only(camera), points[few], pixels[few])


def test_near_points_laid_out_by_hand_do_not_outweigh_far_ones() -> None:
    # Laid out to 2 mm and clicked to half a pixel: near the car 2 mm are several pixels.
    camera, _ = camera_and_points()
    wide = np.stack(np.meshgrid(np.linspace(-30.0, 30.0, 5), [12.0, 18.0, 30.0, 60.0, 100.0]), axis=-1)
    points, pixels = seen(camera, wide.reshape(-1, 2))
    errors, claimed = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        laid = points + rng.normal(0.0, 0.2, points.shape)
        found = calibrate_ground(lens_only(camera), laid, pixels + rng.normal(0.0, 0.5, pixels.shape))
        assert found.used.all()
        errors.append(found.camera.mounting.pitch_down_rad - MOUNTING.pitch_down_rad)
        claimed.append(found.sigma["pitch_down_rad"])
    assert np.sqrt(np.mean(np.square(errors))) < np.deg2rad(0.12)
    # The stated uncertainty is the true one.
    assert 0.6 < np.sqrt(np.mean(np.square(errors))) / np.mean(claimed) < 1.6
