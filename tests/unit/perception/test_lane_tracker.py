"""Lines of a network on the edge points of their markings, and from frame to frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tapes import tape, together, turned

from lanenet.geometry.lane import parabolas_from_points
from lanenet.onboard.bench import example_camera
from lanenet.perception.edges.road import RoadEdges
from lanenet.perception.estimate import LaneMemory
from lanenet.perception.network.refinement import RoadBorders, refine_lines
from lanenet.perception.network.tracking import tracker as tracker_module
from lanenet.perception.network.tracking.camera_view import CameraView
from lanenet.perception.network.tracking.pair import distances_cm
from lanenet.perception.network.tracking.tracker import LaneTracker

LANE_CM = 40.0
BENT = np.array([-20.0, -19.0, -16.0, 20.0, 21.0, 24.0])
SURE, SEEN = np.full(6, 0.8), np.ones(2)


def edges_of(points_cm: np.ndarray, marking_cm: float = 3.0, sides: tuple[int, ...] = (0, 1)) -> RoadEdges:
    """Borders of markings along the lines; a negative width is a dark marking."""
    y = np.arange(2.0, 45.0, 0.5)
    points, normals = [], []
    for a, b, c in parabolas_from_points(points_cm)[list(sides)]:
        slope = 2.0 * a * y + b
        right = np.stack([np.ones_like(y), -slope], axis=1) / np.hypot(1.0, slope)[:, None]
        middle = np.stack([a * y * y + b * y + c, y], axis=1)
        for border in (-0.5, 0.5):
            points.append(middle + border * abs(marking_cm) * right)
            # Towards the brighter side: into a light marking, out of a dark one.
            normals.append(-2.0 * border * np.sign(marking_cm) * right)
    return RoadEdges(np.concatenate(points), np.concatenate(normals))


@pytest.mark.parametrize("marking_cm", [3.0, 5.0, -2.5])
def test_a_line_moves_onto_its_marking(marking_cm):
    borders = RoadBorders(edges_of(BENT, marking_cm))
    start = BENT.reshape(2, 3) + [[2.0, 2.5, 3.0], [-2.0, -2.0, -2.0]]
    expected = np.full(2, 3.0 * np.sign(marking_cm))
    found = refine_lines(start, np.full((2, 3), 2.0), borders, expected, np.full(2, 2.0))
    np.testing.assert_allclose(found.points_cm, BENT.reshape(2, 3), atol=0.15)
    np.testing.assert_allclose(found.marking_cm, marking_cm, atol=0.2)
    assert (found.seen_cm > 30.0).all() and (found.sigma_cm < 1.0).all()


def test_a_line_without_its_marking_keeps_the_networks_answer():
    start = BENT.reshape(2, 3) + 1.0
    marking, sigma = np.full(2, 3.0), np.full(2, 0.3)
    given = np.full((2, 3), 2.0)
    found = refine_lines(start, given, RoadBorders(edges_of(BENT, sides=(0,))), marking, sigma)
    assert found.seen_cm[0] > 30.0 and found.seen_cm[1] == 0.0
    np.testing.assert_array_equal(found.points_cm[1], start[1])
    assert (found.sigma_cm[1] >= 2.0).all()
    none = RoadEdges(np.empty((0, 2)), np.empty((0, 2)))
    found = refine_lines(start, given, RoadBorders(none), marking, sigma)
    np.testing.assert_array_equal(found.points_cm, start)
    assert not found.seen_cm.any()


@pytest.mark.parametrize("marking_cm", [4.0, -4.0])
def test_dark_and_light_markings_are_told_apart(marking_cm):
    tracker = LaneTracker(LaneMemory(LANE_CM))
    for _ in range(12):
        points_cm, sigma_cm, seen_cm = tracker.follow(BENT + 1.5, SURE, SEEN, edges_of(BENT, marking_cm))
    np.testing.assert_allclose(points_cm, BENT, atol=0.1)
    assert (seen_cm > 30.0).all() and (sigma_cm < 1.0).all()


def test_a_marking_that_was_learned_wrong_is_unlearned():
    """A dark tape of 6 cm of which glare showed the near border only, as a light strip of 1 cm."""
    tracker = LaneTracker(LaneMemory(LANE_CM))
    glare = BENT + np.array([2.5] * 3 + [-2.5] * 3)
    for _ in range(12):
        tracker.follow(glare, SURE, SEEN, edges_of(glare, 1.0))
    for _ in range(60):
        points_cm, _, _ = tracker.follow(BENT + 0.5, SURE, SEEN, edges_of(BENT, -6.0))
    np.testing.assert_allclose(points_cm, BENT, atol=0.1)


def test_a_frame_that_looks_like_the_next_lane_does_not_change_the_lane():
    tracker = LaneTracker(LaneMemory(LANE_CM))
    next_lane = BENT + LANE_CM
    for _ in range(3):
        tracker.follow(BENT, SURE, SEEN, edges_of(BENT))
    # The network takes the line on the right for its left one, and guesses the other.
    doubtful = np.array([0.9, 0.4])
    points_cm, _, _ = tracker.follow(next_lane, SURE, doubtful, edges_of(BENT + 1.0))
    # It contradicts the network by a lane, and half of such answers are wrong: it gives none, and keeps it.
    assert np.isnan(points_cm).all()
    points_cm, _, _ = tracker.follow(BENT + 2.0, SURE, SEEN, edges_of(BENT + 2.0))
    np.testing.assert_allclose(points_cm, BENT + 2.0, atol=0.2)
    # Nothing is kept beyond a reset.
    tracker.reset()
    points_cm, _, _ = tracker.follow(next_lane, SURE, doubtful, edges_of(BENT + 1.0))
    np.testing.assert_allclose(points_cm[:3], BENT[3:] + 1.0, atol=0.2)


def test_one_line_that_is_seen_tells_where_the_other_one_is():
    tracker = LaneTracker(LaneMemory(LANE_CM))
    straight = np.array([-20.0] * 3 + [20.0] * 3)
    unsure = np.concatenate([SURE[:3], np.full(3, 8.0)])
    guess = straight + np.array([1.0] * 3 + [4.0] * 3)
    points_cm, sigma_cm, seen_cm = tracker.follow(guess, unsure, SEEN, edges_of(straight, sides=(0,)))
    np.testing.assert_allclose(points_cm, straight, atol=0.2)
    # The network says something else: that counts.
    assert seen_cm[1] == 0.0 and 2.0 < sigma_cm[3:].max() < 3.0


@pytest.mark.parametrize("forgotten", [False, True])
def test_the_line_beside_a_lane_that_has_widened_is_not_told_by_its_usual_width(forgotten):
    tracker = LaneTracker(LaneMemory(LANE_CM))
    for wider_cm in np.arange(0.0, 16.0):
        wide = np.repeat([-20.0, 20.0 + wider_cm], 3)
        tracker.follow(wide, SURE, SEEN, edges_of(wide))
    if forgotten:
        tracker.reset()
    # The right line is out of view, and the network takes the lane for one of the usual width.
    usual = np.repeat([-20.0, 20.0], 3)
    points_cm, _, _ = tracker.follow(usual, SURE, np.array([1.0, 0.0]), edges_of(usual, sides=(0,)))
    np.testing.assert_allclose(points_cm[:3], -20.0, atol=0.2)
    assert np.isfinite(points_cm[3:]).tolist() == [forgotten] * 3


def sigma_15_cm_ahead(off_cm: float) -> float:
    """That of the left line, where the network's own answer lies so far beside it."""
    straight = np.array([-20.0] * 3 + [20.0] * 3)
    tracker = LaneTracker(LaneMemory(LANE_CM))
    points_cm, sigma_cm, _ = tracker.follow(straight + off_cm, SURE, SEEN, edges_of(straight))
    np.testing.assert_allclose(points_cm, straight, atol=0.3)
    return float(sigma_cm[1])


