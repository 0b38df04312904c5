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

WIDTH_CM, WHEELBASE_CM = 40.0, 17.0
LANE = np.array([[-20.0, -20.0, -20.0], [20.0, 20.0, 20.0]])
#: The right line turns into a side road, and the left one has ended.
SIDE_ROAD = np.array([[-20.0, -18.0, -14.0], [20.0, 24.0, 42.0]])


def seen(points_cm: np.ndarray, left: bool = True) -> SeenLines:
    return SeenLines(points_cm.tolist(), [30.0 * left, 30.0], [[left] * 3, [True] * 3])


def at_a_junction(told: bool = True) -> StraightOn:
    lane = StraightOn()
    if told:
        lane.moved(0.0, 0.0, WHEELBASE_CM)
    lane.look(seen(LANE), leaving=None, ended=False, width_cm=WIDTH_CM)
    for _ in range(2):
        assert not lane.on
        lane.look(seen(SIDE_ROAD, left=False), leaving=1, ended=True, width_cm=WIDTH_CM)
    assert lane.on
    return lane


def test_a_lane_is_continued_after_two_frames_in_which_a_line_leaves_it():
    points_cm, sigma_cm = at_a_junction().lane()
    assert points_cm == pytest.approx(LANE) and sigma_cm.max() < 2.0


def test_without_the_cars_motion_its_place_is_unknown():
    assert at_a_junction(told=False).lane()[1].min() > 0.1 * WIDTH_CM


def test_a_bend_in_which_the_other_line_goes_on_is_no_junction():
    lane = StraightOn()
    lane.look(seen(LANE), leaving=None, ended=False, width_cm=WIDTH_CM)
    for _ in range(10):
        lane.look(seen(SIDE_ROAD, left=False), leaving=1, ended=False, width_cm=WIDTH_CM)
    assert not lane.on


def test_a_lane_that_was_plain_long_ago_is_not_continued():
    lane = StraightOn()
    lane.look(seen(LANE), leaving=None, ended=False, width_cm=WIDTH_CM)
    for _ in range(30):
        lane.look(seen(SIDE_ROAD, left=False), leaving=None, ended=False, width_cm=WIDTH_CM)
    for _ in range(5):
        lane.look(seen(SIDE_ROAD, left=False), leaving=1, ended=True, width_cm=WIDTH_CM)
    assert not lane.on


def test_points_of_the_line_that_leaves_are_doubted_at_once():
    lane = StraightOn()
    lane.look(seen(LANE), leaving=None, ended=False, width_cm=WIDTH_CM)
    lane.look(seen(SIDE_ROAD, left=False), leaving=1, ended=False, width_cm=WIDTH_CM)
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


def test_its_place_is_less_sure_after_reversing():
    lane = at_a_junction()
    before_cm = lane.lane()[1]
    lane.moved(-5.0, 0.0, WHEELBASE_CM)
    assert (lane.lane()[1] > before_cm).all()


def test_it_ends_when_one_line_is_where_it_is_expected():
    lane = at_a_junction()
    lane.look_for_its_end(seen(SIDE_ROAD, left=False), found=False, width_cm=WIDTH_CM)
    assert lane.on
    lane.look_for_its_end(seen(LANE + 1.0, left=False), found=False, width_cm=WIDTH_CM)
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
    lane.look_for_its_end(seen(SIDE_ROAD, left=False), found=False, width_cm=WIDTH_CM)
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


def with_a_speck(edges: RoadEdges) -> RoadEdges:
    """Add a reflection like a piece of tape that leans to the right, where the left line has ended."""
    y = np.arange(14.0, 31.0, 0.5)
    x = -13.0 + 0.2 * (y - 14.0)
    points = [np.stack([x + 1.5 * side, y], axis=1) for side in (-1.0, 1.0)]
    normals = [np.tile([-side, 0.0], (len(y), 1)) for side in (-1.0, 1.0)]
    return RoadEdges(np.concatenate([edges.points_cm, *points]), np.concatenate([edges.normals, *normals]))


def drive_into_a_side_road(goes_on: bool, speck: bool = False) -> tuple[LaneTracker, np.ndarray]:
    """The right line turns away 20 cm ahead; the left one goes on in parallel, or has ended."""
    tracker = LaneTracker(LaneMemory(WIDTH_CM), view=CameraView(example_camera()))
    y = np.arange(-5.0, 46.0, 1.0)
    straight = borders_of({0: np.full_like(y, -20.0), 1: np.full_like(y, 20.0)})
    sigma_cm, certain = np.full(6, 0.8), np.ones(2)
    for _ in range(4):
        tracker.straight_on.moved(3.0, 0.0, WHEELBASE_CM)
        tracker.follow(LANE.reshape(6), sigma_cm, certain, straight)
    radius_cm, found_cm = 45.0, np.empty(6)
    for step in range(6):
        tracker.straight_on.moved(3.0, 0.0, WHEELBASE_CM)
        ahead = np.maximum(y - 18.0 + 3.0 * step, 0.0)

        def bend(radius_cm: float, ahead: np.ndarray = ahead) -> np.ndarray:
            return radius_cm - np.sqrt(
                np.maximum(radius_cm**2 - np.minimum(ahead, 0.9 * radius_cm) ** 2, 0.0)
            )

        right = 20.0 + bend(radius_cm - 20.0)
        lines = {1: right} | ({0: -20.0 + bend(radius_cm + 20.0)} if goes_on else {})
        guess = np.concatenate(
            [np.interp([0, 15, 30], y, -20.0 + bend(radius_cm + 20.0)), np.interp([0, 15, 30], y, right)]
        )
        presence = np.array([1.0 if goes_on else 0.1, 1.0])
        edges = with_a_speck(borders_of(lines)) if speck else borders_of(lines)
        found_cm = tracker.follow(guess, sigma_cm, presence, edges)[0]
    return tracker, found_cm


@pytest.mark.parametrize("speck", [False, True])
def test_the_tracker_goes_straight_on_where_one_line_leaves_and_the_other_has_ended(speck):
    tracker, found_cm = drive_into_a_side_road(goes_on=False, speck=speck)
    assert tracker.straight_on.on
    assert found_cm == pytest.approx(LANE.reshape(6), abs=1.0)


def test_the_tracker_follows_a_bend():
    tracker, found_cm = drive_into_a_side_road(goes_on=True)
    assert not tracker.straight_on.on
    assert found_cm[4] > 22.0


def test_a_speck_beside_a_line_that_turns_away_is_not_the_lanes_other_line():
    lane = StraightOn()
    speck = [-17.0, -11.0, -8.0]
    assert not lane.is_a_speck(speck, 10.0, 0, WIDTH_CM), "no lane is known yet"
    lane.look(seen(LANE), leaving=None, ended=False, width_cm=WIDTH_CM)
    assert lane.is_a_speck(speck, 10.0, 0, WIDTH_CM)
    assert not lane.is_a_speck(speck, 25.0, 0, WIDTH_CM), "as long as a line"
    assert not lane.is_a_speck([-19.0, -18.0, -16.0], 10.0, 0, WIDTH_CM), "where the line would be"
