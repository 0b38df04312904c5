from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lanenet.geometry.camera import Camera, CameraModel, Mounting

K = np.array([[107.8, 0.0, 159.5], [0.0, 106.3, 119.5], [0.0, 0.0, 1.0]])
#: Coefficients of the size that calibrations of wide-angle lenses find.
FISHEYE_D = np.array([-0.03, 0.008, -0.002, 0.0002])
PINHOLE_D = np.array([-0.25, 0.06, 0.0012, -0.0007, -0.004])
LEVEL = Mounting(height_cm=20.0)
TILTED = Mounting(
    height_cm=20.0,
    pitch_down_rad=0.44,
    roll_rad=0.03,
    yaw_rad=-0.02,
    ahead_of_front_axle_cm=-2.0,
    right_of_centre_cm=0.7,
)


def make_camera(model: CameraModel, D: np.ndarray | None = None, mounting: Mounting = TILTED) -> Camera:
    if D is None:
        D = FISHEYE_D if model == "fisheye" else PINHOLE_D
    return Camera(model=model, width=320, height=240, K=K, D=D, mounting=mounting, wheelbase_cm=26.0)


def rays_at(angles_rad: np.ndarray, azimuths_rad: np.ndarray) -> np.ndarray:
    sine = np.sin(angles_rad)
    return np.stack([sine * np.cos(azimuths_rad), sine * np.sin(azimuths_rad), np.cos(angles_rad)], axis=1)


def random_rays(max_angle_rad: float, n: int = 400) -> np.ndarray:
    rng = np.random.default_rng(0)
    return rays_at(rng.uniform(0.0, max_angle_rad, n), rng.uniform(-np.pi, np.pi, n))


def test_fisheye_agrees_with_opencv() -> None:
    rays = random_rays(np.deg2rad(80.0)) * 3.0
    expected, _ = cv2.fisheye.projectPoints(rays[:, None], np.zeros(3), np.zeros(3), K, FISHEYE_D)
    pixels = make_camera("fisheye").project_rays(rays)
    np.testing.assert_allclose(pixels, expected.reshape(-1, 2), rtol=0, atol=1e-6)


@pytest.mark.parametrize("n_coefficients", [4, 5])
def test_pinhole_agrees_with_opencv(n_coefficients: int) -> None:
    D = PINHOLE_D[:n_coefficients]
    camera = make_camera("pinhole", D)
    rays = random_rays(min(camera.max_angle_rad, np.deg2rad(50.0))) * 3.0
    expected, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, D)
    np.testing.assert_allclose(camera.project_rays(rays), expected.reshape(-1, 2), rtol=0, atol=1e-6)


def test_the_optical_axis_meets_the_principal_point() -> None:
    axis = np.array([[0.0, 0.0, 2.5]])
    for model in ("fisheye", "pinhole"):
        np.testing.assert_allclose(make_camera(model).project_rays(axis), [[159.5, 119.5]], atol=1e-12)
        np.testing.assert_allclose(
            make_camera(model).unproject(np.array([[159.5, 119.5]])), [[0.0, 0.0, 1.0]], atol=1e-12
        )


def test_equidistant_fisheye_by_hand() -> None:
    # With D = 0 the radius is f * angle: a ray 100 degrees to the right lies 107.8 * 1.74533 px out.
    camera = make_camera("fisheye", np.zeros(4))
    pixel = camera.project_rays(rays_at(np.deg2rad([100.0]), np.array([0.0])))
    np.testing.assert_allclose(pixel, [[159.5 + 107.8 * np.deg2rad(100.0), 119.5]], atol=1e-9)


@given(st.floats(0.0, 0.999), st.floats(-np.pi, np.pi))
def test_fisheye_project_and_unproject_undo_each_other_past_90_degrees(share: float, azimuth: float) -> None:
    for D in (np.zeros(4), FISHEYE_D):
        camera = make_camera("fisheye", D)
        assert camera.max_angle_rad > np.deg2rad(100.0)
        angle = share * min(camera.max_angle_rad, np.deg2rad(140.0))
        rays = rays_at(np.array([angle]), np.array([azimuth]))
        np.testing.assert_allclose(camera.unproject(camera.project_rays(rays)), rays, atol=1e-8)