def test_sigma_tells_how_far_the_line_is_from_the_networks_own():
    none_cm = sigma_15_cm_ahead(0.0)
    # Labels are never better than 0.2 cm, and three fifths of all that is told.
    assert 0.62 * 0.2 < none_cm < 0.3
    for off_cm in (1.0, 3.0):
        np.testing.assert_allclose(
            sigma_15_cm_ahead(off_cm), np.hypot(none_cm, 0.62 * off_cm), rtol=0.02, atol=0.01
        )


def test_sigma_tells_how_far_out_of_view_the_line_is():
    straight = np.array([-20.0] * 3 + [20.0] * 3)
    camera = example_camera()
    view = CameraView(replace(camera, mounting=replace(camera.mounting, ahead_of_front_axle_cm=40.0)))
    hidden_cm = view.hidden_cm(0, -20.0)
    assert hidden_cm > 5.0
    seen, hidden = (
        LaneTracker(LaneMemory(LANE_CM), view=each).follow(straight, SURE, SEEN, edges_of(straight))[1][0]
        for each in (None, view)
    )
    np.testing.assert_allclose(hidden, np.hypot(seen, 0.62 * 0.08 * hidden_cm), rtol=1e-6)


@pytest.mark.parametrize("painted", [True, False])
def test_a_car_that_crosses_a_line_is_in_the_next_lane_if_there_is_one(painted):
    tracker = LaneTracker(LaneMemory(LANE_CM))
    lines = np.repeat([-20.0, 20.0, -60.0], 3)
    for shift_cm in np.arange(0.0, 31.0, 3.0):
        moved = lines + shift_cm
        edges = edges_of(moved[:6])
        if painted:
            beyond = edges_of(np.concatenate([moved[6:], moved[6:]]), sides=(0,))
            both = zip((edges.points_cm, edges.normals), (beyond.points_cm, beyond.normals), strict=True)
            edges = RoadEdges(*(np.concatenate(pair) for pair in both))
        # The network stays with the lane that was left.
        points_cm, _, _ = tracker.follow(moved[:6] + 0.3, SURE, SEEN, edges)
    expected = np.concatenate([moved[6:], moved[:3]]) if painted else moved[:6]
    if painted:
        # What contradicts the network is not answered, until that follows.
        assert np.isnan(points_cm).all()
        points_cm, _, _ = tracker.follow(expected + 0.3, SURE, SEEN, edges)
    np.testing.assert_allclose(points_cm, expected, atol=0.3)


