from __future__ import annotations

import math

import numpy as np
import pytest

from lanenet.onboard.bench import example_camera
from lanenet.perception.edges.road import RoadEdges
from lanenet.perception.estimate import LaneMemory
from lanenet.perception.network.tracking.camera_view import CameraView
from lanenet.perception.network.tracking.straight_on import SeenLines, StraightOn, turns_away_cm
from lanenet.perception.network.tracking.tracker import LaneTracker
from tests.unit.perception.tapes import tape, together

WIDTH_CM, WHEELBASE_CM = 40.0, 17.0
LANE = np.array([[-20.0, -20.0, -20.0], [20.0, 20.0, 20.0]])
#: The right line turns into a side road, and the left one has ended.
SIDE_ROAD = np.array([[-20.0, -18.0, -14.0], [20.0, 24.0, 42.0]])
#: What the network may say of the two lines.
BOTH, RIGHT = (1.0, 1.0), (0.1, 1.0)


def seen(points_cm: np.ndarray, left_cm: float = 30.0, right_cm: float = 30.0) -> SeenLines:
    at = [[length_cm > 0.0] * 3 for length_cm in (left_cm, right_cm)]
    return SeenLines(points_cm.tolist(), [left_cm, right_cm], at)


def at_a_junction(told: bool = True) -> StraightOn:
    lane = StraightOn()
    if told:
        lane.moved(0.0, 0.0, WHEELBASE_CM)
    lane.look(seen(LANE), leaving=None, presence=BOTH, width_cm=WIDTH_CM)
    for _ in range(2):
        assert not lane.on
        lane.look(seen(SIDE_ROAD, left_cm=0.0), leaving=1, presence=RIGHT, width_cm=WIDTH_CM)
    assert lane.on
    return lane


def test_a_lane_is_continued_after_two_frames_in_which_a_line_leaves_it():
    points_cm, sigma_cm = at_a_junction().lane()
    assert points_cm == pytest.approx(LANE) and sigma_cm.max() < 2.0


def test_without_the_cars_motion_its_place_is_unknown():
    assert at_a_junction(told=False).lane()[1].min() > 0.1 * WIDTH_CM


def in_a_lane() -> StraightOn:
    lane = StraightOn()
    lane.moved(0.0, 0.0, WHEELBASE_CM)
    lane.look(seen(LANE), leaving=None, presence=BOTH, width_cm=WIDTH_CM)
    return lane


@pytest.mark.parametrize("left_cm", [12.0, 9.0])
def test_a_bend_in_which_the_other_line_goes_on_is_no_junction(left_cm):
    lane = in_a_lane()
    for _ in range(10):
        lane.look(seen(SIDE_ROAD, left_cm), leaving=1, presence=BOTH, width_cm=WIDTH_CM)
    assert not lane.on


def test_a_line_that_turns_away_for_long_beside_one_that_is_hardly_seen_is_a_junction():
    lane = in_a_lane()
    for frame in range(5):
        assert not lane.on, frame
        lane.look(seen(SIDE_ROAD, 6.0), leaving=1, presence=BOTH, width_cm=WIDTH_CM)
    assert lane.on


def test_a_line_that_was_not_seen_for_long_did_not_end_where_the_other_one_turns():
    lane = in_a_lane()
    for _ in range(8):
        lane.look(seen(LANE, 0.0), leaving=None, presence=BOTH, width_cm=WIDTH_CM)
    for _ in range(8):
        lane.look(seen(SIDE_ROAD, 0.0), leaving=1, presence=BOTH, width_cm=WIDTH_CM)
    assert not lane.on


@pytest.mark.parametrize("between", [1, 5, 6])
def test_that_a_line_turned_away_is_remembered_until_the_other_one_has_ended(between):
    lane = in_a_lane()
    lane.look(seen(SIDE_ROAD, 12.0), leaving=1, presence=BOTH, width_cm=WIDTH_CM)
    for _ in range(between - 1):
        lane.look(seen(SIDE_ROAD, 12.0, 6.0), leaving=None, presence=BOTH, width_cm=WIDTH_CM)
    for _ in range(2):
        lane.look(seen(SIDE_ROAD, 6.0, 6.0), leaving=None, presence=RIGHT, width_cm=WIDTH_CM)
    assert lane.on == (between < 6)
    assert not lane.on or lane.leaving == 1