@given(st.floats(0.0, 0.98), st.floats(-np.pi, np.pi))
def test_pinhole_project_and_unproject_undo_each_other(share: float, azimuth: float) -> None:
    camera = make_camera("pinhole")
    rays = rays_at(np.array([share * min(camera.max_angle_rad, np.deg2rad(45.0))]), np.array([azimuth]))
    np.testing.assert_allclose(camera.unproject(camera.project_rays(rays)), rays, atol=1e-6)


@pytest.mark.parametrize("model", ["fisheye", "pinhole"])
def test_every_pixel_that_has_a_ray_projects_back_onto_itself(model: CameraModel) -> None:
    camera = make_camera(model)
    v, u = np.mgrid[0:240:7, 0:320:7].astype(np.float64)
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    rays = camera.unproject(pixels)
    seen = np.isfinite(rays).all(axis=1)
    assert seen.mean() > 0.5
    np.testing.assert_allclose(np.linalg.norm(rays[seen], axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(camera.project_rays(rays[seen]), pixels[seen], atol=1e-6)


def test_fisheye_beyond_its_largest_angle_is_nan() -> None:
    # r = t - 0.1 t^3 stops growing at t = sqrt(1 / 0.3), where r = 2 / 3 * t.
    camera = make_camera("fisheye", np.array([-0.1, 0.0, 0.0, 0.0]))
    limit = np.sqrt(1.0 / 0.3)
    assert camera.max_angle_rad == pytest.approx(limit, abs=2e-3)
    rays = rays_at(np.array([limit - 0.01, limit + 0.01]), np.zeros(2))
    assert np.isfinite(camera.project_rays(rays)).tolist() == [[True, True], [False, False]]
    radius_px = 107.8 * limit * 2.0 / 3.0
    outside = camera.unproject(np.array([[159.5 + radius_px - 1.0, 119.5], [159.5 + radius_px + 1.0, 119.5]]))
    assert np.isfinite(outside).tolist() == [[True] * 3, [False] * 3]


def test_pinhole_does_not_see_backwards() -> None:
    camera = make_camera("pinhole", np.zeros(5))
    rays = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.2, 0.1, 1.0]])
    assert np.isfinite(camera.project_rays(rays))[:, 0].tolist() == [False, False, True]


def test_level_camera_meets_the_ground_where_similar_triangles_say() -> None:
    # No distortion, level, 20 cm high: v - cy = f * 20 / y and u - cx = f * x / y.
    camera = make_camera("pinhole", np.zeros(5), LEVEL)
    ground = np.array([[0.0, 40.0], [10.0, 40.0], [-15.0, 60.0]])
    x, y = ground.T
    expected = np.stack([159.5 + 107.8 * x / y, 119.5 + 106.3 * 20.0 / y], axis=1)
    np.testing.assert_allclose(camera.project_ground(ground), expected, atol=1e-9)
    np.testing.assert_allclose(camera.intersect_ground(expected), ground, atol=1e-9)


def test_mounting_signs() -> None:
    road = np.array([[0.0, 50.0]])

    def pixel(**changes: float) -> np.ndarray:
        return make_camera("pinhole", np.zeros(5), LEVEL).with_mounting(**changes).project_ground(road)[0]

    u, v = pixel()
    assert pixel(pitch_down_rad=0.1)[1] < v  # Looking further down lifts the road in the image.
    assert pixel(yaw_rad=0.1)[0] > u  # Looking left moves what is straight ahead to the right.
    assert pixel(right_of_centre_cm=5.0)[0] < u
    assert pixel(ahead_of_front_axle_cm=5.0)[1] > v  # Nearer is lower.
    assert pixel(height_cm=25.0)[1] > v
    # A camera whose right side hangs lower shows the road, below the axis, turned to the right in the image
    # (clockwise about the viewing direction the camera turns, counter-clockwise the picture).
    assert pixel(roll_rad=0.1)[0] > u