def test_tape_with_a_kink_is_followed():
    # Straight ahead, then to the left by 31 degrees.
    y = np.arange(-3.0, 42.0, 0.5)
    x = -20.0 - 0.6 * np.maximum(y - 12.0, 0.0)
    points = np.concatenate([np.stack([x + side, y], axis=1) for side in (-1.5, 1.5)])
    right = np.where(y[:, None] < 12.0, [[1.0, 0.0]], np.array([[1.0, 0.6]]) / np.hypot(1.0, 0.6))
    borders = RoadBorders(RoadEdges(points, np.concatenate([right, -right])))
    start, sigma = np.full((1, 3), -20.0), np.array([[1.0, 2.0, 6.0]])
    found = refine_lines(start, sigma, borders, np.array([3.0]), np.array([0.3]))
    np.testing.assert_allclose(found.points_cm, [[-20.0, -21.8, -30.8]], atol=0.6)
    assert found.seen_cm[0] > 36.0 and found.seen_at.all()


def test_sigma_grows_where_no_border_is_near():
    edges = edges_of(BENT, sides=(0,))
    near = edges.points_cm[:, 1] < 18.0
    borders = RoadBorders(RoadEdges(edges.points_cm[near], edges.normals[near]))
    found = refine_lines(BENT[None, :3], np.full((1, 3), 8.0), borders, np.array([3.0]), np.array([0.3]))
    assert found.seen_at.tolist() == [[True, True, False]]
    assert found.sigma_cm[0, 2] > 4.0 * found.sigma_cm[0, 1]


def test_a_line_that_nothing_tells_of_is_not_answered():
    tracker = LaneTracker(LaneMemory())
    guess = BENT + np.array([0.0] * 3 + [9.0] * 3)
    unsure = np.concatenate([SURE[:3], np.full(3, 4.0)])
    points_cm, sigma_cm, _ = tracker.follow(guess, unsure, np.array([1.0, 0.2]), edges_of(BENT, sides=(0,)))
    np.testing.assert_allclose(points_cm[:3], BENT[:3], atol=0.2)
    assert np.isnan(points_cm[3:]).all() and np.isnan(sigma_cm[3:]).all()