def test_a_suspicion_outlasts_frames_that_show_nothing_but_not_those_that_show_the_lane():
    for between, on in ((seen(SIDE_ROAD, 0.0, 0.0), True), (seen(LANE), False)):
        lane = in_a_lane()
        lane.look(seen(SIDE_ROAD, 0.0), leaving=1, presence=RIGHT, width_cm=WIDTH_CM)
        lane.look(between, leaving=None, presence=BOTH, width_cm=WIDTH_CM)
        lane.look(seen(SIDE_ROAD, 0.0), leaving=1, presence=RIGHT, width_cm=WIDTH_CM)
        assert lane.on == on


def test_a_lane_that_was_plain_long_ago_is_not_continued():
    lane = StraightOn()
    lane.look(seen(LANE), leaving=None, presence=BOTH, width_cm=WIDTH_CM)
    for _ in range(30):
        lane.look(seen(SIDE_ROAD, left_cm=0.0), leaving=None, presence=BOTH, width_cm=WIDTH_CM)
    for _ in range(5):
        lane.look(seen(SIDE_ROAD, left_cm=0.0), leaving=1, presence=RIGHT, width_cm=WIDTH_CM)
    assert not lane.on


def test_points_of_the_line_that_leaves_are_doubted_at_once():
    lane = StraightOn()
    lane.look(seen(LANE), leaving=None, presence=BOTH, width_cm=WIDTH_CM)
    lane.look(seen(SIDE_ROAD, left_cm=0.0), leaving=1, presence=BOTH, width_cm=WIDTH_CM)
    doubts = lane.doubts(SIDE_ROAD.reshape(6), WIDTH_CM)
    assert doubts.tolist() == [False, False, True, False, True, True]


@pytest.mark.parametrize("turn_rad", [0.0, 0.1, -0.1])
def test_the_lane_moves_with_the_car(turn_rad):
    lane = at_a_junction()
    before_cm = lane.lane()[1]
    lane.moved(5.0, turn_rad, WHEELBASE_CM)
    points_cm, sigma_cm = lane.lane()
    # A car that turns left sees what is ahead move to its right.
    slope = (points_cm[:, 2] - points_cm[:, 0]) / 30.0
    assert slope == pytest.approx(math.tan(turn_rad) * np.ones(2), abs=1e-6)
    assert points_cm[1] - points_cm[0] == pytest.approx(np.full(3, WIDTH_CM / math.cos(turn_rad)), abs=1e-6)
    assert (sigma_cm > before_cm).all()


@pytest.mark.parametrize("motion", [(3.9, math.radians(90 / 24)), (4.0, math.radians(-5.0)), (math.nan, 0.0)])
def test_a_lane_that_the_car_turned_away_from_is_forgotten(motion):
    lane = at_a_junction()
    with np.errstate(invalid="ignore"):
        for _ in range(24):
            lane.moved(*motion, WHEELBASE_CM)
            assert not lane.on or np.abs(lane.lane()[0]).max() < 200.0
    assert not lane.on
    assert lane.doubts(SIDE_ROAD.reshape(6), WIDTH_CM) is None


@pytest.mark.parametrize("travel_cm", [20.0, -5.0])
def test_its_place_is_less_sure_after_driving_on_or_back(travel_cm):
    lane = at_a_junction()
    before_cm = lane.lane()[1]
    lane.moved(travel_cm, 0.0, WHEELBASE_CM)
    assert (lane.lane()[1] > before_cm).all()


def test_its_place_is_as_sure_however_often_its_motion_is_told():
    sigmas_cm = []
    for steps in (1, 20):
        lane = at_a_junction()
        for _ in range(steps):
            lane.moved(40.0 / steps, 0.0, WHEELBASE_CM)
        sigmas_cm.append(lane.lane()[1])
    assert sigmas_cm[0] == pytest.approx(sigmas_cm[1])