def test_pitch_moves_the_horizon_by_its_own_angle() -> None:
    camera = make_camera("fisheye", np.zeros(4), LEVEL).with_mounting(pitch_down_rad=0.3)
    horizon_v = 119.5 - 106.3 * 0.3
    below, above = camera.intersect_ground(np.array([[159.5, horizon_v + 0.5], [159.5, horizon_v - 0.5]]))
    assert below[1] > 1000.0
    assert np.isnan(above).all()


def test_camera_from_car_is_a_rotation() -> None:
    R = TILTED.camera_from_car
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
    # Level and straight: right, up and ahead of the car are right, minus down and the axis of the camera.
    np.testing.assert_allclose(LEVEL.camera_from_car, [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-12)


@given(st.floats(-40.0, 40.0), st.floats(8.0, 100.0))
def test_ground_and_image_undo_each_other(x_cm: float, y_cm: float) -> None:
    road = np.array([[x_cm, y_cm]])
    for camera in (make_camera("fisheye"), make_camera("pinhole", np.array([-0.05, 0.01, 0.0, 0.0]))):
        pixels = camera.project_ground(road)
        if np.isfinite(pixels).all():
            np.testing.assert_allclose(camera.intersect_ground(pixels), road, atol=1e-5)
    assert np.isfinite(make_camera("fisheye").project_ground(road)).all()


def test_a_wide_fisheye_sees_the_ground_behind_the_camera() -> None:
    camera = make_camera("fisheye", np.zeros(4)).with_mounting(pitch_down_rad=0.6, roll_rad=0.0, yaw_rad=0.0)
    behind = np.array([[0.7, -12.0]])
    ray = (np.array([0.7, -12.0, 0.0]) - camera.mounting.position_car_cm) @ camera.mounting.camera_from_car.T
    assert ray[2] > 0.0
    further = np.array([[0.7, -60.0]])
    ray = (np.array([0.7, -60.0, 0.0]) - camera.mounting.position_car_cm) @ camera.mounting.camera_from_car.T
    assert ray[2] < 0.0  # More than 90 degrees from the axis.
    for road in (behind, further):
        np.testing.assert_allclose(camera.intersect_ground(camera.project_ground(road)), road, atol=1e-6)


def test_missing_values_stay_missing() -> None:
    for camera in (make_camera("fisheye"), make_camera("pinhole")):
        assert np.isnan(camera.project_ground(np.array([[np.nan, 30.0]]))).all()
        assert np.isnan(camera.unproject(np.array([[np.nan, 30.0]]))).all()
        assert np.isnan(camera.intersect_ground(np.array([[np.nan, np.nan]]))).all()


@given(st.floats(0.2, 5.0))
def test_scaling_every_length_scales_the_road_and_leaves_the_image(factor: float) -> None:
    camera, road = make_camera("fisheye"), np.array([[5.0, 40.0], [-12.0, 70.0]])
    scaled = camera.scaled_lengths(factor)
    np.testing.assert_allclose(scaled.project_ground(road * factor), camera.project_ground(road), atol=1e-8)
    assert scaled.wheelbase_cm == pytest.approx(26.0 * factor)


def test_hash_names_what_decides_the_picture() -> None:
    camera = make_camera("fisheye")
    assert camera.hash == make_camera("fisheye").hash
    assert len(camera.hash) == 16
    # Nine digits survive; the wheelbase decides nothing about the image.
    assert camera.with_mounting(height_cm=20.0 * (1 + 1e-13)).hash == camera.hash
    changed = [
        camera.with_mounting(height_cm=20.1),
        camera.with_mounting(pitch_down_rad=0.45),
        camera.with_mounting(roll_rad=0.0),
        camera.with_mounting(yaw_rad=0.0),
        camera.with_mounting(ahead_of_front_axle_cm=-2.1),
        camera.with_mounting(right_of_centre_cm=0.8),
        make_camera("fisheye", FISHEYE_D * 1.01),
        make_camera("pinhole"),
    ]
    hashes = {camera.hash, *(other.hash for other in changed)}
    assert len(hashes) == 1 + len(changed)
