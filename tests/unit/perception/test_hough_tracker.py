from __future__ import annotations

import math

import numpy as np
import pytest
from lane_frames import CAMERA, lane_frame

from lanenet.config import check_settings
from lanenet.errors import CalibrationError, ConfigError, DriveFormatError
from lanenet.geometry.lane import mirror_points
from lanenet.perception.estimate import Detector
from lanenet.perception.hough.edges import HoughEdgeSettings, cut_roi, find_contours
from lanenet.perception.hough.lines import Segment, find_segments, split_sides
from lanenet.perception.hough.tracker import HoughSettings, HoughTracker


def test_is_a_detector_with_the_papers_defaults() -> None:
    tracker = HoughTracker()
    assert isinstance(tracker, Detector)
    edges, lines, steering = tracker.settings.edges, tracker.settings.lines, tracker.settings.steering
    assert (edges.width_px, edges.height_px, edges.roi_height_px, edges.blur_px) == (160, 120, 70, 5)
    assert (edges.channel, edges.threshold) == ("hue", 100.0)
    assert (lines.min_angle_deg, lines.max_angle_deg, lines.lowest_share) == (10.0, 80.0, 0.4)
    assert (lines.line_weight, lines.centre_weight) == (0.7, 0.3)
    assert (steering.vanishing_weight, steering.distance_weight, steering.gain_deg) == (0.8, 0.2, 60.0)
    assert (steering.angle_smoothing, steering.line_smoothing) == (0.1, 0.05)


def test_region_of_interest_is_the_near_field() -> None:
    frame = np.zeros((240, 320, 3), np.uint8)
    frame[100:] = 200
    roi = cut_roi(frame, HoughEdgeSettings())
    assert roi.shape == (70, 160, 3) and (roi == 200).all()


def test_contours_are_vertical_edges_of_the_hue() -> None:
    frame = np.zeros((120, 160, 3), np.uint8)
    frame[:] = (200, 30, 30)
    frame[:, 80:] = (30, 220, 220)
    binary = find_contours(frame, HoughEdgeSettings())
    columns = np.flatnonzero(binary.any(axis=0))
    assert columns.min() >= 77 and columns.max() <= 82 and binary[:, 79:81].all()
    level = np.zeros((120, 160, 3), np.uint8)
    level[:] = (200, 30, 30)
    level[90:] = (30, 220, 220)
    assert not find_contours(level, HoughEdgeSettings()).any()


def test_segments_and_sides() -> None:
    binary = np.zeros((70, 160), np.uint8)
    for k in range(40):
        binary[60 - k, 20 + k] = binary[60 - k, 140 - k] = 1
    settings = HoughSettings().lines
    left, right = split_sides(find_segments(binary, settings), 160.0, 70.0, settings)
    assert left and right
    assert all(s.y1 >= s.y2 and s.x1 <= 30 for s in left) and all(s.x1 >= 130 for s in right)
    # A left line's slope on the right side of the image is no lane line.
    assert split_sides([Segment(100.0, 60.0, 130.0, 30.0)], 160.0, 70.0, settings) == ([], [])


@pytest.mark.parametrize(("centre", "slope"), [(0.0, 0.0), (4.0, 0.1), (-5.0, -0.1)])
def test_lines_lie_at_an_edge_of_the_markings(centre: float, slope: float) -> None:
    estimate = HoughTracker(CAMERA).detect(lane_frame(centre, slope))
    assert estimate.confidence == 1.0 and estimate.mask.all()
    for side, x in ((-20.0, estimate.points_cm[:3]), (20.0, estimate.points_cm[3:])):
        truth = side + centre + slope * np.array([0.0, 15.0, 30.0])
        # Half a marking, and a pixel of the scaled frame.
        assert np.abs(x - truth).max() < 4.0


def test_steering_is_positive_left_and_mirrors() -> None:
    left, right = (HoughTracker(CAMERA).detect(lane_frame(c, c / 40.0)) for c in (-6.0, 6.0))
    assert left.steering_rad > 0.05 and right.steering_rad < -0.05
    assert left.steering_rad == pytest.approx(-right.steering_rad, abs=0.1)
    assert np.abs(left.points_cm - mirror_points(right.points_cm)).max() < 4.0


