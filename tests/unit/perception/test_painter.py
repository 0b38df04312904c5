from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lane_frames import CAMERA, lane_frame

from lanenet.config import check_settings
from lanenet.errors import CalibrationError, ConfigError, DriveFormatError
from lanenet.perception.draw import draw_estimate
from lanenet.perception.estimate import Detector
from lanenet.perception.painter.curves import CurveSettings, curvature_radius, fit_curve, slide_windows
from lanenet.perception.painter.edges import (
    PainterEdgeSettings,
    find_painter_edges,
    find_trapezoid,
    value_channel,
)
from lanenet.perception.painter.lines import PainterLineSettings, SolidLine, find_two_lines, join_side
from lanenet.perception.painter.painter import LanePainter, PainterSettings
from lanenet.perception.painter.plane import SquarePlane

TRAPEZOID = np.array([[120.0, 100.0], [200.0, 100.0], [320.0, 200.0], [0.0, 200.0]])
LINES = PainterLineSettings()
#: The yellow of the frames is bright in V, its floor is not.
ROWS = np.array([0.0, 15.0, 30.0])


def test_is_a_detector_with_the_papers_thresholds() -> None:
    painter = LanePainter()
    assert isinstance(painter, Detector)
    assert (painter.settings.edges.low, painter.settings.edges.high) == (70.0, 100.0)


def test_contrast_then_value() -> None:
    frame = np.array([[[10, 100, 50], [250, 0, 0]]], np.uint8)
    assert value_channel(frame, PainterEdgeSettings(contrast=1.5)).tolist() == [[150, 255]]


def test_edges_stay_in_the_trapezoid_and_its_border_is_none() -> None:
    frame = np.full((240, 320, 3), 60, np.uint8)
    assert not find_painter_edges(frame, TRAPEZOID, PainterEdgeSettings()).any()
    frame[:, 150:170] = 220
    v, u = np.nonzero(find_painter_edges(frame, TRAPEZOID, PainterEdgeSettings()))
    assert v.min() >= 100 and v.max() <= 200 and set(u) <= {148, 149, 150, 169, 170, 171}


def test_trapezoid_given_by_proportions_and_by_the_camera() -> None:
    given_corners = ((0.25, 0.5), (0.75, 0.5), (1.0, 1.0), (0.0, 1.0))
    settings = PainterEdgeSettings(trapezoid=given_corners)
    assert find_trapezoid(101, 51, CAMERA, settings).tolist() == [[25, 25], [75, 25], [100, 50], [0, 50]]
    automatic = find_trapezoid(320, 240, CAMERA, PainterEdgeSettings())
    # Six heights of 20 cm ahead.
    assert automatic[0, 1] == pytest.approx(CAMERA.project_ground(np.array([[0.0, 120.0]]))[0, 1])
    assert find_trapezoid(1000, 500, None, PainterEdgeSettings())[0] == pytest.approx([419.58, 309.38])


@pytest.mark.parametrize(
    "trapezoid",
    [
        [[0.2, 0.5]] * 4,
        [[0.2, 0.5], [0.8, 0.5], [1.0, 0.9]],
        [[0.2, 0.5], [0.8, 0.5], [1.5, 0.9], [0.0, 0.9]],
    ],
)
def test_what_is_no_trapezoid_is_refused(trapezoid: list[list[float]]) -> None:
    with pytest.raises(ConfigError, match="clockwise"):
        check_settings(PainterSettings, {"edges": {"trapezoid": trapezoid}}, "test")


def test_dashes_join_to_one_line_and_a_stray_segment_does_not_pull() -> None:
    # Two dashes of x = 100 - (y - 200) and, far beside, a short kerb.
    dashes = np.array(
        [[100.0, 200.0, 120.0, 180.0], [150.0, 150.0, 180.0, 120.0], [20.0, 190.0, 30.0, 180.0]]
    )
    line = join_side(dashes, (200.0, 100.0), 320.0, None, LINES)
    assert line is not None and (line.bottom_px, line.top_px) == pytest.approx((100.0, 200.0))
    assert join_side(dashes[2:], (200.0, 100.0), 320.0, None, LINES) is None