def test_a_lane_that_the_car_has_turned_in_is_less_sure_along_the_row():
    straight, turned = at_a_junction(), at_a_junction()
    for _ in range(10):
        straight.moved(4.0, 0.0, WHEELBASE_CM)
        turned.moved(4.0, 0.05, WHEELBASE_CM)
    assert (turned.lane()[1] > 1.05 * straight.lane()[1]).all()


def test_a_lane_that_is_plain_again_is_as_sure_as_at_first():
    lane = in_a_lane()
    lane.moved(40.0, 0.0, WHEELBASE_CM)
    lane.look(seen(LANE), leaving=None, presence=BOTH, width_cm=WIDTH_CM)
    for _ in range(2):
        lane.look(seen(SIDE_ROAD, left_cm=0.0), leaving=1, presence=RIGHT, width_cm=WIDTH_CM)
    assert lane.lane()[1] == pytest.approx(at_a_junction().lane()[1])


def test_a_lane_that_was_plain_half_a_metre_ago_is_not_continued_but_still_tells_what_is_doubtful():
    lanes = in_a_lane(), in_a_lane()
    for lane, travel_cm in zip(lanes, (40.0, 50.0), strict=True):
        lane.moved(travel_cm, 0.0, WHEELBASE_CM)
        for _ in range(2):
            lane.look(seen(SIDE_ROAD, left_cm=0.0), leaving=1, presence=RIGHT, width_cm=WIDTH_CM)
        doubted = lane.doubts(SIDE_ROAD.reshape(6), WIDTH_CM)
        assert doubted is not None and doubted.tolist() == [False, False, True, False, True, True]
    assert [lane.on for lane in lanes] == [True, False]


def test_however_long_a_line_was_suspected_two_plain_frames_clear_it():
    lane = in_a_lane()
    lane.moved(50.0, 0.0, WHEELBASE_CM)
    for _ in range(20):
        lane.look(seen(SIDE_ROAD, left_cm=0.0), leaving=1, presence=RIGHT, width_cm=WIDTH_CM)
    for _ in range(2):
        lane.look(seen(LANE), leaving=None, presence=BOTH, width_cm=WIDTH_CM)
    for _ in range(2):
        assert not lane.on
        lane.look(seen(SIDE_ROAD, left_cm=0.0), leaving=1, presence=RIGHT, width_cm=WIDTH_CM)
    assert lane.on


def ahead(beside_cm: float, *y_cm: float) -> np.ndarray:
    """The middle of a lane that is straight there."""
    return np.stack([np.full(len(y_cm), beside_cm), y_cm], axis=1)


def test_it_turns_to_where_the_lane_is_seen_ahead():
    lane = at_a_junction()
    lane.moved(50.0, 0.0, WHEELBASE_CM)
    before_cm = lane.lane()[1]
    lane.anchor(ahead(8.0, 75.0), WIDTH_CM)
    points_cm, sigma_cm = lane.lane()
    middle_cm = points_cm.mean(axis=0)
    slope = (middle_cm[2] - middle_cm[0]) / 30.0
    assert middle_cm[0] + 75.0 * slope == pytest.approx(8.0, abs=0.5)
    assert 0.0 < middle_cm[0] < 3.0, "beside the car it is where it was, nearly"
    assert points_cm[1] - points_cm[0] == pytest.approx(np.full(3, WIDTH_CM * math.hypot(1.0, slope)))
    assert (sigma_cm < before_cm).all()
    assert (sigma_cm[:, 0] > 0.5 * before_cm[:, 0]).all(), "one point far ahead says little of the place here"


def test_sigma_is_that_of_the_least_squares_fit():
    lane, y_cm = at_a_junction(), np.array([45.0, 60.0, 75.0])
    lane.moved(30.0, 0.0, WHEELBASE_CM)
    way = np.array([[1.0, 30.0], [0.0, 1.0]])
    bends = 0.0107**2 * np.array([[30.0**3 / 3.0, 30.0**2 / 2.0], [30.0**2 / 2.0, 30.0]])
    before = way @ np.diag([0.57**2, 0.01**2]) @ way.T + bends + np.diag([0.0, 0.1**2])
    lane.anchor(ahead(2.0, *y_cm), WIDTH_CM)
    seen_at = np.column_stack([np.ones(3), y_cm])
    after = np.linalg.inv(np.linalg.inv(before) + seen_at.T @ seen_at)
    rows = np.column_stack([np.ones(3), [0.0, 15.0, 30.0]])
    expected_cm = np.sqrt(np.diag(rows @ after @ rows.T) + 1.5**2)
    assert lane.lane()[1] == pytest.approx(np.tile(expected_cm, (2, 1)))