@pytest.mark.parametrize(
    ("x_cm", "sides", "answered"), [(0.9, (1,), True), (0.5, (1,), False), (0.5, (0, 1), False)]
)
def test_a_car_on_a_line_is_in_a_lane_that_nobody_knows(x_cm, sides, answered):
    tracker = LaneTracker(LaneMemory(LANE_CM))
    lines = np.repeat([x_cm - LANE_CM, x_cm], 3)
    for _ in range(3):
        points_cm, _, _ = tracker.follow(lines, SURE, SEEN, edges_of(lines, sides=sides))
    assert np.isfinite(points_cm).all() == answered


@pytest.mark.parametrize(
    ("x_cm", "presence", "answered"), [(-9.0, 0.4, False), (-9.0, 0.6, True), (-11.0, 0.4, True)]
)
def test_beside_a_line_that_the_network_does_not_see_nothing_is_answered(x_cm, presence, answered):
    tracker = LaneTracker(LaneMemory(LANE_CM))
    lines = np.repeat([x_cm, x_cm + LANE_CM], 3)
    points_cm, _, _ = tracker.follow(lines, SURE, np.array([presence, 1.0]), edges_of(lines))
    assert np.isfinite(points_cm).all() == answered


@pytest.mark.parametrize(
    ("x_cm", "sides", "answered"), [(-9.0, (0,), False), (-9.0, (0, 1), True), (-11.0, (0,), True)]
)
def test_beside_a_crossed_line_the_next_lane_counts_once_its_other_line_is_seen(x_cm, sides, answered):
    tracker = LaneTracker(LaneMemory(LANE_CM))
    for line_cm in (8.0, 4.0):
        before = np.repeat([line_cm - LANE_CM, line_cm], 3)
        tracker.follow(before, SURE, SEEN, edges_of(before))
    # The line of the lane that was left is out of view.
    for line_cm in (-4.0, x_cm):
        lines = np.repeat([line_cm, line_cm + LANE_CM], 3)
        presence = np.array([1.0, float(1 in sides)])
        points_cm, _, _ = tracker.follow(lines, SURE, presence, edges_of(lines, sides=sides))
    assert np.isfinite(points_cm).all() == answered


def test_two_lanes_for_which_equally_much_speaks_are_none():
    tracker = LaneTracker(LaneMemory(LANE_CM))
    lines = np.repeat([0.9 - LANE_CM, 0.9, 0.9 + LANE_CM], 3)
    tracker.follow(lines[:6], SURE, SEEN, edges_of(lines[:6]))
    # The car has come onto a line: the network takes the next lane, half sure.
    lines -= 1.8
    both = edges_of(lines[:6]).rows(), edges_of(lines[3:], sides=(1,)).rows()
    edges = RoadEdges.of_rows(np.concatenate(both))
    points_cm, _, _ = tracker.follow(lines[3:], SURE, 0.5 * SEEN, edges)
    assert np.isnan(points_cm).all()
    points_cm, _, _ = tracker.follow(lines[3:], SURE, SEEN, edges)
    np.testing.assert_allclose(points_cm, lines[3:], atol=0.2)


def test_the_lane_that_a_car_may_have_left_is_followed_until_one_of_the_two_is_plain():
    tracker = LaneTracker(LaneMemory(LANE_CM))
    for line_cm in (8.0, 4.0, 0.9):
        lane = np.repeat([line_cm - LANE_CM, line_cm], 3)
        points_cm, _, _ = tracker.follow(lane, SURE, SEEN, edges_of(lane))
    np.testing.assert_allclose(points_cm, lane, atol=0.2)
    # Beyond its outer line is bare floor. The network takes that for a lane.
    for line_cm in (-6.0, -11.0, -14.0, -14.0, -11.0, -6.0):
        lane = np.repeat([line_cm - LANE_CM, line_cm], 3)
        edges = edges_of(lane)
        # The lane's left line passes out of view.
        shown = edges.rows()[(edges.points_cm[:, 0] > line_cm - 10.0) | (edges.points_cm[:, 1] < 20.0)]
        takes = lane + LANE_CM
        points_cm, _, _ = tracker.follow(takes, SURE, np.array([1.0, 0.4]), RoadEdges.of_rows(shown))
        assert np.isnan(points_cm).all()
    for line_cm in (4.0, 8.0):
        lane = np.repeat([line_cm - LANE_CM, line_cm], 3)
        points_cm, _, _ = tracker.follow(lane, SURE, SEEN, edges_of(lane))
    np.testing.assert_allclose(points_cm, lane, atol=0.2)