def test_sides_by_slope_and_lines_that_cross_are_no_lane() -> None:
    left, right = [60.0, 200.0, 130.0, 110.0], [260.0, 200.0, 190.0, 110.0]
    level = [0.0, 150.0, 320.0, 150.0]
    found = find_two_lines(np.array([right, level, left]), TRAPEZOID, (None, None), LINES)
    assert found[0] is not None and found[0].bottom_px == pytest.approx(60.0)
    assert found[1] is not None and found[1].bottom_px == pytest.approx(260.0)
    crossing = np.array([[60.0, 200.0, 210.0, 110.0], [260.0, 200.0, 120.0, 110.0]])
    assert find_two_lines(crossing, TRAPEZOID, (None, None), LINES) == (None, None)
    known = (SolidLine(60.0, 226.7), None)
    stays = find_two_lines(crossing, TRAPEZOID, known, LINES)
    assert stays[0] is not None and stays[1] is None


def test_the_plane_is_the_trapezoid_stretched_to_a_square() -> None:
    plane = SquarePlane(TRAPEZOID)
    corners = plane.from_image(TRAPEZOID)
    assert corners == pytest.approx(np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]]), abs=1e-6)
    assert plane.to_image(corners) == pytest.approx(TRAPEZOID, abs=1e-4)


@given(st.floats(-0.004, 0.004), st.floats(-0.3, 0.3), st.floats(-30.0, 30.0))
def test_windows_follow_a_curve_and_the_fit_returns_it(a: float, b: float, c: float) -> None:
    y = np.linspace(10.0, 100.0, 200)
    line = np.stack([a * y * y + b * y + c, y], axis=1)
    # The guess is the tangent at the near end; the other line lies 40 cm beside.
    tangent = np.stack([line[0, 0] + (2.0 * a * 10.0 + b) * (y - 10.0), y], axis=1)
    settings = CurveSettings(windows=15)
    chosen = slide_windows(np.concatenate([line, line + [40.0, 0.0]]), tangent, 10.0, settings)
    curve = fit_curve(chosen, 90.0, settings)
    assert curve is not None
    assert (curve.a, curve.b, curve.c) == pytest.approx((a, b, c), abs=1e-6)
    assert (
        np.abs(
            curve.sample()
            - np.stack([np.interp(curve.sample()[:, 1], y, line[:, 0]), curve.sample()[:, 1]], axis=1)
        ).max()
        < 0.01
    )


def test_too_few_points_are_no_curve() -> None:
    y = np.linspace(0.0, 40.0, 60)
    points = np.stack([0.0 * y, y], axis=1)
    assert fit_curve(points, 100.0, CurveSettings()) is None
    assert fit_curve(points[:5], 40.0, CurveSettings()) is None
    assert len(slide_windows(np.empty((0, 2)), points, 5.0, CurveSettings())) == 0


def test_radius_of_a_circle() -> None:
    # x = R - sqrt(R^2 - y^2) near its vertex.
    y = np.linspace(-8.0, 8.0, 50)
    curve = fit_curve(np.stack([150.0 - np.sqrt(150.0**2 - y * y), y], axis=1), 16.0, CurveSettings())
    assert curve is not None and curvature_radius(curve, 0.0) == pytest.approx(150.0, rel=0.003)
    straight = fit_curve(np.stack([0.0 * y, y], axis=1), 16.0, CurveSettings())
    assert straight is not None and curvature_radius(straight, 0.0) > 1e6