def test_a_lane_that_is_seen_ahead_is_continued_no_further_than_another():
    lane = at_a_junction()
    for _ in range(9):
        lane.moved(20.0, 0.0, WHEELBASE_CM)
        lane.anchor(ahead(0.0, 45.0, 60.0), WIDTH_CM)
    lane.look_for_its_end(seen(SIDE_ROAD, left_cm=0.0), found=False, width_cm=WIDTH_CM)
    assert not lane.on


def test_the_more_of_it_is_seen_ahead_the_less_counts_the_way_to_there():
    beside_cm = []
    for y_cm in ([75.0], [45.0, 60.0, 75.0]):
        lane = at_a_junction()
        lane.moved(80.0, 0.0, WHEELBASE_CM)
        lane.anchor(ahead(8.0, *y_cm), WIDTH_CM)
        beside_cm.append(lane.lane()[0].mean(axis=0)[0])
    assert 0.0 < beside_cm[0] < 4.0 < beside_cm[1] < 8.0


def test_a_lane_that_leads_to_another_place_beside_the_car_is_another_one():
    lane = at_a_junction()
    lane.moved(50.0, 0.0, WHEELBASE_CM)
    before_cm, before_sigma_cm = lane.lane()
    lane.anchor(ahead(15.0, 45.0, 60.0, 75.0), WIDTH_CM)
    assert lane.lane()[0] == pytest.approx(before_cm) and lane.lane()[1] == pytest.approx(before_sigma_cm)


def test_a_car_that_stands_learns_nothing_from_seeing_it_again():
    lane = at_a_junction()
    lane.moved(60.0, 0.0, WHEELBASE_CM)
    lane.anchor(ahead(4.0, 45.0, 60.0, 75.0), WIDTH_CM)
    before_cm, before_sigma_cm = lane.lane()
    lane.moved(0.5, 0.0, WHEELBASE_CM)
    lane.anchor(ahead(4.0, 45.0, 60.0, 75.0), WIDTH_CM)
    assert lane.lane()[0] == pytest.approx(before_cm, abs=0.1)
    assert (lane.lane()[1] > 0.99 * before_sigma_cm).all()


def test_a_lane_is_forgotten_by_a_reset():
    lane = at_a_junction()
    lane.reset()
    assert not lane.on and not lane.told
    for _ in range(3):
        lane.look(seen(SIDE_ROAD, left_cm=0.0), leaving=1, presence=RIGHT, width_cm=WIDTH_CM)
    assert not lane.on


def test_it_ends_when_one_line_is_where_it_is_expected():
    lane = at_a_junction()
    lane.look_for_its_end(seen(SIDE_ROAD, left_cm=0.0), found=False, width_cm=WIDTH_CM)
    assert lane.on
    lane.look_for_its_end(seen(LANE + 1.0, left_cm=0.0), found=False, width_cm=WIDTH_CM)
    assert not lane.on


def test_it_ends_when_a_lane_is_seen_beside():
    lane = at_a_junction()
    lane.look_for_its_end(seen(LANE + 30.0), found=False, width_cm=WIDTH_CM)
    assert lane.on
    lane.look_for_its_end(seen(LANE + 8.0), found=False, width_cm=WIDTH_CM)
    assert not lane.on


def test_it_ends_after_two_metres():
    lane = at_a_junction()
    lane.moved(200.0, 0.0, WHEELBASE_CM)
    lane.look_for_its_end(seen(SIDE_ROAD, left_cm=0.0), found=False, width_cm=WIDTH_CM)
    assert not lane.on


def test_away_is_outwards_on_both_sides():
    assert turns_away_cm([0.0, 1.0, 5.0], 1) == pytest.approx(3.0)
    assert turns_away_cm([0.0, -1.0, -5.0], 0) == pytest.approx(3.0)