def test_a_line_that_the_network_has_elsewhere_is_not_answered():
    tracker = LaneTracker(LaneMemory(LANE_CM))
    for _ in range(3):
        tracker.follow(BENT, SURE, SEEN, edges_of(BENT))
    # The left line is found again where it was; the network has it 8 cm beside it, where nothing is.
    elsewhere = BENT + np.repeat([8.0, 0.0], 3)
    points_cm, _, _ = tracker.follow(elsewhere, SURE, SEEN, edges_of(BENT))
    assert np.isnan(points_cm[:3]).all()
    np.testing.assert_allclose(points_cm[3:], BENT[3:], atol=0.2)


@pytest.mark.parametrize("solid", [True, False])
def test_where_a_solid_line_is_not_seen_ahead_it_is_not_continued(solid):
    tracker = LaneTracker(LaneMemory(LANE_CM))
    edges = edges_of(BENT)
    gap = (edges.points_cm[:, 1] > 12.0) & (edges.points_cm[:, 1] < 24.0)
    for _ in range(12):
        shown = edges.rows() if solid else edges.rows()[~gap]
        tracker.follow(BENT, SURE, SEEN, RoadEdges.of_rows(shown))
    # The left one ends 21 cm ahead, since its tape turns there.
    ended = edges.rows()[(edges.points_cm[:, 1] < 21.0) | (edges.points_cm[:, 0] > 0.0)]
    points_cm, _, _ = tracker.follow(BENT, SURE, SEEN, RoadEdges.of_rows(ended))
    assert np.isnan(points_cm).tolist() == [False, False, solid, False, False, False]


@pytest.mark.parametrize("other_seen", [True, False])
def test_nothing_is_answered_beyond_a_corner_of_the_tape(other_seen):
    lane = np.repeat([-20.0, 20.0], 3)
    tracker = LaneTracker(LaneMemory(LANE_CM))
    for _ in range(12):
        tracker.follow(lane, SURE, SEEN, edges_of(lane))
    # The left line turns to the right 12 cm ahead; the network has both straight on.
    shown = tape(turned(75.0, 12.0), 3.0)
    if other_seen:
        shown = together(shown, edges_of(lane, sides=(1,)))
    points_cm, _, _ = tracker.follow(lane, SURE, np.array([1.0, float(other_seen)]), shown)
    assert np.isfinite(points_cm).tolist() == [True, False, False, *[other_seen] * 3]


def test_what_lies_beyond_a_corner_does_not_make_the_line_go_on():
    lane = np.repeat([-20.0, 20.0], 3)
    tracker = LaneTracker(LaneMemory(LANE_CM))
    for _ in range(12):
        tracker.follow(lane, SURE, SEEN, edges_of(lane))
    # One border of something else lies on the line's continuation.
    onward = edges_of(lane)
    beyond = onward.rows()[(onward.points_cm[:, 0] < -20.0) & (onward.points_cm[:, 1] > 36.0)]
    shown = together(tape(turned(75.0, 12.0), 3.0), edges_of(lane, sides=(1,)), RoadEdges.of_rows(beyond))
    points_cm, _, _ = tracker.follow(lane, SURE, SEEN, shown)
    assert np.isfinite(points_cm).tolist() == [True, False, False, True, True, True]


@pytest.mark.parametrize(("frames", "sides", "answered"), [(3, (1,), 0), (3, (0, 1), 6), (2, (1,), 6)])
def test_a_lost_lane_is_found_again_with_both_of_its_lines(frames, sides, answered):
    lane = np.repeat([-20.0, 20.0], 3)
    tracker = LaneTracker(LaneMemory(LANE_CM))
    tracker.follow(lane, SURE, SEEN, edges_of(lane))
    for _ in range(frames):
        tracker.lose()
    presence = np.array([float(0 in sides), 1.0])
    points_cm, sigma_cm, _ = tracker.follow(lane, SURE, presence, edges_of(lane, sides=sides))
    assert np.isfinite(points_cm).sum() == np.isfinite(sigma_cm).sum() == answered


