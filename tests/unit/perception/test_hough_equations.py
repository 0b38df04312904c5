"""Equations 1 to 16 of Suto 2021 with numbers worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lanenet.perception.hough import detector, lines
from lanenet.perception.hough.detector import HoughSteeringSettings
from lanenet.perception.hough.edges import binarise
from lanenet.perception.hough.lines import HoughLineSettings, Line, Segment

LINES, STEERING = HoughLineSettings(), HoughSteeringSettings()
C1, C2 = (80.0, 70.0), (80.0, 0.0)


def test_eq_1_threshold_keeps_what_reaches_it() -> None:
    assert binarise(np.array([[0, 99, 100, 101, -99, -100]]), 100.0).tolist() == [[0, 0, 1, 1, 0, 1]]


def test_eq_2_slope_of_a_rising_line_is_negative() -> None:
    # From (20, 60) up to (60, 20): 40 to the right, 40 up.
    assert lines.slope_of(Segment(20.0, 60.0, 60.0, 20.0)) == -1.0
    assert lines.slope_of(Segment(140.0, 50.0, 100.0, 30.0)) == 0.5
    assert math.isinf(lines.slope_of(Segment(5.0, 9.0, 5.0, 1.0)))


def test_eq_3_intercept() -> None:
    assert Segment(20.0, 60.0, 60.0, 20.0).line == Line(-1.0, 80.0)
    assert Segment(140.0, 50.0, 100.0, 30.0).line == Line(0.5, -20.0)


@pytest.mark.parametrize(("m", "degrees"), [(1.0, 45.0), (-1.0, 45.0), (0.0, 0.0), (math.sqrt(3.0), 60.0)])
def test_eq_4_angle(m: float, degrees: float) -> None:
    assert lines.angle_deg(m) == pytest.approx(degrees)


def test_eq_4_gates() -> None:
    def passes(segment: Segment) -> bool:
        return lines.is_lane_like(segment, 70.0, LINES)

    assert passes(Segment(20.0, 60.0, 60.0, 20.0))
    # 9 and 81 degrees are outside 10 to 80.
    assert not passes(Segment(100.0, 60.0, 0.0, 60.0 - 100.0 * math.tan(math.radians(9.0))))
    assert not passes(Segment(50.0, 60.0, 50.0 - 50.0 / math.tan(math.radians(81.0)), 10.0))
    assert not passes(Segment(5.0, 60.0, 5.0, 10.0))
    # The lower end must reach 0.4 * 70 = 28.
    assert passes(Segment(20.0, 28.0, 30.0, 18.0)) and not passes(Segment(20.0, 27.9, 30.0, 17.9))


def test_eq_5_cost_of_a_pair() -> None:
    # 0.7 * (10 + 20) + 0.3 * 40
    assert lines.weighted_cost(10.0 + 20.0, 40.0, LINES) == pytest.approx(33.0)


def test_eq_5_without_memory_the_most_central_pair_wins() -> None:
    inner, outer = Segment(40.0, 60.0, 70.0, 30.0), Segment(10.0, 60.0, 40.0, 30.0)
    right = Segment(120.0, 60.0, 90.0, 30.0)
    # The middles of the lower ends lie at x = 80 and x = 65; c1 is at x = 80.
    found = lines.choose_pair([outer, inner], [right], (None, None), 160.0, 70.0, LINES)
    assert found == (inner, right)
    # The memory of the outer line weighs more: 0.7 * 60 against 0.3 * (18.0 - 10.0).
    found = lines.choose_pair([outer, inner], [right], (outer.line, None), 160.0, 70.0, LINES)
    assert found == (outer, right)


def test_eq_6_x_on_a_row() -> None:
    assert lines.x_at(Line(-1.0, 80.0), 0.0) == 80.0
    assert lines.x_at(Line(-1.0, 80.0), 70.0) == 10.0
    assert lines.x_at(Line(0.5, -20.0), 10.0) == 60.0
    # Distance to the same line shifted by 5 px: 5 at the top and 5 at the bottom.
    assert lines.line_distance(Line(-1.0, 80.0), Line(-1.0, 85.0), 70.0) == pytest.approx(10.0)
    assert lines.line_distance(Line(-1.0, 80.0), None, 70.0) == 0.0


def test_eq_7_single_line() -> None:
    # 0.7 * 10 + 0.3 * 50
    assert lines.weighted_cost(10.0, 50.0, LINES) == pytest.approx(22.0)
    near, far = Segment(50.0, 60.0, 70.0, 40.0), Segment(10.0, 60.0, 30.0, 40.0)

    def choose(earlier: Line | None) -> lines.Chosen:
        return lines.choose_lines([far, near], [], (earlier, None), 160.0, 70.0, LINES)

    assert choose(None) == (near, None)
    assert choose(far.line) == (far, None)


def test_lines_that_cross_within_the_region_are_no_pair() -> None:
    # y = -x + 150 and y = x - 10 meet at (80, 70): both lean outwards.
    left, right = Segment(80.0, 70.0, 120.0, 30.0), Segment(80.0, 70.0, 40.0, 30.0)
    assert lines.vanishing_point(left.line, right.line) == (80.0, 70.0)

    def choose(earlier: lines.Earlier, settings: HoughLineSettings = LINES) -> lines.Chosen:
        return lines.choose_lines([left], [right], earlier, 160.0, 70.0, settings)

    # Both cost the same; one that earlier frames showed comes first.
    assert choose((None, None)) == (left, None)
    assert choose((None, right.line)) == (None, right)
    assert choose((left.line, None)) == (left, None)
    # The paper knows no such limit.
    assert choose((None, None), HoughLineSettings(max_vanishing_share=None)) == (left, right)


def test_the_limit_of_the_vanishing_point() -> None:
    # y = -x + 100 and y = x - 60 meet at (80, 20): 20 / 70 of the height.
    left, right = Segment(40.0, 60.0, 70.0, 30.0), Segment(120.0, 60.0, 90.0, 30.0)
    for share, found in ((0.28, None), (0.29, (left, right))):
        settings = HoughLineSettings(max_vanishing_share=share)
        assert lines.choose_pair([left], [right], (None, None), 160.0, 70.0, settings) == found


def test_eq_8_weights() -> None:
    assert detector.combine_angles(10.0, -5.0, STEERING) == pytest.approx(7.0)


def test_eq_9_vanishing_point() -> None:
    # y = -x + 80 and y = x - 60 meet at x = 140 / 2.
    assert lines.vanishing_point(Line(-1.0, 80.0), Line(1.0, -60.0)) == (70.0, 10.0)


@pytest.mark.parametrize(
    ("vp", "degrees"),
    [((80.0, 10.0), 0.0), ((150.0, 0.0), -45.0), ((10.0, 0.0), 45.0), ((80.0 - 70.0, 70.0), 90.0)],
)
def test_eq_10_angle_of_the_vanishing_point(vp: tuple[float, float], degrees: float) -> None:
    assert detector.vanishing_angle_deg(vp, C1, C2) == pytest.approx(degrees, abs=1e-5)
    assert detector.vanishing_angle_deg(C1, C1, C2) == 0.0


@pytest.mark.parametrize(
    ("dnx", "dpx", "degrees"), [(20.0, 60.0, -30.0), (60.0, 20.0, 30.0), (9.0, 9.0, 0.0)]
)
def test_eq_11_angle_of_the_distances(dnx: float, dpx: float, degrees: float) -> None:
    # 60 * 40 / 80
    assert detector.distance_angle_deg(dnx, dpx, 60.0) == pytest.approx(degrees)
    assert detector.distance_angle_deg(0.0, 0.0, 60.0) == 0.0


@pytest.mark.parametrize(
    ("now", "before", "change"), [(50.0, 40.0, 15.0), (30.0, 40.0, -15.0), (40.0, 40.0, 0.0)]
)
def test_eq_13_and_14_are_mirror_images(now: float, before: float, change: float) -> None:
    # 60 * 10 / 40
    assert detector.change_by_line_deg(now, before, 60.0) == pytest.approx(change)
    assert detector.change_by_line_deg(now, 0.0, 60.0) == 0.0


def test_eq_15_smoothed_angle() -> None:
    # 0.1 * 20 + 0.9 * 10
    assert detector.smooth_angle_deg(20.0, 10.0, STEERING.angle_smoothing) == pytest.approx(11.0)
    assert detector.smooth_angle_deg(20.0, None, 0.1) == 20.0


def test_eq_16_smoothed_line() -> None:
    # m: 0.05 * -1 + 0.95 * -2; b: 0.05 * 80 + 0.95 * 100
    line = detector.smooth_line(Line(-1.0, 80.0), Line(-2.0, 100.0), STEERING.line_smoothing)
    assert (line.m, line.b) == pytest.approx((-1.95, 99.0))
    assert detector.smooth_line(Line(-1.0, 80.0), None, 0.05) == Line(-1.0, 80.0)


@given(st.floats(0.2, 5.0), st.floats(0.2, 5.0), st.floats(5.0, 75.0), st.floats(85.0, 155.0))
def test_mirrored_lines_mirror_every_angle(ml: float, mr: float, xl: float, xr: float) -> None:
    left, right = Line(-ml, 60.0 + ml * xl), Line(mr, 60.0 - mr * xr)
    # Mirrored at the centre line x = 80: x becomes 160 - x.
    left_m, right_m = Line(-mr, right.b + 160.0 * mr), Line(ml, left.b - 160.0 * ml)
    one = detector.vanishing_angle_deg(lines.vanishing_point(left, right), C1, C2)
    other = detector.vanishing_angle_deg(lines.vanishing_point(left_m, right_m), C1, C2)
    # The arc cosine near 1 loses half of its digits.
    assert one == pytest.approx(-other, abs=1e-4)
    sides = [abs(lines.x_at(line, 0.0) - C1[0]) for line in (left, right, left_m, right_m)]
    assert sides[0] == pytest.approx(sides[3]) and sides[1] == pytest.approx(sides[2])