def borders_of(lines_cm: dict[int, np.ndarray]) -> RoadEdges:
    """Borders of white tape 3 cm wide, along x(y)."""
    y = np.arange(-4.0, 42.0, 0.5)
    points, normals = [], []
    for line_cm in lines_cm.values():
        x = np.interp(y, np.arange(-5.0, 46.0, 1.0), line_cm)
        slope = np.gradient(x, y)
        right = np.stack([np.ones_like(y), -slope], axis=1) / np.hypot(1.0, slope)[:, None]
        for border in (-0.5, 0.5):
            points.append(np.stack([x, y], axis=1) + 3.0 * border * right)
            normals.append(-2.0 * border * right)
    return RoadEdges(np.concatenate(points), np.concatenate(normals))


def beyond_a_junction(beside_cm: float) -> RoadEdges:
    """Borders of a lane from 50 to 90 cm ahead."""
    return together(
        *(tape(np.array([[x, 50.0], [x, 90.0]]), 3.0) for x in (beside_cm - 20.0, beside_cm + 20.0))
    )


def with_a_speck(edges: RoadEdges) -> RoadEdges:
    """Add a reflection like a piece of tape that leans to the right, where the left line has ended."""
    y = np.arange(14.0, 31.0, 0.5)
    x = -13.0 + 0.2 * (y - 14.0)
    points = [np.stack([x + 1.5 * side, y], axis=1) for side in (-1.0, 1.0)]
    normals = [np.tile([-side, 0.0], (len(y), 1)) for side in (-1.0, 1.0)]
    return RoadEdges(np.concatenate([edges.points_cm, *points]), np.concatenate([edges.normals, *normals]))


def drive_into_a_side_road(
    goes_on: bool,
    speck: bool = False,
    other_border: bool = False,
    straight_border: bool = False,
    mirrored: bool = False,
    told: bool = True,
    plain_frames: int = 12,
) -> tuple[LaneTracker, np.ndarray]:
    """The right line turns away 20 cm ahead; the left one goes on in parallel, or has ended.

    The road's other border, beyond a second lane to the left, may go on in parallel as well. Mirrored, the
    left line turns away. Before, the lane is plain for some frames.
    """
    tracker = LaneTracker(LaneMemory(WIDTH_CM), view=CameraView(example_camera()))
    y = np.arange(-5.0, 46.0, 1.0)
    straight = borders_of({0: np.full_like(y, -20.0), 1: np.full_like(y, 20.0)})
    sigma_cm, certain = np.full(6, 0.8), np.ones(2)
    for _ in range(plain_frames):
        if told:
            tracker.moved(3.0, 0.0, WHEELBASE_CM)
        tracker.follow(LANE.reshape(6), sigma_cm, certain, straight)
    radius_cm, found_cm = 45.0, np.empty(6)
    for step in range(6):
        if told:
            tracker.moved(3.0, 0.0, WHEELBASE_CM)
        ahead = np.maximum(y - 18.0 + 3.0 * step, 0.0)

        def bend(radius_cm: float, ahead: np.ndarray = ahead) -> np.ndarray:
            return radius_cm - np.sqrt(
                np.maximum(radius_cm**2 - np.minimum(ahead, 0.9 * radius_cm) ** 2, 0.0)
            )

        right = 20.0 + bend(radius_cm - 20.0)
        lines = {1: right} | ({0: -20.0 + bend(radius_cm + 20.0)} if goes_on else {})
        lines |= {2: -60.0 + bend(radius_cm + 60.0)} if other_border else {}
        lines |= {2: np.full_like(y, -60.0)} if straight_border else {}
        guess = np.concatenate(
            [np.interp([0, 15, 30], y, -20.0 + bend(radius_cm + 20.0)), np.interp([0, 15, 30], y, right)]
        )
        presence = np.array([1.0 if goes_on else 0.1, 1.0])
        edges = with_a_speck(borders_of(lines)) if speck else borders_of(lines)
        if mirrored:
            guess, presence = -guess.reshape(2, 3)[::-1].reshape(6), presence[::-1].copy()
            edges = RoadEdges(edges.points_cm * [-1.0, 1.0], edges.normals * [-1.0, 1.0])
        found_cm = tracker.follow(guess, sigma_cm, presence, edges)[0]
    return tracker, found_cm


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("speck", [False, True])
def test_the_tracker_goes_straight_on_where_one_line_leaves_and_the_other_has_ended(speck, mirrored):
    tracker, found_cm = drive_into_a_side_road(goes_on=False, speck=speck, mirrored=mirrored)
    assert tracker.straight_on.on
    assert found_cm == pytest.approx(LANE.reshape(6), abs=1.0)


