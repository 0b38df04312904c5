from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lane_frames import CAMERA, lane_frame

from lanenet.config import check_settings
from lanenet.errors import CalibrationError, ConfigError, DriveFormatError
from lanenet.perception.draw import draw_estimate
from lanenet.perception.estimate import Detector
from lanenet.perception.painter.curves import (
    Curve,
    CurveSettings,
    RoadPlane,
    SquarePlane,
    curvature_radius,
    finite_rows,
    fit_curve,
    move_lines,
    slide_windows,
)
from lanenet.perception.painter.detector import LanePainter, PainterSettings
from lanenet.perception.painter.lane import find_aim_cm, measure_lane
from lanenet.perception.painter.lines import (
    EdgeField,
    EvidenceSettings,
    LineEvidence,
    PainterEdgeSettings,
    PainterLineSettings,
    SolidLine,
    find_edge_field,
    find_painter_edges,
    find_trapezoid,
    find_two_lines,
    join_side,
    measure_evidence,
    value_channel,
)
from lanenet.perception.painter.markings import Marking, can_bound_the_lane, choose_lane, straight_px

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
    (line,) = join_side(dashes, (200.0, 100.0), 320.0, None, LINES)
    assert (line.bottom_px, line.top_px) == pytest.approx((100.0, 200.0))
    assert join_side(dashes[2:], (200.0, 100.0), 320.0, None, LINES) == []


def test_further_lines_come_after_the_best_and_a_short_one_stops_none() -> None:
    longest, second = [100.0, 200.0, 180.0, 120.0], [10.0, 200.0, 60.0, 150.0]
    short = [150.0, 200.0, 160.0, 190.0]
    segments = np.array([short, second, longest])
    lines = join_side(segments, (200.0, 100.0), 320.0, None, LINES, count=3)
    assert [line.bottom_px for line in lines] == pytest.approx([100.0, 10.0])
    # The frame before had the line that is now too short: the others are found all the same.
    lines = join_side(segments, (200.0, 100.0), 320.0, SolidLine(150.0, 250.0), LINES, count=1)
    assert [line.bottom_px for line in lines] == pytest.approx([100.0])


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


def test_lines_moved_together_are_those_moved_one_by_one() -> None:
    plane = RoadPlane(CAMERA)
    # The second line begins above the horizon, of the third nothing is on the road.
    lines = [
        np.array([[100.0, 200.0], [120.0, 160.0]]),
        np.array([[200.0, 0.0], [210.0, 150.0], [220.0, 220.0]]),
        np.array([[10.0, 0.0]]),
    ]
    moved = move_lines(plane.from_image, lines)
    assert [len(line) for line in moved] == [2, 2, 0] and move_lines(plane.from_image, []) == []
    for line, together in zip(lines, moved, strict=True):
        assert together == pytest.approx(finite_rows(plane.from_image(line)), abs=1e-9)
        # And back to where they came from.
        assert plane.to_image(together) == pytest.approx(line[len(line) - len(together) :], abs=1e-6)


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
    # However many points: two rows do not bend.
    assert fit_curve(np.tile([[0.0, 0.0], [1.0, 40.0]], (30, 1)), 40.0, CurveSettings()) is None


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
    # 3.5 heights of 20 cm ahead.
    aim = centre + slope * 70.0 + bend * 70.0**2
    assert estimate.steering_rad == pytest.approx(math.atan2(-aim, 70.0), abs=0.03)
    assert estimate.offset_cm == pytest.approx(-centre, abs=3.0)
    assert (painter.lane.offset_cm, painter.lane.radius_cm) == (estimate.offset_cm, estimate.radius_cm)
    if bend:
        assert estimate.radius_cm == pytest.approx(1.0 / (2.0 * bend), rel=0.3)
    else:
        assert estimate.radius_cm > 800.0


def test_straight_lines_tell_offset_and_an_infinite_radius() -> None:
    painter = LanePainter(CAMERA, PainterSettings(curves=False))
    estimate = painter.detect(lane_frame(4.0))
    assert estimate.radius_cm == math.inf and estimate.offset_cm == pytest.approx(-4.0, abs=2.0)
    assert painter.last.text.startswith("straight  ") and painter.last.text.endswith(" cm left of the middle")
    nothing = painter.detect(np.zeros((240, 320, 3), np.uint8))
    assert math.isnan(nothing.radius_cm) and math.isnan(nothing.offset_cm) and painter.last.text == ""