@pytest.mark.parametrize(
    ("centre", "slope", "bend"), [(0.0, 0.0, 0.0), (4.0, 0.05, 0.0), (-3.0, 0.0, 0.0015)]
)
def test_lane_on_the_road(centre: float, slope: float, bend: float) -> None:
    painter = LanePainter(CAMERA)
    estimate = painter.detect(lane_frame(centre, slope, bend))
    assert estimate.confidence == 1.0 and estimate.mask.all()
    middle = centre + slope * ROWS + bend * ROWS * ROWS
    # Both edges of a marking are in the window, so its middle is what is found.
    assert np.abs(estimate.points_cm.reshape(2, 3)[:, 1:] - (middle + [[-20.0], [20.0]])[:, 1:]).max() < 1.5
    assert np.abs(estimate.points_cm.reshape(2, 3)[:, 0] - (middle[0] + np.array([-20.0, 20.0]))).max() < 3.0
    assert estimate.steering_rad == pytest.approx(math.atan2(-middle[1], 15.0), abs=0.08)
    assert painter.lane.offset_m == pytest.approx(-0.01 * centre, abs=0.03)
    if bend:
        assert painter.lane.radius_m == pytest.approx(0.01 / (2.0 * bend), rel=0.3)
    else:
        assert painter.lane.radius_m > 8.0


def test_without_a_camera_the_image_lines_lie_on_the_markings() -> None:
    painter = LanePainter(
        None,
        PainterSettings(
            edges=PainterEdgeSettings(trapezoid=((0.2, 0.4), (0.8, 0.4), (1.0, 0.95), (0.0, 0.95)))
        ),
    )
    estimate = painter.detect(lane_frame(0.0))
    assert estimate.confidence == 1.0 and not estimate.mask.any()
    assert abs(estimate.steering_rad) < 0.05 and math.isnan(painter.lane.radius_m)
    for side, line in ((-20.0, painter.last.left_px), (20.0, painter.last.right_px)):
        assert line is not None
        for y in (30.0, 60.0):
            u, v = CAMERA.project_ground(np.array([[side, y]]))[0]
            assert np.interp(-v, -line[:, 1], line[:, 0]) == pytest.approx(u, abs=3.0)
    assert painter.detect(lane_frame(8.0, 0.2)).steering_rad < -0.1


def test_video_remembers_and_photo_does_not() -> None:
    black = np.zeros((240, 320, 3), np.uint8)
    video, photo = LanePainter(CAMERA), LanePainter(CAMERA, PainterSettings(mode="photo"))
    for painter in (video, photo):
        painter.detect(lane_frame())
        empty = painter.detect(black)
        assert not empty.mask.any() and empty.confidence == 0.0 and math.isnan(empty.steering_rad)
    # What is remembered is drawn, not answered.
    assert video.last.left_px is not None and photo.last.left_px is None
    for _ in range(5):
        video.detect(black)
    assert video.last.left_px is None


def test_filled_lane_is_drawn() -> None:
    painter = LanePainter(CAMERA)
    frame = lane_frame()
    picture = draw_estimate(frame, painter.detect(frame), None, image_lane=painter.last)
    u, v = np.rint(CAMERA.project_ground(np.array([[3.0, 45.0], [40.0, 45.0]]))).astype(int).T
    changed = (picture != frame).any(axis=2)
    assert changed[v[0], u[0]] and not changed[v[1], u[1]]
    assert "of the middle" in painter.last.text


def test_wrong_input_is_named() -> None:
    with pytest.raises(CalibrationError, match="160x120"):
        LanePainter(CAMERA).detect(np.zeros((120, 160, 3), np.uint8))
    with pytest.raises(DriveFormatError, match="3 channels"):
        LanePainter().detect(np.zeros((120, 160, 2), np.uint8))
    with pytest.raises(ConfigError, match="odd"):
        check_settings(PainterSettings, {"edges": {"blur_px": 4}}, "test")
    with pytest.raises(ConfigError, match="below low"):
        check_settings(PainterSettings, {"edges": {"high": 40.0}}, "test")
