from __future__ import annotations

import math

import numpy as np
import pytest
from lane_frames import CAMERA, lane_frame

from lanenet.config import check_settings
from lanenet.errors import CalibrationError, ConfigError, DriveFormatError
from lanenet.geometry.lane import mirror_points
from lanenet.perception.estimate import Detector
from lanenet.perception.hough.detector import HoughSettings, HoughTracker
from lanenet.perception.hough.edges import HoughEdgeSettings, cut_roi, find_contours
from lanenet.perception.hough.lines import Segment, find_segments, split_sides

BOTTOM = HoughSettings.model_validate({"steering": {"distance_row": "bottom"}})


def left_line(b: float) -> Segment:
    """A left line y = -x + b."""
    return Segment(b - 60.0, 60.0, b - 20.0, 20.0)


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
    binary = find_contours(frame, HoughEdgeSettings()).binary
    columns = np.flatnonzero(binary.any(axis=0))
    assert columns.min() >= 77 and columns.max() <= 82 and binary[:, 79:81].all()
    level = np.zeros((120, 160, 3), np.uint8)
    level[:] = (200, 30, 30)
    level[90:] = (30, 220, 220)
    assert not find_contours(level, HoughEdgeSettings()).binary.any()


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
    tracker = HoughTracker(None, BOTTOM)
    before = tracker.track(Segment(20.0, 60.0, 60.0, 20.0), Segment(140.0, 60.0, 100.0, 20.0))
    # On the row of c1 the line moves from 70 to 60 px: 60 * -10 / 70, a tenth of it by eq. 15.
    after = tracker.track(Segment(30.0, 60.0, 70.0, 20.0), None)
    assert before == pytest.approx(0.0, abs=1e-9)
    assert after == pytest.approx(-60.0 / 7.0 * 0.1)
    # The averaged line has moved by a twentieth of the way (eq. 16).
    assert tracker.state.left is not None and tracker.state.left.line.b == pytest.approx(80.5)


def test_a_single_line_is_compared_with_the_frame_before_and_not_with_the_average() -> None:
    tracker = HoughTracker(None, BOTTOM)
    # On the row of c1 = (80, 70): the left line y = -x + b is at x = b - 70, 150 - b beside c1.
    assert tracker.track(left_line(80.0), Segment(140.0, 60.0, 100.0, 20.0)) == pytest.approx(0.0, abs=1e-9)
    # d from 70 to 63: eq. 13 gives -60 * 7 / 70 = -6; eq. 12: 0 - 6; eq. 15: 0.1 * -6 + 0.9 * 0 = -0.6.
    assert tracker.track(left_line(87.0), None) == pytest.approx(-0.6)
    # d stays 63, although the averaged line lies at b = 80.35: no change.
    assert tracker.track(left_line(87.0), None) == pytest.approx(-0.6)
    # d from 63 to 66.15: 60 * 3.15 / 63 = 3; -0.6 + 3 = 2.4; 0.1 * 2.4 + 0.9 * -0.6 = -0.3.
    assert tracker.track(left_line(83.85), None) == pytest.approx(-0.3)


def test_a_line_that_stays_does_not_wind_the_steering_up() -> None:
    tracker = HoughTracker(None, BOTTOM)
    tracker.track(left_line(80.0), Segment(140.0, 60.0, 100.0, 20.0))
    # d from 70 to 77: 60 * 7 / 70 = 6, a tenth of it; every further frame shows the same.
    for _ in range(50):
        angle = tracker.track(left_line(73.0), None)
    assert angle == pytest.approx(0.6)


def test_d_of_a_side_is_that_of_its_last_frame_even_if_frames_lie_between() -> None:
    tracker = HoughTracker(None, BOTTOM)
    right = Segment(140.0, 60.0, 100.0, 20.0)
    tracker.track(left_line(80.0), right)
    # The right line y = x - 80 stays at x = 150; the left one is away.
    for _ in range(3):
        assert tracker.track(None, right) == pytest.approx(0.0, abs=1e-9)
    # As in the test above, with the 70 of three frames ago.
    assert tracker.track(left_line(87.0), None) == pytest.approx(-0.6)


def test_a_line_far_from_the_last_is_another_one() -> None:
    right = Segment(140.0, 60.0, 100.0, 20.0)
    for limit, angle in ((10.0, 0.0), (None, -60.0 * 11.0 / 70.0 * 0.1)):
        steering = {"distance_row": "bottom", "max_jump_px": limit}
        tracker = HoughTracker(None, HoughSettings.model_validate({"steering": steering}))
        tracker.track(left_line(80.0), right)
        assert tracker.track(left_line(91.0), None) == pytest.approx(angle, abs=1e-9)


def test_each_side_is_forgotten_on_its_own() -> None:
    tracker = HoughTracker(None, HoughSettings.model_validate({"steering": {"hold_frames": 2}}))
    left, right = left_line(80.0), Segment(140.0, 60.0, 100.0, 20.0)
    tracker.track(left, right)
    for missed in (1, 2):
        tracker.track(None, right)
        assert tracker.state.left is not None and tracker.state.left.missed == missed
    tracker.track(None, right)
    assert tracker.state.left is None and tracker.state.right is not None
    assert tracker.state.right.missed == 0 and tracker.state.steering_deg is not None
    # A forgotten side starts anew: no average with the line of long ago.
    tracker.track(left_line(60.0), right)
    assert tracker.state.left is not None and tracker.state.left.line == left_line(60.0).line


def test_none_holds_for_ever_as_in_the_paper() -> None:
    tracker = HoughTracker(None, HoughSettings.model_validate({"steering": {"hold_frames": None}}))
    seen = tracker.track(left_line(70.0), Segment(140.0, 60.0, 100.0, 20.0))
    for _ in range(100):
        assert tracker.track(None, None) == seen
    assert tracker.state.left is not None and tracker.state.left.missed == 100


def test_the_hint_names_the_other_settings_where_the_hue_shows_nothing() -> None:
    tracker = HoughTracker()
    assert tracker.hint == ""
    for _ in range(20):
        tracker.detect(np.full((240, 320, 3), 90, np.uint8))
    assert "in 0 of 20 frames" in tracker.hint and "configs/detectors/hough_value.yaml" in tracker.hint
    tracker.reset()
    assert "in 0 of 20 frames" in tracker.hint
    # One of 21 is fewer than a twentieth, two of 22 are not.
    tracker.detect(lane_frame())
    assert "in 1 of 21 frames" in tracker.hint
    tracker.detect(lane_frame())
    assert tracker.hint == ""
    value = HoughTracker(None, HoughSettings.model_validate({"edges": {"channel": "value"}}))
    value.detect(np.full((240, 320, 3), 90, np.uint8))
    assert value.hint == ""


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