def test_radius_of_the_only_curve_and_offset_at_the_nearest_known_row() -> None:
    points = np.stack([np.zeros(2), [10.0, 60.0]], axis=1)
    straight = Marking(SolidLine(0.0, 0.0), None, points, points)
    bent = Marking(SolidLine(0.0, 0.0), Curve(0.005, 0.0, 20.0, 0.0, 60.0), points, points)
    rows = np.array([[math.nan, -18.0, -17.0], [22.0, 21.0, 20.0]])
    lane = measure_lane((straight, bent), rows)
    assert lane.radius_cm == pytest.approx(100.0) and lane.offset_cm == pytest.approx(-1.5)
    assert lane.text == "R 100 cm  1.5 cm left of the middle"
    assert measure_lane((straight, straight), rows).radius_cm == math.inf
    assert math.isnan(measure_lane((straight, None), rows).radius_cm)
    assert math.isnan(measure_lane((straight, bent), rows * math.nan).offset_cm)


def test_the_aim_lies_where_both_lines_are_seen() -> None:
    left = np.array([[-20.0, 20.0], [-10.0, 120.0]])
    right = np.array([[20.0, 10.0], [20.0, 50.0]])
    pair = tuple(Marking(SolidLine(0.0, 0.0), None, line, line) for line in (left, right))
    for look_ahead, y in ((5.0, 20.0), (40.0, 40.0), (100.0, 50.0)):
        aim = find_aim_cm((pair[0], pair[1]), look_ahead)
        assert aim == pytest.approx((0.5 * (-20.0 + 0.1 * (y - 20.0) + 20.0), y))
    beyond = Marking(SolidLine(0.0, 0.0), None, left, left + [0.0, 60.0])
    assert find_aim_cm((beyond, pair[1]), 40.0) is None and find_aim_cm((None, pair[1]), 40.0) is None


def test_look_ahead_of_the_steering() -> None:
    frame = lane_frame(0.0, 0.0, 0.0025)
    near, far = (
        LanePainter(CAMERA, PainterSettings(look_ahead_cm=y)).detect(frame).steering_rad for y in (25.0, 60.0)
    )
    # A bend to the right, little of which is seen near the car.
    assert -0.1 < near < 0.0 and far == pytest.approx(math.atan2(-9.0, 60.0), abs=0.03)


def edge_frame() -> tuple[np.ndarray, EdgeField]:
    """A white stripe from (100, 200) to (160, 100) in the trapezoid, and the field of its edges."""
    frame = np.full((240, 320, 3), 60, np.uint8)
    cv2.line(frame, (88, 220), (172, 80), (230, 230, 230), 5)
    settings = PainterEdgeSettings()
    edges = find_painter_edges(frame, TRAPEZOID, settings)
    return frame, find_edge_field(frame, edges, TRAPEZOID, settings)


def test_evidence_of_a_stripe_and_of_lines_beside_and_across_it() -> None:
    _, edges = edge_frame()
    settings = EvidenceSettings()
    on = measure_evidence(np.array([[100.0, 200.0], [160.0, 100.0]]), edges, settings)
    assert on.support > 0.95 and on.aligned > 0.9 and on.extent > 0.95 and on.clutter < 0.05
    assert on.is_strong(settings) and on.is_likely(settings)
    beside = measure_evidence(np.array([[160.0, 200.0], [190.0, 100.0]]), edges, settings)
    assert beside.support == 0.0 and not beside.is_likely(settings)
    # It crosses the stripe, whose edges do not run along it.
    across = measure_evidence(np.array([[160.0, 200.0], [100.0, 100.0]]), edges, settings)
    assert across.support == 0.0
    assert measure_evidence(np.array([[100.0, 200.0]]), edges, settings) == LineEvidence()
    none = EdgeField(np.empty((0, 2)), np.empty((0, 2)), TRAPEZOID, 320)
    assert measure_evidence(np.array([[100.0, 200.0], [160.0, 100.0]]), none, settings) == LineEvidence()


def marking(bottom: float, top: float, support: float, aligned: float = 0.9) -> Marking:
    line = SolidLine(bottom, top)
    line_px = straight_px(line, TRAPEZOID)
    points = SquarePlane(TRAPEZOID).from_image(line_px)
    return Marking(line, None, line_px, points, LineEvidence(support, 0.0, aligned, 0.9))


def choose(lefts: list[Marking], rights: list[Marking]) -> tuple[float | None, float | None]:
    pair = choose_lane(lefts, rights, TRAPEZOID, None, LINES, EvidenceSettings())
    left, right = (None if m is None else m.line.bottom_px for m in pair)
    return left, right


def test_choice_of_the_lane() -> None:
    left, right = marking(60.0, 135.0, 0.8), marking(260.0, 185.0, 0.7)
    assert choose([left], [right]) == (60.0, 260.0)
    # The lane of the car rather than both lanes; but not for a faint line between them.
    assert choose([left, marking(160.0, 160.0, 0.5)], [right]) == (160.0, 260.0)
    assert choose([left, marking(160.0, 160.0, 0.2, 0.5)], [right]) == (60.0, 260.0)
    # Lines that do not run beside each other on the road are no lane: the better one stays.
    assert choose([left], [marking(260.0, 140.0, 0.7)]) == (60.0, None)
    # A faint line is answered with a partner only.
    faint = marking(260.0, 185.0, 0.3, 0.5)
    assert choose([left], [faint]) == (60.0, 260.0) and choose([], [faint]) == (None, None)
    assert choose([marking(60.0, 135.0, 0.5)], []) == (None, None)


