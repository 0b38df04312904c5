from __future__ import annotations

import numpy as np
import pytest

from lanenet.geometry.camera import Camera, Mounting
from lanenet.geometry.lane import ROWS_CM
from lanenet.perception.draw import ARROW_BGR, LEFT_BGR, RIGHT_BGR, draw_estimate, outlined_text
from lanenet.perception.estimate import LaneEstimate
from lanenet.perception.image_lane import ImageLane

NAN = float("nan")
K = np.array([[120.0, 0.0, 79.5], [0.0, 120.0, 59.5], [0.0, 0.0, 1.0]])
CAMERA = Camera("pinhole", 160, 120, K, np.zeros(5), Mounting(18.0, np.deg2rad(35.0)), 26.0)
POINTS = np.array([-14.0, -12.0, -9.0, 6.0, 8.0, 11.0])


def has_colour(picture: np.ndarray, colour: tuple[int, int, int]) -> np.ndarray:
    return (np.abs(picture.astype(int) - colour) <= 40).all(axis=2)


@pytest.mark.parametrize("scale", [1, 4])
def test_lines_and_points_lie_where_the_camera_sees_them(scale: int) -> None:
    estimate = LaneEstimate(POINTS)
    picture = draw_estimate(np.zeros((120, 160, 3), np.uint8), estimate, CAMERA, scale)
    assert picture.shape == (120 * scale, 160 * scale, 3)
    for side, colour in enumerate((LEFT_BGR, RIGHT_BGR)):
        # Smoothing spreads a thin line over two pixels.
        drawn = picture.astype(int) @ colour > 0.4 * np.dot(colour, colour)
        for y in (*ROWS_CM[1:], 22.0, 38.0):
            x = float(np.polyval(estimate.parabolas.T, y)[side])
            u, v = (CAMERA.project_ground(np.array([[x, y]]))[0] + 0.5) * scale - 0.5
            assert drawn[round(v) - 1 : round(v) + 2, round(u) - 1 : round(u) + 2].any(), (side, y)


def test_frame_stays_as_it_was_and_gray_is_accepted() -> None:
    frame = np.full((120, 160), 90, np.uint8)
    picture = draw_estimate(frame, LaneEstimate(POINTS, steering_rad=0.1), CAMERA, caption="7")
    assert (frame == 90).all()
    assert picture.shape == (120, 160, 3) and (picture != 90).any()


def test_unknown_lane_draws_nothing() -> None:
    frame = np.random.default_rng(0).integers(0, 255, (120, 160, 3), dtype=np.uint8)
    assert (draw_estimate(frame, LaneEstimate(), CAMERA) == frame).all()
    half = LaneEstimate(np.array([NAN, NAN, NAN, *POINTS[3:]]))
    picture = draw_estimate(np.zeros_like(frame), half, CAMERA)
    assert has_colour(picture, RIGHT_BGR).any() and not has_colour(picture, LEFT_BGR).any()


def test_points_far_outside_do_not_upset_it() -> None:
    wild = LaneEstimate(np.array([-1e6, -1e7, -1e8, 1e6, 1e7, 1e8]))
    assert draw_estimate(np.zeros((120, 160, 3), np.uint8), wild, CAMERA).shape == (120, 160, 3)


@pytest.mark.parametrize("far", [1e4, 1e7, 1e12])
def test_long_image_lines_are_cut_where_the_picture_ends(far: float) -> None:
    # Both run level through the picture, at rows 40 and 80, from far to the left to far to the right.
    lane = ImageLane(
        np.array([[-far, 40.0], [far, 40.0]]), np.array([[-far, 80.0], [far, 80.0]]), filled=True
    )
    frame = np.zeros((120, 160, 3), np.uint8)
    picture = draw_estimate(frame, LaneEstimate(), None, image_lane=lane)
    assert has_colour(picture, LEFT_BGR)[40].all() and has_colour(picture, RIGHT_BGR)[80].all()
    inside = picture[60].astype(int)
    assert (inside == inside[0]).all() and inside.any() and not picture[[10, 110]].any()


def test_slanted_lines_keep_their_place_when_cut() -> None:
    def drawn(scale: float) -> np.ndarray:
        # Through (80, 60) with slope 1/2.
        ends = np.array([[80.0, 60.0]]) + scale * np.array([[-2.0, -1.0], [2.0, 1.0]])
        lane = ImageLane(ends, None, memory_px=(ends * [1.0, -1.0] + [0.0, 120.0],))
        return draw_estimate(np.zeros((120, 160, 3), np.uint8), LaneEstimate(), None, image_lane=lane)

    near, far = drawn(45.0), drawn(1e9)
    assert has_colour(near, LEFT_BGR).sum() > 150
    assert (has_colour(near, LEFT_BGR) != has_colour(far, LEFT_BGR)).mean() < 0.005


def test_lines_outside_or_unknown_draw_nothing() -> None:
    outside = np.array([[-1e9, -500.0], [1e9, -500.0]])
    unknown = np.array([[10.0, 10.0], [NAN, 20.0]])
    frame = np.zeros((120, 160, 3), np.uint8)
    lane = ImageLane(outside, unknown, filled=True)
    assert not draw_estimate(frame, LaneEstimate(), None, image_lane=lane).any()


def test_positive_steering_points_left() -> None:
    for steering, leftwards in ((0.4, True), (-0.4, False)):
        picture = draw_estimate(
            np.zeros((120, 160, 3), np.uint8), LaneEstimate(steering_rad=steering), CAMERA
        )
        columns = np.nonzero(has_colour(picture, ARROW_BGR))[1]
        assert (columns.mean() < 80.0) == leftwards


@pytest.mark.parametrize("ground", [0, 255])
def test_a_text_has_a_rim_that_sets_it_off_any_ground(ground):
    image = np.full((40, 200, 3), ground, np.uint8)
    outlined_text(image, "24.0 cm", (4, 24), 0.55, (255, 255, 255), (0, 0, 0))
    gray = image[..., 0]
    letters, rim = gray > 200, gray < 60
    assert letters.sum() > 50 and rim.sum() > 50
    if ground == 255:
        # Letters as bright as the ground are told by a rim on both sides.
        row = rim[18]
        assert np.count_nonzero(np.diff(row.astype(int)) == 1) >= 10