def test_a_car_between_two_lanes_has_not_lost_them():
    tracker = LaneTracker(LaneMemory(LANE_CM))
    for x_cm in (9.0, 4.0, *[0.5] * 4):
        lines = np.repeat([x_cm - LANE_CM, x_cm], 3)
        points_cm, _, _ = tracker.follow(lines, SURE, SEEN, edges_of(lines, sides=(1,)))
    assert np.isnan(points_cm).all()
    lines = np.repeat([4.0 - LANE_CM, 4.0], 3)
    points_cm, _, _ = tracker.follow(lines, SURE, np.array([0.0, 1.0]), edges_of(lines, sides=(1,)))
    assert np.isfinite(points_cm).any()


@pytest.mark.parametrize(
    ("presence", "sides", "answered"),
    [((0.4, 0.4), (1,), False), ((0.4, 0.6), (1,), True), ((0.4, 0.4), (0, 1), True)],
)
def test_a_line_that_the_network_does_not_see_is_none_by_itself(presence, sides, answered):
    lane = np.repeat([-20.0, 20.0], 3)
    tracker = LaneTracker(LaneMemory(LANE_CM))
    tracker.follow(lane, SURE, SEEN, edges_of(lane))
    points_cm, _, _ = tracker.follow(lane, SURE, np.array(presence), edges_of(lane, sides=sides))
    assert np.isfinite(points_cm).all() == answered


def test_a_lane_is_lost_where_nothing_of_it_is_known():
    tracker = LaneTracker(LaneMemory(LANE_CM))
    lane = np.repeat([-20.0, 20.0], 3)
    nothing = RoadEdges(np.empty((0, 2)), np.empty((0, 2)))
    tracker.follow(lane, SURE, SEEN, edges_of(lane))
    for _ in range(3):
        points_cm, _, _ = tracker.follow(lane, SURE, 0.1 * SEEN, nothing)
        assert np.isnan(points_cm).all()
    points_cm, _, _ = tracker.follow(lane, SURE, np.array([0.0, 1.0]), edges_of(lane, sides=(1,)))
    assert np.isnan(points_cm).all()


def test_where_both_lines_go_on_no_corner_is_looked_for(monkeypatch):
    lane = np.repeat([-20.0, 20.0], 3)
    looked_for = []
    monkeypatch.setattr(
        tracker_module, "corners", lambda lines, *_: looked_for.append(len(lines)) or [None] * len(lines)
    )
    tracker = LaneTracker(LaneMemory(LANE_CM))
    edges = edges_of(lane)
    tracker.follow(lane, SURE, SEEN, edges)
    assert not looked_for
    ends = edges.points_cm[:, 1] < np.where(edges.points_cm[:, 0] < 0.0, 30.0, 50.0)
    tracker.follow(lane, SURE, SEEN, RoadEdges(edges.points_cm[ends], edges.normals[ends]))
    tracker.follow(lane, SURE, np.array([1.0, 0.0]), edges)
    assert looked_for == [2, 2]


def test_a_line_says_how_far_it_is_seen():
    edges = edges_of(BENT)
    near = edges.points_cm[:, 1] < 21.0
    asked = BENT.reshape(2, 3), np.full((2, 3), 2.0)
    markings = np.full(2, 3.0), np.full(2, 2.0)
    ended = refine_lines(
        *asked, RoadBorders(RoadEdges(edges.points_cm[near], edges.normals[near])), *markings
    )
    assert ((ended.seen_to_cm >= 20.0) & (ended.seen_to_cm <= 24.0)).all()
    nothing = refine_lines(*asked, RoadBorders(RoadEdges(np.zeros((0, 2)), np.zeros((0, 2)))), *markings)
    assert (nothing.seen_to_cm == -4.0).all()
    assert (refine_lines(*asked, RoadBorders(edges), *markings).seen_to_cm > 38.0).all()


