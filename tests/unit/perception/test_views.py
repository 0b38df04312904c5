from __future__ import annotations

import cv2
import numpy as np
import pytest

from lanenet.errors import CalibrationError
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.camera import Camera, Mounting
from lanenet.onboard.bench import example_camera
from lanenet.perception.edges.views import birdseye_view, undistorting_view

WINDOW = BirdseyeWindow(left_cm=-40.0, near_cm=12.0, cell_cm=0.5, rows=100, columns=160)


def painted(camera: Camera, inside) -> np.ndarray:
    """A frame that is white where ``inside(x_cm, y_cm)`` of the road is true."""
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    road = camera.intersect_ground(np.stack([u.ravel(), v.ravel()], axis=1))
    with np.errstate(invalid="ignore"):
        white = inside(road[:, 0], road[:, 1]).reshape(camera.height, camera.width)
    return np.repeat(np.where(white, 255, 0).astype(np.uint8)[..., None], 3, axis=2)


def test_birdseye_shows_a_square_where_it_lies():
    camera = example_camera()
    frame = painted(camera, lambda x, y: (np.abs(x - 5.0) < 8.0) & (np.abs(y - 35.0) < 8.0))
    picture = birdseye_view(camera, WINDOW).of(frame)
    assert picture.shape == (100, 160, 3)
    rows, columns = np.nonzero(picture[..., 0] > 127)
    centre_cm = WINDOW.points(np.array([[rows.mean(), columns.mean()]]))[0]
    assert centre_cm == pytest.approx((5.0, 35.0), abs=0.6)
    assert rows.size * WINDOW.cell_cm**2 == pytest.approx(16.0**2, rel=0.08)


def test_left_of_the_road_is_left_in_the_picture():
    camera = example_camera()
    picture = birdseye_view(camera, WINDOW).of(painted(camera, lambda x, y: x < 0.0))
    assert picture[60, 20, 0] == 255 and picture[60, 140, 0] == 0


def test_undistorting_makes_a_line_straight():
    camera = example_camera()
    # The edge of the half plane y > 30 cm is a straight line across the road, bent by the fisheye.
    frame = painted(camera, lambda x, y: (y > 30.0) & (y < 1e5))

    def bend_px(image: np.ndarray) -> float:
        columns = np.arange(40, camera.width - 40)
        first = np.array([np.flatnonzero(image[::-1, c, 0] > 127)[0] for c in columns], float)
        line = np.polyval(np.polyfit(columns, first, 1), columns)
        return float(np.abs(first - line).max())

    straight = undistorting_view(camera).of(frame)
    assert straight.shape == frame.shape
    assert bend_px(frame) > 4.0 and bend_px(straight) < 1.0


def pinhole() -> Camera:
    K = np.array([[150.0, 0.0, 79.5], [0.0, 150.0, 59.5], [0.0, 0.0, 1.0]])
    return Camera("pinhole", 160, 120, K, np.zeros(5), Mounting(15.0, 0.3), 20.0)


def test_pinhole_without_distortion_stays_as_it_is():
    camera = pinhole()
    image = cv2.GaussianBlur(
        np.random.default_rng(0).integers(0, 255, (120, 160, 3), dtype=np.uint8), (0, 0), 4
    )
    view = undistorting_view(camera).of(image)
    assert np.abs(view.astype(int) - image.astype(int))[2:-2, 2:-2].max() <= 6


def test_order_of_colours_and_gray_are_kept():
    camera = example_camera()
    view = birdseye_view(camera, WINDOW)
    frame = np.zeros((camera.height, camera.width, 3), np.uint8)
    frame[..., 2] = 90
    assert view.of(frame)[80, 80].tolist() == [0, 0, 90]
    assert view.of(frame[..., 2].copy()).shape == (100, 160)


def test_what_the_camera_does_not_see_is_black():
    backwards = pinhole().with_mounting(yaw_rad=np.pi)
    assert not birdseye_view(backwards, WINDOW).of(np.full((120, 160, 3), 255, np.uint8)).any()


def test_image_of_another_size_is_refused():
    with pytest.raises(CalibrationError, match="160x120 px, expected 320x240"):
        undistorting_view(example_camera()).of(np.zeros((120, 160, 3), np.uint8))