def test_without_a_camera_steering_and_image_lines_are_there() -> None:
    tracker = HoughTracker()
    estimate = tracker.detect(lane_frame())
    assert not estimate.mask.any() and estimate.confidence == 1.0
    assert abs(estimate.steering_rad) < 0.05
    assert tracker.last.left_px is not None and tracker.last.right_px is not None
    markings = CAMERA.project_ground(np.array([[-20.0, 40.0], [20.0, 40.0]]))
    for line, marking in zip((tracker.last.left_px, tracker.last.right_px), markings, strict=True):
        assert np.interp(-marking[1], -line[:, 1], line[:, 0]) == pytest.approx(marking[0], abs=8.0)


def test_angle_is_smoothed_over_frames() -> None:
    tracker = HoughTracker()
    straight = tracker.detect(lane_frame()).steering_rad
    shifted = lane_frame(6.0, 0.15)
    target = HoughTracker().detect(shifted).steering_rad
    # One frame of eq. 15 is a tenth of the way.
    assert tracker.detect(shifted).steering_rad == pytest.approx(0.9 * straight + 0.1 * target, abs=0.01)
    tracker.reset()
    assert tracker.detect(shifted).steering_rad == pytest.approx(target)


def test_one_line_steers_only_after_a_pair() -> None:
    one = lane_frame(sides=(-20.0,))
    tracker = HoughTracker(CAMERA)
    first = tracker.detect(one)
    assert first.confidence == 0.5 and math.isnan(first.steering_rad)
    assert first.mask.tolist() == [True] * 3 + [False] * 3
    tracker.detect(lane_frame())
    assert math.isfinite(tracker.detect(one).steering_rad)


def test_a_left_line_that_comes_closer_steers_right() -> None:
    settings = HoughSettings.model_validate({"steering": {"distance_row": "bottom"}})
    tracker = HoughTracker(None, settings)
    before = tracker.track(Segment(20.0, 60.0, 60.0, 20.0), Segment(140.0, 60.0, 100.0, 20.0))
    # On the row of c1 the line moves from 70 to 60 px: 60 * -10 / 70, a tenth of it by eq. 15.
    after = tracker.track(Segment(30.0, 60.0, 70.0, 20.0), None)
    assert before == pytest.approx(0.0, abs=1e-9)
    assert after == pytest.approx(-60.0 / 7.0 * 0.1)
    # The averaged line has moved by a twentieth of the way (eq. 16).
    assert tracker.state.left is not None and tracker.state.left.b == pytest.approx(80.0 + 0.05 * 10.0)


def test_steering_is_held_without_lines_and_then_forgotten() -> None:
    settings = HoughSettings.model_validate({"steering": {"hold_frames": 2}})
    tracker = HoughTracker(CAMERA, settings)
    seen = tracker.detect(lane_frame(4.0)).steering_rad
    black = np.zeros((240, 320, 3), np.uint8)
    for _ in range(2):
        held = tracker.detect(black)
        assert held.steering_rad == seen and held.confidence == 0.0 and not held.mask.any()
    assert math.isnan(tracker.detect(black).steering_rad)


def test_current_angle_is_bounded() -> None:
    tracker = HoughTracker()
    tracker.track(Segment(20.0, 60.0, 79.0, 1.0), Segment(140.0, 60.0, 81.0, 1.0))
    # At the top the line goes from 0 to 70 px beside the centre: the relative change knows no bound.
    for _ in range(400):
        angle = tracker.track(Segment(5.0, 60.0, 10.0, 50.0), None)
    assert angle is not None and abs(angle) <= 60.0


def test_wrong_input_is_named() -> None:
    with pytest.raises(CalibrationError, match="160x120"):
        HoughTracker(CAMERA).detect(np.zeros((120, 160, 3), np.uint8))
    with pytest.raises(DriveFormatError, match="3 channels"):
        HoughTracker().detect(np.zeros((120, 160, 4), np.uint8))
    with pytest.raises(ConfigError, match="height_px"):
        check_settings(HoughSettings, {"edges": {"roi_top_px": 60}}, "test")
