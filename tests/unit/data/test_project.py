"""Six points from lines on the map: known values, and the world moved and mirrored."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lanenet.data.maps.frame_lines import lines_of_frame
from lanenet.data.maps.line import LaneLine, Side
from lanenet.geometry.lane import ROWS_CM, label_rows, mirror_points

WHEELBASE_CM = 17.0
LENGTH_CM = 400.0
HALF_CM = 20.0


def _knots() -> tuple[np.ndarray, np.ndarray]:
    """Knots of a cubic over the road, and the control points' abscissas that make x(s) = s."""
    knots = np.concatenate([np.zeros(3), np.linspace(0.0, LENGTH_CM, 21), np.full(3, LENGTH_CM)])
    return knots, np.array([knots[i + 1 : i + 4].mean() for i in range(len(knots) - 4)])


def _straight(supported: tuple[float, float] = (0.0, LENGTH_CM)) -> list[LaneLine]:
    """Lines at y = +20 and -20 along the map's x axis; the car drives towards +x."""
    knots, s = _knots()

    def line(side: Side, y_cm: float) -> LaneLine:
        return LaneLine(side, knots, np.column_stack([s, np.full_like(s, y_cm)]), np.array([supported]), 0.1)

    return [line("left", HALF_CM), line("right", -HALF_CM)]


def _moved(lines: list[LaneLine], x_cm: float, y_cm: float, turn_rad: float) -> list[LaneLine]:
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    rotation = np.array([[c, -s], [s, c]])
    return [
        LaneLine(
            line.side,
            line.knots_cm,
            line.coefficients_cm @ rotation.T + [x_cm, y_cm],
            line.supported_cm,
            line.residual_cm,
        )
        for line in lines
    ]


def _bent() -> list[LaneLine]:
    """Lines with a wave, so that nothing is symmetric."""
    lines = _straight()
    wave = 6.0 * np.sin(lines[0].coefficients_cm[:, 0] / 40.0)
    return [
        LaneLine(
            line.side,
            line.knots_cm,
            line.coefficients_cm
            + np.column_stack([np.zeros_like(wave), wave * (1.0 + 0.2 * (line.side == "left"))]),
            line.supported_cm,
            line.residual_cm,
        )
        for line in lines
    ]


@pytest.mark.parametrize("offset", [0.0, 7.0, -12.0])
@pytest.mark.parametrize("heading", [0.0, 0.2, -0.35])
def test_a_straight_lane_gives_the_analytic_points(heading, offset):
    pose = np.array([150.0, offset, heading])
    found = lines_of_frame(_straight(), pose, 150.0, WHEELBASE_CM)
    # A point of the line y = h lies at x_car = (y - h) / cos for a car without heading; in general the row
    # y_car meets it where (row + wheelbase) sin - x_car cos = h - offset.
    expected = [
        ((row + WHEELBASE_CM) * np.sin(heading) - (h - offset)) / np.cos(heading)
        for h in (HALF_CM, -HALF_CM)
        for row in ROWS_CM
    ]
    np.testing.assert_allclose(found.points_cm, expected, atol=1e-6)


def _kinked(at_cm: float) -> list[LaneLine]:
    """Straight lines whose left one turns right by 45 degrees at a corner."""
    left, right = _straight()
    knots = np.sort(np.concatenate([left.knots_cm, [at_cm] * 3]))
    s = np.array([knots[i + 1 : i + 4].mean() for i in range(len(knots) - 4)])
    control = np.column_stack([s, HALF_CM - np.maximum(s - at_cm, 0.0)])
    return [LaneLine("left", knots, control, left.supported_cm, 0.1), right]