def test_the_tracker_goes_to_where_it_sees_the_lane_beyond_a_junction():
    tracker, found_cm = drive_into_a_side_road(goes_on=False)
    before_cm = found_cm.reshape(2, 3).mean(axis=0)
    for _ in range(4):
        tracker.moved(3.0, 0.0, WHEELBASE_CM)
        found_cm = tracker.follow(LANE.reshape(6), np.full(6, 5.0), np.zeros(2), beyond_a_junction(10.0))[0]
    after_cm = found_cm.reshape(2, 3).mean(axis=0)
    assert tracker.straight_on.on and before_cm == pytest.approx(np.zeros(3), abs=1.0)
    assert after_cm[2] > 4.0 and after_cm[0] + 2.0 * (after_cm[2] - after_cm[0]) == pytest.approx(
        10.0, abs=1.5
    )


@pytest.mark.parametrize(("told", "plain_frames"), [(False, 12), (True, 4)])
def test_without_the_cars_motion_or_what_markings_look_like_the_tracker_does_not_look_beyond(
    told, plain_frames
):
    tracker, _ = drive_into_a_side_road(goes_on=False, told=told, plain_frames=plain_frames)
    assert tracker.straight_on.on and tracker.straight_on.told == told
    tracker.follow(LANE.reshape(6), np.full(6, 5.0), np.zeros(2), beyond_a_junction(10.0))
    assert tracker.straight_on.on
    assert tracker.straight_on.lane()[0] == pytest.approx(LANE, abs=1.0)


@pytest.mark.parametrize("mirrored", [False, True])
def test_the_tracker_follows_a_bend_of_which_it_sees_the_roads_other_border(mirrored):
    tracker, _ = drive_into_a_side_road(goes_on=False, other_border=True, mirrored=mirrored)
    assert not tracker.straight_on.on


@pytest.mark.parametrize("mirrored", [False, True])
def test_the_roads_other_border_that_goes_straight_on_proves_no_bend(mirrored):
    tracker, _ = drive_into_a_side_road(goes_on=False, straight_border=True, mirrored=mirrored)
    assert tracker.straight_on.on


def test_a_turn_is_forgotten_with_its_junction():
    lane = in_a_lane()
    for _ in range(5):
        lane.look(seen(SIDE_ROAD, 6.0), leaving=1, presence=BOTH, width_cm=WIDTH_CM)
    assert lane.on
    lane.look_for_its_end(seen(SIDE_ROAD, 6.0), found=True, width_cm=WIDTH_CM)
    lane.look(seen(LANE), leaving=None, presence=BOTH, width_cm=WIDTH_CM)
    for _ in range(3):
        lane.look(seen(LANE, 6.0), leaving=None, presence=BOTH, width_cm=WIDTH_CM)
    assert not lane.on


@pytest.mark.parametrize("mirrored", [False, True])
def test_the_tracker_follows_a_bend(mirrored):
    tracker, found_cm = drive_into_a_side_road(goes_on=True, mirrored=mirrored)
    assert not tracker.straight_on.on
    assert np.abs(found_cm[[1, 4]]).max() > 22.0


def test_a_speck_beside_a_line_that_turns_away_is_not_the_lanes_other_line():
    lane = StraightOn()
    speck = [-17.0, -11.0, -8.0]
    assert not lane.is_a_speck(speck, 10.0, 0, WIDTH_CM), "no lane is known yet"
    lane.look(seen(LANE), leaving=None, presence=BOTH, width_cm=WIDTH_CM)
    assert lane.is_a_speck(speck, 10.0, 0, WIDTH_CM)
    assert not lane.is_a_speck(speck, 25.0, 0, WIDTH_CM), "as long as a line"
    assert not lane.is_a_speck([-19.0, -18.0, -16.0], 10.0, 0, WIDTH_CM), "where the line would be"