def test_what_passed_out_of_view_beside_the_car_is_recalled():
    lines = np.repeat([-20.0, 20.0], 3)
    # A kink of the tape lies where the image does not reach: the network takes what it sees for straight.
    edges, leaning = edges_of(lines), lines + np.array([6.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    far = RoadEdges(
        edges.points_cm[edges.points_cm[:, 1] > 10.0], edges.normals[edges.points_cm[:, 1] > 10.0]
    )
    off_cm = []
    for before in (0, 5):
        tracker = LaneTracker(LaneMemory(LANE_CM))
        for _ in range(before):
            tracker.follow(lines, SURE, SEEN, edges)
        points_cm, _, _ = tracker.follow(leaning, SURE, SEEN, far)
        off_cm.append(abs(points_cm[0] - lines[0]))
    assert off_cm[1] < 0.8 * off_cm[0]


def test_the_distance_of_two_lines_is_measured_across_the_lane_in_a_corner_as_well():
    rows = np.array([0.0, 15.0, 30.0])
    # Around (60, 0): beside each other, the inner one turns away earlier than a row's width tells.
    left, right = (60.0 - np.sqrt(radius**2 - rows**2) for radius in (90.0, 50.0))
    np.testing.assert_allclose(distances_cm(left[None], right[None]), 40.0, atol=1.0)
    np.testing.assert_allclose(distances_cm(right[None], left[None]), -40.0, atol=1.0)


def with_hues(edges: RoadEdges, yellow: tuple[float, float]) -> RoadEdges:
    """The same edges, on markings that are more or less yellow: the left one, and the right one."""
    share = np.where(edges.points_cm[:, 0] < 0.0, *yellow)
    return RoadEdges(edges.points_cm, edges.normals, np.column_stack([share, 0.0 * share]))


def test_the_looks_of_the_lines_tell_the_lane():
    tracker = LaneTracker(LaneMemory(LANE_CM), keep="right")
    for _ in range(40):
        tracker.follow(BENT, SURE, SEEN, with_hues(edges_of(BENT), (0.8, 0.0)))
    assert tracker.looks.own_lane > 0.95
    tracker.reset()
    for _ in range(40):
        tracker.follow(BENT, SURE, SEEN, with_hues(edges_of(BENT, -3.0), (0.0, -0.8)))
    # Dark markings have normals to the floor, so that a yellow one makes it less yellow along them.
    assert tracker.looks.own_lane < 0.05


@pytest.mark.parametrize(("yellow", "expected_cm"), [(0.8, 0.0), (0.0, -5.0)])
def test_a_marking_of_another_hue_is_not_the_line(yellow, expected_cm):
    tracker = LaneTracker(LaneMemory(LANE_CM))
    for _ in range(12):
        tracker.follow(BENT, SURE, SEEN, with_hues(edges_of(BENT), (yellow, 0.0)))
    # The left line ends ahead, a longer white one is beside it, and the network goes there.
    beside = BENT - np.repeat([5.0, 0.0], 3)
    lane = with_hues(edges_of(BENT), (yellow, 0.0)).rows()
    lane = lane[(lane[:, 0] > 0.0) | (lane[:, 1] < 27.0)]
    white = with_hues(edges_of(beside, sides=(0,)), (0.0, 0.0)).rows()
    points_cm, _, _ = tracker.follow(beside, SURE, SEEN, RoadEdges.of_rows(np.concatenate([lane, white])))
    assert points_cm[0] - BENT[0] == pytest.approx(expected_cm, abs=1.0)


def test_a_width_that_was_learned_wrong_is_unlearned_though_it_speaks_against_the_lane():
    lane = LaneMemory()
    for _ in range(100):
        lane.learn(np.array([-40.0] * 3 + [40.0] * 3), np.ones(2))
    assert lane.width_cm == pytest.approx(80.0, rel=0.02)
    tracker = LaneTracker(lane)
    for _ in range(150):
        tracker.follow(BENT, SURE, SEEN, edges_of(BENT))
    assert lane.width_cm == pytest.approx(LANE_CM, rel=0.04)


def test_a_line_that_the_network_does_not_see_tells_nothing_of_the_lanes_width():
    for presence, known in ((1.0, True), (0.2, False)):
        lane = LaneMemory()
        tracker = LaneTracker(lane)
        for _ in range(20):
            tracker.follow(BENT, SURE, np.array([1.0, presence]), edges_of(BENT))
        assert (lane.width_cm is not None) == known


def test_a_pair_beside_the_car_tells_nothing_of_the_lanes_width():
    for beside_cm, known in ((0.0, True), (40.0, False)):
        lane, lines = LaneMemory(), BENT + beside_cm
        tracker = LaneTracker(lane)
        for _ in range(20):
            tracker.follow(lines, SURE, SEEN, edges_of(lines))
        assert (lane.width_cm is not None) == known