@pytest.mark.parametrize("forward", [True, False])
def test_a_corner_is_not_cut(forward):
    # The corner lies in the row of y = 15 cm, between two samples of the polyline.
    at_cm = 150.0 + (1.0 if forward else -1.0) * (WHEELBASE_CM + 15.0)
    lines = _kinked(at_cm)
    pose = np.array([150.0, 0.0, 0.0 if forward else np.pi])
    found = lines_of_frame(lines, pose, 150.0, WHEELBASE_CM, forward=forward)
    labels = found.points_cm[:3] if forward else found.points_cm[3:]
    # Before the corner the line is straight; beyond it, it comes nearer, or, on the way back, did.
    beyond = [0.0, 0.0, -15.0] if forward else [15.0, 0.0, 0.0]
    expected = HALF_CM + np.array(beyond) if forward else HALF_CM - np.array(beyond)
    np.testing.assert_allclose(np.abs(labels), expected, atol=1e-6)
    assert np.diff(found.left_cm[:, 1]).min() > 0.0


def test_left_is_negative_and_the_polylines_recede():
    found = lines_of_frame(_straight(), np.array([150.0, 0.0, 0.0]), 150.0, WHEELBASE_CM)
    np.testing.assert_allclose(found.points_cm, [-20.0] * 3 + [20.0] * 3, atol=1e-9)
    for line in (found.left_cm, found.right_cm):
        assert (np.diff(line[:, 1]) > 0.0).all()
        # From under the car to well beyond the window's 72 cm.
        assert line[0, 1] < -30.0
        assert line[-1, 1] > 80.0


@settings(max_examples=40, deadline=None)
@given(st.floats(-400.0, 400.0), st.floats(-400.0, 400.0), st.floats(-10.0, 10.0), st.floats(-0.3, 0.3))
def test_moving_the_whole_world_changes_nothing(x, y, turn, heading):
    pose = np.array([180.0, 3.0, heading])
    here = lines_of_frame(_bent(), pose, 180.0, WHEELBASE_CM)
    c, s = np.cos(turn), np.sin(turn)
    moved = np.array([c * pose[0] - s * pose[1] + x, s * pose[0] + c * pose[1] + y, pose[2] + turn])
    there = lines_of_frame(_moved(_bent(), x, y, turn), moved, 180.0, WHEELBASE_CM)
    assert np.isfinite(here.points_cm).all()
    np.testing.assert_allclose(there.points_cm, here.points_cm, atol=1e-6)
    np.testing.assert_allclose(there.left_cm, here.left_cm, atol=1e-6)


@pytest.mark.parametrize("heading", [0.0, 0.25, -0.3])
def test_mirroring_the_world_swaps_and_negates(heading):
    lines = _bent()
    pose = np.array([180.0, 5.0, heading])
    flip = np.array([1.0, -1.0])
    other: dict[str, Side] = {"left": "right", "right": "left"}
    mirrored = [
        LaneLine(
            other[line.side], line.knots_cm, line.coefficients_cm * flip, line.supported_cm, line.residual_cm
        )
        for line in lines
    ]
    here = lines_of_frame(lines, pose, 180.0, WHEELBASE_CM).points_cm
    there = lines_of_frame(mirrored, pose * [1.0, -1.0, -1.0], 180.0, WHEELBASE_CM).points_cm
    np.testing.assert_allclose(there, mirror_points(here), atol=1e-9)


def test_the_order_of_the_lines_does_not_matter():
    pose = np.array([180.0, 5.0, 0.1])
    np.testing.assert_array_equal(
        lines_of_frame(_bent(), pose, 180.0, WHEELBASE_CM).points_cm,
        lines_of_frame(_bent()[::-1], pose, 180.0, WHEELBASE_CM).points_cm,
    )


def test_points_without_support_are_masked():
    # Supported up to s = 185: row 0 is at 167, row 15 at 182, row 30 at 197.
    found = lines_of_frame(_straight((0.0, 185.0)), np.array([150.0, 0.0, 0.0]), 150.0, WHEELBASE_CM)
    np.testing.assert_array_equal(np.isfinite(found.points_cm), [True, True, False] * 2)
    nothing = lines_of_frame(_straight((300.0, 310.0)), np.array([150.0, 0.0, 0.0]), 150.0, WHEELBASE_CM)
    assert np.isnan(nothing.points_cm).all()