def test_a_line_further_away_than_a_lane_is_wide_does_not_bound_the_lane() -> None:
    plane = RoadPlane(CAMERA)

    def at(x_cm: float, from_cm: float = 0.0) -> Marking:
        points = np.stack([np.full(30, x_cm), np.linspace(from_cm, 90.0, 30)], axis=1)
        line_px = finite_rows(CAMERA.project_ground(points))
        return Marking(SolidLine(60.0, 135.0), None, line_px, points, LineEvidence(0.9, 0.0, 0.9, 0.9))

    def kept(*markings: Marking) -> list[Marking]:
        return can_bound_the_lane(markings, plane, CAMERA.width, 20.0, EvidenceSettings())

    # Six camera heights of 20 cm: a wall's foot three metres away is as strong a line as any.
    near, neighbour, wall = at(-20.0), at(-110.0, 30.0), at(-340.0, 30.0)
    assert kept(wall, near, neighbour) == [near, neighbour]
    assert kept(at(340.0, 30.0)) == [] and kept() == []
    # A line that leaves the image sideways may go anywhere from there: only what is in it counts.
    outside = np.array([[-300.0, 239.0], [-100.0, 200.0]])
    leaving = replace(near, line_px=np.concatenate([outside, near.line_px]))
    assert kept(leaving) == [leaving]
    assert kept(replace(near, line_px=outside)) == []


def test_a_row_is_answered_where_its_line_is_seen() -> None:
    frame = lane_frame()
    painter = LanePainter(CAMERA, PainterSettings(mode="photo"))
    assert painter.detect(frame).mask.all()
    # The left line ends 22 cm ahead: the road may bend from there on.
    end_px = round(float(CAMERA.project_ground(np.array([[-20.0, 22.0]]))[0, 1]))
    frame[:end_px, :160] = frame[-1, 160]
    points_cm = painter.detect(frame).points_cm
    assert np.isfinite(points_cm).tolist() == [True, True, False, True, True, True]
    # A straight line lies on an edge of the 3 cm tape, a curve on its middle.
    np.testing.assert_allclose(points_cm[[0, 1, 3, 4, 5]], [-20.0, -20.0, 20.0, 20.0, 20.0], atol=1.8)


def test_the_papers_plain_behaviour_by_settings() -> None:
    # Every segment of a side counts, and whatever comes of it is answered.
    plain = check_settings(
        PainterSettings,
        {
            "mode": "photo",
            "curves": False,
            "evidence": {"required": False},
            "edges": {"max_edge_share": 1.0},
            "lines": {"agree_share": 1e6, "min_support_share": 0.0, "min_width_share": 0.0},
        },
        "test",
    )
    segments = np.array([[100.0, 200.0, 120.0, 180.0], [20.0, 200.0, 60.0, 160.0]])
    left, right = find_two_lines(segments, TRAPEZOID, (None, None), plain.lines)
    assert left is not None and right is None
    # The mean over all, weighted by length: (20 * 100 + 40 * 20) / 60.
    assert left.bottom_px == pytest.approx(46.667, abs=1e-3)
    assert LanePainter(None, plain).detect(lane_frame(0.0)).confidence > 0.0


def test_without_a_camera_the_image_lines_lie_on_the_markings() -> None:
    painter = LanePainter(
        None,
        PainterSettings(
            edges=PainterEdgeSettings(trapezoid=((0.2, 0.4), (0.8, 0.4), (1.0, 0.95), (0.0, 0.95)))
        ),
    )
    estimate = painter.detect(lane_frame(0.0))
    assert estimate.confidence == 1.0 and not estimate.mask.any()
    assert abs(estimate.steering_rad) < 0.05 and math.isnan(painter.lane.radius_cm)
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
    # What is remembered is drawn as such, not answered.
    assert video.last.left_px is None and len(video.last.memory_px) == 2
    assert photo.last.left_px is None and photo.last.memory_px == ()
    for _ in range(5):
        video.detect(black)
    assert video.last.memory_px == ()


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


def test_a_frame_too_small_for_lines_has_the_columns_of_any_other_and_is_said() -> None:
    painter = LanePainter()
    for sides in ((47, 300), (300, 47)):
        lines_px = painter.detect(np.zeros((*sides, 3), np.uint8)).lines_px
        assert lines_px is not None and np.isnan(lines_px).all()
    assert "fewer than 48 px, as in 2 frames here" in painter.hint
