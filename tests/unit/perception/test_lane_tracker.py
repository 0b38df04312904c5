"""Lines of a network on the edge points of their markings, and from frame to frame."""

from __future__ import annotations

import numpy as np
import pytest
from tapes import together

from lanenet.geometry.lane import parabolas_from_points
from lanenet.perception.edges.road import RoadEdges
from lanenet.perception.estimate import LaneMemory
from lanenet.perception.network.lane.filter import LaneFilter
from lanenet.perception.network.lane.looks import Keep
from lanenet.perception.network.lane.network_answer import NetworkAnswer
from lanenet.perception.network.lane.view import LinesInView
from lanenet.perception.network.refinement import RoadBorders, refine_lines

LANE_CM = 40.0
BENT = np.array([-20.0, -19.0, -16.0, 20.0, 21.0, 24.0])
SURE, SEEN = np.full(6, 0.8), np.ones(2)


PLACES_CM = np.linspace(-70.0, 70.0, 64)


class LaneTracker:
    """The lane filter behind a network without probabilities of places; nobody tells how the car moves."""

    def __init__(self, lane: LaneMemory, keep: Keep | None = None) -> None:
        self.filter = LaneFilter(lane, LinesInView(None), keep)
        self.looks, self.reset, self.lose = self.filter.looks, self.filter.reset, self.filter.lose

    def follow(
        self, points_cm: np.ndarray, sigma_cm: np.ndarray, presence: np.ndarray, edges: RoadEdges
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return points, sigmas and lengths seen."""
        answer = NetworkAnswer.of_one_mode(points_cm, sigma_cm, presence, PLACES_CM)
        found = self.filter.follow(answer, edges)
        self.reason = found.reason
        return found[:3]


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
    # The network is 1.5 cm off in every frame, and counts.
    np.testing.assert_allclose(points_cm, BENT, atol=0.6)
    assert (seen_cm > 30.0).all() and (sigma_cm < 1.0).all()


def test_a_marking_that_was_learned_wrong_is_unlearned():
    """A dark tape of 6 cm of which glare showed the near border only, as a light strip of 1 cm."""
    tracker = LaneTracker(LaneMemory(LANE_CM))
    glare = BENT + np.array([2.5] * 3 + [-2.5] * 3)
    for _ in range(12):
        tracker.follow(glare, SURE, SEEN, edges_of(glare, 1.0))
    for _ in range(60):
        points_cm, _, _ = tracker.follow(BENT + 0.5, SURE, SEEN, edges_of(BENT, -6.0))
    np.testing.assert_allclose(points_cm, BENT, atol=0.4)


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
    np.testing.assert_allclose(points_cm, BENT + 2.0, atol=0.5)
    # Nothing is kept beyond a reset.
    tracker.reset()
    points_cm, _, _ = tracker.follow(next_lane, SURE, doubtful, edges_of(BENT + 1.0))
    np.testing.assert_allclose(points_cm[:3], BENT[3:] + 1.0, atol=0.4)


def test_one_line_that_is_seen_tells_where_the_other_one_is():
    tracker = LaneTracker(LaneMemory(LANE_CM))
    straight = np.array([-20.0] * 3 + [20.0] * 3)
    unsure = np.concatenate([SURE[:3], np.full(3, 4.0)])
    guess = straight + np.array([1.0] * 3 + [2.0] * 3)
    points_cm, sigma_cm, seen_cm = tracker.follow(guess, unsure, SEEN, edges_of(straight, sides=(0,)))
    np.testing.assert_allclose(points_cm, straight, atol=0.8)
    # The network says something else: that counts.
    assert seen_cm[1] == 0.0 and sigma_cm[3:].min() > 2.0 * sigma_cm[:3].max()


def sigma_15_cm_ahead(off_cm: float) -> float:
    """That of the left line, where the network's own answer lies so far beside it."""
    straight = np.array([-20.0] * 3 + [20.0] * 3)
    tracker = LaneTracker(LaneMemory(LANE_CM))
    points_cm, sigma_cm, _ = tracker.follow(straight + off_cm, SURE, SEEN, edges_of(straight))
    np.testing.assert_allclose(points_cm, straight, atol=0.6)
    return float(sigma_cm[1])


def test_sigma_tells_how_far_the_line_is_from_the_networks_own():
    none_cm, near_cm, far_cm = (sigma_15_cm_ahead(off_cm) for off_cm in (0.0, 1.0, 2.0))
    assert none_cm < 0.4 and none_cm < near_cm < far_cm


def crossing(painted: bool) -> tuple[LaneTracker, np.ndarray, RoadEdges]:
    """Drive 10 cm over the left line, while the network stays with the lane that is left."""
    tracker = LaneTracker(LaneMemory(LANE_CM))
    lines = np.repeat([-60.0, -20.0, 20.0], 3)
    for shift_cm in np.arange(0.0, 31.0, 3.0):
        moved = lines + shift_cm
        edges = edges_of(moved[3:])
        if painted:
            edges = together(edges, edges_of(moved[:6], sides=(0,)))
        points_cm, _, _ = tracker.follow(moved[3:] + 0.3, SURE, SEEN, edges)
        if shift_cm <= 12.0:
            np.testing.assert_allclose(points_cm, moved[3:], atol=1.0)
    # The axle is in a lane that the network does not answer.
    assert np.isnan(points_cm).all() and tracker.reason
    return tracker, moved, edges


def test_a_car_that_crosses_a_line_is_in_the_next_lane_once_the_network_says_so():
    tracker, moved, edges = crossing(painted=True)
    for _ in range(6):
        points_cm, _, _ = tracker.follow(moved[:6], SURE, SEEN, edges)
    np.testing.assert_allclose(points_cm, moved[:6], atol=0.6)
    assert tracker.looks.own_lane != tracker.looks.own_lane  # no side to keep to: not known


def test_a_car_that_comes_back_from_bare_floor_is_in_the_lane_that_it_left():
    tracker = crossing(painted=False)[0]
    for line_cm in (4.0, 0.0, -4.0, *[-8.0] * 6):
        lane = np.repeat([line_cm, line_cm + LANE_CM], 3)
        points_cm, _, _ = tracker.follow(lane, SURE, SEEN, edges_of(lane))
    np.testing.assert_allclose(points_cm, lane, atol=0.6)


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


def test_two_lanes_for_which_equally_much_speaks_are_none():
    """A single line under the car, and a network that sees a lane on either side of it."""
    line = edges_of(np.repeat([1.0, 1.0], 3), sides=(0,))
    sides = [
        NetworkAnswer.of_one_mode(np.repeat(lane, 3), SURE, SEEN, PLACES_CM)
        for lane in ([1.0 - LANE_CM, 1.0], [1.0, 1.0 + LANE_CM])
    ]
    log_share = np.logaddexp(*(side.log_share for side in sides)) - np.log(2.0)
    share = np.exp(log_share)
    mean_cm = share @ PLACES_CM
    sigma_cm = np.sqrt((share * (PLACES_CM - mean_cm[:, None]) ** 2).sum(axis=1))
    tracker = LaneFilter(LaneMemory(LANE_CM), LinesInView(None))
    for _ in range(6):
        found = tracker.follow(NetworkAnswer(mean_cm, sigma_cm, SEEN, log_share, PLACES_CM), line)
        assert np.isnan(found.points_cm).all() and found.reason


def test_the_lane_that_a_car_may_have_left_is_not_answered_as_another_one():
    tracker = LaneTracker(LaneMemory(LANE_CM))
    for line_cm in (8.0, 4.0, 0.9):
        lane = np.repeat([line_cm - LANE_CM, line_cm], 3)
        points_cm, _, _ = tracker.follow(lane, SURE, SEEN, edges_of(lane))
    np.testing.assert_allclose(points_cm, lane, atol=1.0)
    # Beyond its outer line is bare floor. The network takes that for a lane.
    for line_cm in (-6.0, -11.0):
        lane = np.repeat([line_cm - LANE_CM, line_cm], 3)
        edges = edges_of(lane)
        # The lane's left line passes out of view.
        shown = edges.rows()[(edges.points_cm[:, 0] > line_cm - 10.0) | (edges.points_cm[:, 1] < 20.0)]
        takes = lane + LANE_CM
        points_cm, _, _ = tracker.follow(takes, SURE, np.array([1.0, 0.4]), RoadEdges.of_rows(shown))
        assert np.isnan(points_cm).all()
    for line_cm in (-6.0, 4.0, *[8.0] * 5):
        lane = np.repeat([line_cm - LANE_CM, line_cm], 3)
        points_cm, _, _ = tracker.follow(lane, SURE, SEEN, edges_of(lane))
    np.testing.assert_allclose(points_cm, lane, atol=1.0)


def test_a_line_that_the_network_has_elsewhere_is_not_answered():
    tracker = LaneTracker(LaneMemory(LANE_CM))
    for _ in range(3):
        tracker.follow(BENT, SURE, SEEN, edges_of(BENT))
    # The left line is found again where it was; the network has it 8 cm beside it, where nothing is.
    elsewhere = BENT + np.repeat([8.0, 0.0], 3)
    points_cm, _, _ = tracker.follow(elsewhere, SURE, SEEN, edges_of(BENT))
    assert np.isnan(points_cm[:3]).all()
    np.testing.assert_allclose(points_cm[3:], BENT[3:], atol=0.2)


def test_where_a_line_is_not_seen_its_place_is_less_known():
    tracker, edges = LaneTracker(LaneMemory(LANE_CM)), edges_of(BENT)
    for _ in range(12):
        _, all_seen_cm, _ = tracker.follow(BENT, SURE, SEEN, edges)
    # The left one ends 21 cm ahead, then both.
    ended = edges.rows()[(edges.points_cm[:, 1] < 21.0) | (edges.points_cm[:, 0] > 0.0)]
    _, sigma_cm, _ = tracker.follow(BENT, SURE, SEEN, RoadEdges.of_rows(ended))
    assert sigma_cm[2] > 1.4 * all_seen_cm[2]
    _, both_cm, _ = tracker.follow(
        BENT, SURE, SEEN, RoadEdges.of_rows(edges.rows()[edges.points_cm[:, 1] < 21.0])
    )
    assert (both_cm > sigma_cm).all()


@pytest.mark.parametrize("turn_rad", [0.0, 0.03, -0.1, np.nan])
def test_a_lane_that_was_lost_for_long_is_found_again(turn_rad):
    lane = np.repeat([-20.0, 20.0], 3)
    tracker = LaneTracker(LaneMemory(LANE_CM))
    tracker.follow(lane, SURE, SEEN, edges_of(lane))
    for _ in range(1500):
        tracker.filter.moved(3.0, turn_rad, 17.0)
        tracker.lose()
    for _ in range(3):
        points_cm, _, _ = tracker.follow(lane, SURE, SEEN, edges_of(lane))
    np.testing.assert_allclose(points_cm, lane, atol=0.5)


def test_a_width_that_is_known_holds_against_a_network_that_does_not_see_the_line():
    lane, takes = np.repeat([-20.0, 20.0], 3), np.array([-20.0] * 3 + [26.0] * 3)
    tracker, sigma_cm = LaneTracker(LaneMemory(LANE_CM)), np.array([0.8] * 3 + [4.0] * 3)
    for _ in range(60):
        tracker.filter.moved(3.0, 0.0, 17.0)
        points_cm, _, _ = tracker.follow(takes, sigma_cm, np.array([1.0, 0.1]), edges_of(lane, sides=(0,)))
    assert np.isnan(points_cm[3:]).all() or np.abs(points_cm - lane).max() < 3.0


def test_a_line_that_neither_network_nor_edges_show_is_not_answered():
    lane = np.repeat([-20.0, 20.0], 3)
    beside = RoadEdges(np.array([[60.0, 10.0]]), np.array([[1.0, 0.0]]))
    tracker = LaneTracker(LaneMemory(LANE_CM))
    points_cm, _, _ = tracker.follow(lane, SURE, 0.02 * SEEN, beside)
    assert np.isnan(points_cm).all() and tracker.reason == "no line is seen"


def test_lines_that_a_car_nears_while_it_sees_nothing_do_not_change_sides():
    tracker = LaneTracker(LaneMemory(LANE_CM), keep="right")
    lane = np.repeat([-7.0, 33.0], 3)
    yellow = (0.8, 0.0)
    for _ in range(40):
        tracker.filter.moved(3.0, 0.0, 17.0)
        tracker.follow(lane, SURE, SEEN, with_hues(edges_of(lane), yellow))
    assert tracker.looks.own_lane > 0.9
    # 1.3 cm a frame to the right, unseen, at a slope of 0.26.
    turn_rad = 0.26
    tracker.filter.moved(0.0, -turn_rad, 17.0)
    for _ in range(20):
        tracker.lose()
        tracker.filter.moved(5.0, 0.0, 17.0)
    tracker.filter.moved(0.0, turn_rad, 17.0)
    now = np.repeat([-33.0, 7.0], 3)
    for _ in range(6):
        tracker.follow(now, SURE, SEEN, with_hues(edges_of(now), yellow))
    assert tracker.looks.own_lane > 0.8


@pytest.mark.parametrize("side", [0, 1])
def test_a_lane_is_found_again_by_one_line(side):
    lane = np.repeat([-20.0, 20.0], 3)
    tracker = LaneTracker(LaneMemory(LANE_CM))
    tracker.follow(lane, SURE, SEEN, edges_of(lane))
    for _ in range(3):
        tracker.lose()
    presence = np.array([float(side == 0), float(side == 1)])
    points_cm, sigma_cm, seen_cm = tracker.follow(lane, SURE, presence, edges_of(lane, sides=(side,)))
    np.testing.assert_allclose(points_cm, lane, atol=1.0)
    assert (
        seen_cm[1 - side] == 0.0
        and sigma_cm.reshape(2, 3)[1 - side].min() > sigma_cm.reshape(2, 3)[side].max()
    )


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
    far = RoadEdges.of_rows(edges.rows()[edges.points_cm[:, 1] > 10.0])
    off_cm = []
    for before in (0, 5):
        tracker = LaneTracker(LaneMemory(LANE_CM))
        for _ in range(before):
            tracker.follow(lines, SURE, SEEN, edges)
        tracker.filter.moved(3.0, 0.0, 17.0)
        points_cm, _, _ = tracker.follow(leaning, SURE, SEEN, far)
        off_cm.append(abs(points_cm[0] - lines[0]))
    assert off_cm[1] < 0.8 * off_cm[0]


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