def test_only_the_stretch_around_the_frame_counts():
    # A road that comes back across the car's view: lines in the map's own s, 300 cm further on.
    knots, s = _knots()
    bend = np.where(s < 250.0, s, 500.0 - s)

    def line(side: Side, y_cm: float) -> LaneLine:
        y = np.where(s < 250.0, y_cm, 5.0 + 0.1 * y_cm)
        return LaneLine(side, knots, np.column_stack([bend, y]), np.array([[0.0, LENGTH_CM]]), 0.1)

    found = lines_of_frame(
        [line("left", 20.0), line("right", -20.0)], np.array([100.0, 0.0, 0.0]), 100.0, 17.0
    )
    np.testing.assert_allclose(found.points_cm, [-20.0] * 3 + [20.0] * 3, atol=1e-6)


def test_the_other_way_swaps_the_lines():
    pose = np.array([150.0, 4.0, np.pi])
    found = lines_of_frame(_straight(), pose, 150.0, WHEELBASE_CM, forward=False)
    # The path's right line, at y = -20, is to the left of a car that drives towards -x.
    np.testing.assert_allclose(found.points_cm, [-24.0] * 3 + [16.0] * 3, atol=1e-6)
    for line in (found.left_cm, found.right_cm):
        assert (np.diff(line[:, 1]) > 0.0).all()


def test_a_lane_beside_the_driven_one():
    lines = _straight()
    further = replace(lines[0], rank=1, coefficients_cm=lines[0].coefficients_cm + [0.0, 2.0 * HALF_CM])
    there = lines_of_frame([*lines, further], np.array([150.0, 45.0, 0.0]), 150.0, WHEELBASE_CM, lane=-1)
    np.testing.assert_allclose(there.points_cm, [-15.0] * 3 + [25.0] * 3, atol=1e-6)
    back = np.array([150.0, 45.0, np.pi])
    oncoming = lines_of_frame([*lines, further], back, 150.0, WHEELBASE_CM, lane=-1, forward=False)
    np.testing.assert_allclose(oncoming.points_cm, [-25.0] * 3 + [15.0] * 3, atol=1e-6)


def test_uncertain_stretches_are_masked():
    lines = [
        replace(line, sigma_s_cm=np.array([0.0, 175.0, 176.0]), sigma_at_cm=np.array([0.1, 0.1, 3.0]))
        for line in _straight()
    ]
    pose = np.array([150.0, 0.0, 0.0])
    # Row 0 is at s = 167, row 15 at 182.
    found = lines_of_frame(lines, pose, 150.0, WHEELBASE_CM, max_sigma_cm=1.0)
    np.testing.assert_array_equal(np.isfinite(found.points_cm), [True, False, False] * 2)
    assert np.isfinite(lines_of_frame(lines, pose, 150.0, WHEELBASE_CM).points_cm).all()


@pytest.mark.parametrize(
    ("degrees", "known"), [(0.0, True), (50.0, True), (58.0, True), (65.0, False), (80.0, False)]
)
def test_a_line_that_turns_away_is_masked(degrees, known):
    along = np.arange(-60.0, 260.0, 2.0)
    angle = np.deg2rad(degrees)
    line = np.column_stack([along * np.sin(angle) - 20.0, along * np.cos(angle)])
    assert np.isfinite(label_rows(line)).all() == known
    assert np.isnan(label_rows(line)).all() != known


def test_a_row_that_is_crossed_twice_is_masked():
    turn = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 60)
    # Up to y = 25 and back down: rows 0 and 15 twice, row 30 never.
    hairpin = np.column_stack([20.0 * np.sin(turn), 45.0 * np.cos(turn) - 20.0])
    assert np.isnan(label_rows(hairpin)).all()
    upwards = hairpin[:30]
    np.testing.assert_array_equal(np.isfinite(label_rows(upwards)), [True, True, False])
