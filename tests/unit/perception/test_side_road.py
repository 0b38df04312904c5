from __future__ import annotations

import math

import numpy as np
import pytest

from lanenet.onboard.bench import example_camera
from lanenet.perception.edges.road import RoadEdges
from lanenet.perception.estimate import LaneMemory
from lanenet.perception.network.tracking.camera_view import CameraView
from lanenet.perception.network.tracking.side_road import SideRoad, SideRoadAhead, find_side_road
from lanenet.perception.network.tracking.tracker import LaneTracker
from tests.unit.perception.tapes import tape, together

WIDTH_CM, WHEELBASE_CM, MARKINGS_CM = 40.0, 17.0, (3.0, 3.0)
LANE = np.array([[-20.0, -20.0, -20.0], [20.0, 20.0, 20.0]])
VIEW = CameraView(example_camera())


def turning(
    radius_cm: float,
    at_cm: float = 45.0,
    turn_deg: float = 90.0,
    begin_cm: float = -10.0,
    on_cm: float = 60.0,
) -> np.ndarray:
    """The right line, which turns off on a curve; without it, it would turn at that place."""
    turn = math.radians(turn_deg)
    begins_cm = at_cm - radius_cm * math.tan(0.5 * turn)
    angle = np.linspace(0.0, turn, 30)
    arc = np.stack([20.0 + radius_cm * (1.0 - np.cos(angle)), begins_cm + radius_cm * np.sin(angle)], axis=1)
    if radius_cm == 0.0:
        arc = arc[:1]
    return np.vstack([[20.0, begin_cm], arc, arc[-1] + on_cm * np.array([math.sin(turn), math.cos(turn)])])


def line(x_cm: float, begin_cm: float, end_cm: float) -> np.ndarray:
    return np.array([[x_cm, begin_cm], [x_cm, end_cm]])


def edges_of(*lines_cm: np.ndarray, marking_cm: float = 3.0) -> RoadEdges:
    """The borders of their tapes, as far as a car sees them."""
    edges = together(*(tape(line_cm, marking_cm) for line_cm in lines_cm))
    x, y = edges.points_cm.T
    seen = (y > -4.0) & (y < 95.0) & (np.abs(x) < 70.0)
    return RoadEdges(edges.points_cm[seen], edges.normals[seen])


LEFT_ENDS = line(-20.0, -10.0, 40.0)


def found_in(edges: RoadEdges, markings_cm: tuple[float, float] = MARKINGS_CM) -> SideRoad | None:
    return find_side_road(LANE, WIDTH_CM, markings_cm, edges, VIEW)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(
    ("at_cm", "turn_deg", "radius_cm"),
    [
        (30.0, 90.0, 8.0),
        (30.0, 90.0, 20.0),
        (45.0, 80.0, 15.0),
        (45.0, 90.0, 11.0),
        (45.0, 90.0, 15.0),
        (45.0, 100.0, 15.0),
        (48.0, 90.0, 20.0),
    ],
)
def test_a_line_that_turns_off_on_a_small_curve_is_a_side_road(at_cm, turn_deg, radius_cm, dtype):
    edges = edges_of(turning(radius_cm, at_cm, turn_deg), LEFT_ENDS)
    found = found_in(RoadEdges(edges.points_cm.astype(dtype), edges.normals.astype(dtype)))
    assert found is not None and found.side == 1 and found.ahead_cm == pytest.approx(at_cm, abs=3.0)


def test_a_side_road_on_the_left_is_the_mirrored_one():
    edges = edges_of(turning(14.0), LEFT_ENDS)
    found = found_in(RoadEdges(edges.points_cm * [-1.0, 1.0], edges.normals * [-1.0, 1.0]))
    assert found is not None and found.side == 0 and found.ahead_cm == pytest.approx(45.0, abs=3.0)


def test_dark_tape_turns_off_as_well():
    found = found_in(edges_of(turning(14.0), LEFT_ENDS, marking_cm=-3.0), markings_cm=(-3.0, -3.0))
    assert found is not None and found.side == 1


def test_of_two_side_roads_the_nearer_one_is_found():
    left = turning(14.0, at_cm=35.0) * [-1.0, 1.0]
    assert found_in(edges_of(turning(14.0, at_cm=46.0), left)) == pytest.approx(SideRoad(0, 35.0), abs=3.0)


def bend(inner_cm: float, width_cm: float = WIDTH_CM) -> np.ndarray:
    """The left line of a lane that bends to the right by 90 degrees, by the radius of its right one."""
    outer_cm, angle = inner_cm + width_cm, np.linspace(0.0, 0.5 * np.pi, 60)
    arc = np.stack(
        [20.0 + inner_cm - outer_cm * np.cos(angle), 45.0 - inner_cm + outer_cm * np.sin(angle)], axis=1
    )
    return np.vstack([[arc[0, 0], -10.0], arc, arc[-1] + [60.0, 0.0]])


def sharply(radius_cm: float = 0.0) -> np.ndarray:
    """The left line of a lane that turns by a right angle where the right one does on its curve."""
    return turning(radius_cm, 85.0, on_cm=100.0) - [40.0, 0.0]


def dashes(path_cm: np.ndarray, dash_cm: float, gap_cm: float) -> list[np.ndarray]:
    """Pieces of a line that is finely divided."""
    steps = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path_cm, axis=0).T))])
    even = np.arange(0.0, steps[-1], 1.0)
    points = np.stack([np.interp(even, steps, path_cm[:, axis]) for axis in (0, 1)], axis=1)
    period = round(dash_cm + gap_cm)
    return [points[i : i + round(dash_cm) + 1] for i in range(0, len(points) - 2, period)]


BAYS = [np.array([[20.0, y], [50.0, y]]) for y in (25.0, 60.0)]


@pytest.mark.parametrize(
    "edges",
    [
        pytest.param(edges_of(line(20.0, -10.0, 90.0), line(-20.0, -10.0, 90.0)), id="a straight lane"),
        pytest.param(edges_of(line(20.0, -10.0, 90.0), line(-20.0, -10.0, 90.0), *BAYS), id="bays beside it"),
        pytest.param(edges_of(turning(14.0), bend(14.0)), id="a tight bend"),
        pytest.param(edges_of(turning(14.0), *dashes(bend(14.0), 6.0, 6.0)), id="its outer line is dashed"),
        pytest.param(edges_of(turning(14.0), bend(14.0, 37.0)), id="a lane that narrows in a bend"),
        pytest.param(edges_of(turning(14.0, 44.0), bend(14.0, 47.0)), id="a lane that widens in a bend"),
        pytest.param(edges_of(turning(14.0), sharply()), id="the outer line turns at once"),
        pytest.param(edges_of(turning(14.0), sharply(14.0)), id="both lines on the same radius"),
        pytest.param(
            edges_of(turning(14.0, 60.0), LEFT_ENDS), id="an outer line would be too far to be seen"
        ),
        pytest.param(
            edges_of(turning(14.0), LEFT_ENDS, np.array([[-70.0, 85.0], [70.0, 85.0]])),
            id="a T, two lanes on",
        ),
        pytest.param(edges_of(turning(0.0), LEFT_ENDS), id="a corner of tape"),
        pytest.param(edges_of(turning(35.0), LEFT_ENDS), id="a wide bend without its outer line"),
        pytest.param(edges_of(turning(14.0, turn_deg=55.0), LEFT_ENDS), id="a line that turns by less"),
        pytest.param(edges_of(turning(14.0, on_cm=1.0), LEFT_ENDS), id="a line that ends in its curve"),
        pytest.param(edges_of(turning(14.0, begin_cm=36.0), LEFT_ENDS), id="nothing before the curve"),
        pytest.param(edges_of(turning(14.0), LEFT_ENDS, line(20.0, 47.0, 90.0)), id="the line goes on, too"),
        pytest.param(RoadEdges(np.empty((0, 2)), np.empty((0, 2))), id="nothing"),
    ],
)
def test_no_side_road(edges):
    assert found_in(edges) is None


def test_where_the_outer_line_of_a_bend_would_be_out_of_view_it_is_no_side_road():
    class Blind(CameraView):
        def shows(self, points_cm: np.ndarray) -> np.ndarray:
            return points_cm[:, 1] < 40.0

    edges, view = edges_of(turning(14.0), LEFT_ENDS), Blind(example_camera())
    assert find_side_road(LANE, WIDTH_CM, MARKINGS_CM, edges, VIEW) is not None
    assert find_side_road(LANE, WIDTH_CM, MARKINGS_CM, edges, view) is None


def look(road: SideRoadAhead, *seen_cm: float, travel_cm: float = 3.0) -> bool:
    """Show one side road after another, with the car's way between, and return whether it is believed."""
    for ahead_cm in seen_cm:
        road.moved(travel_cm, 0.0)
        road.look(SideRoad(1, ahead_cm))
    return road.is_here(WIDTH_CM)


def test_a_side_road_is_believed_when_it_is_found_again_where_the_car_should_see_it():
    assert not look(SideRoadAhead(), 33.0) and look(SideRoadAhead(), 33.0, 30.0)
    assert not look(SideRoadAhead(), 33.0, 20.0)


def test_a_standing_car_sees_the_same_again():
    assert not look(SideRoadAhead(), *[30.0] * 9, travel_cm=0.0)


def test_one_on_the_other_side_is_another_one():
    road = SideRoadAhead()
    look(road, 33.0)
    road.moved(3.0, 0.0)
    road.look(SideRoad(0, 30.0))
    assert not road.is_here(WIDTH_CM)


def test_it_is_here_from_shortly_before_it_until_a_lane_width_beyond():
    road = SideRoadAhead()
    assert not look(road, 60.0, 57.0)
    here = []
    for _ in range(40):
        road.moved(3.0, 0.0)
        assert road.road is not None
        here.append((road.road.ahead_cm, road.is_here(WIDTH_CM)))
    assert [at for at, _ in here if -40.0 < at < 36.0] == [at for at, is_here in here if is_here]


def test_frames_without_it_speak_against_it():
    road = SideRoadAhead()
    assert look(road, 33.0, 30.0)
    for _ in range(3):
        road.look(None)
    assert road.is_here(WIDTH_CM)
    road.look(None)
    assert not road.is_here(WIDTH_CM) and road.road is None


def test_a_car_that_turns_away_passes_none():
    road = SideRoadAhead()
    look(road, 33.0, 30.0)
    for _ in range(5):
        road.moved(1.0, 0.15)
    assert road.is_here(WIDTH_CM)
    road.moved(1.0, 0.15)
    assert road.road is None


def test_a_way_that_is_not_known_makes_it_unknown():
    road = SideRoadAhead()
    look(road, 33.0, 30.0)
    road.moved(math.nan, 0.0)
    assert not road.is_here(WIDTH_CM)


def drive(
    tracker: LaneTracker, told: bool = True, sure_of_left: bool = False, goes_on: bool = False
) -> np.ndarray:
    """Drive past a side road that the network takes for a bend; what is answered while it is passed."""
    answers = []
    for at_cm in np.arange(110.0, -20.0, -3.0):
        if told:
            tracker.moved(3.0, 0.0, WHEELBASE_CM)
        left = [line(-20.0, -10.0, 95.0 if sure_of_left else max(at_cm - 5.0, 0.0))]
        right = [turning(14.0, at_cm)] if at_cm > 6.0 else []
        if goes_on:
            right.append(line(20.0, -10.0, 90.0))
        rows = np.array([0.0, 15.0, 30.0])
        bent_cm = 0.06 * np.maximum(rows - (at_cm - 14.0), 0.0) ** 2
        network_cm = LANE + (0.0 if at_cm < 0.0 else bent_cm * (1.0 if not sure_of_left else [[0.0], [1.0]]))
        presence = np.array([1.0 if sure_of_left or at_cm > 30.0 else 0.8, 1.0])
        edges = edges_of(*left, *right)
        answer_cm, _, _ = tracker.follow(network_cm.reshape(6), np.full(6, 1.0), presence, edges)
        if tracker.straight_on.on:
            answers.append(answer_cm)
    return np.array(answers)


def test_the_lane_goes_straight_on_past_a_side_road():
    tracker = LaneTracker(LaneMemory(WIDTH_CM), view=VIEW)
    answers_cm = drive(tracker)
    assert tracker.straight_on.on and len(answers_cm) > 12
    # The last plain frames already show the beginning of the curve at the last row, which turns the lane.
    assert np.isfinite(answers_cm).all() and np.abs(answers_cm - LANE.reshape(6)).max() < 6.0


def test_without_the_cars_motion_no_side_road_is_looked_for():
    tracker = LaneTracker(LaneMemory(WIDTH_CM), view=VIEW)
    drive(tracker, told=False)
    assert tracker.side_road.road is None


@pytest.mark.parametrize("kind", ["sure_of_left", "goes_on"])
def test_where_a_line_of_the_lane_is_sure_the_lane_is_followed(kind):
    assert not len(drive(LaneTracker(LaneMemory(WIDTH_CM), view=VIEW), **{kind: True}))


def past_a_side_road() -> LaneTracker:
    """A tracker that continues the lane beside a side road."""
    tracker = LaneTracker(LaneMemory(WIDTH_CM), view=VIEW)
    for at_cm in np.arange(80.0, 20.0, -3.0):
        tracker.moved(3.0, 0.0, WHEELBASE_CM)
        edges = edges_of(line(-20.0, -10.0, max(at_cm - 5.0, 0.0)), turning(14.0, at_cm))
        presence = np.array([1.0 if at_cm > 40.0 else 0.8, 1.0])
        tracker.follow(LANE.reshape(6), np.full(6, 1.0), presence, edges)
        if tracker.straight_on.on:
            return tracker
    raise AssertionError("no side road was believed")


def test_a_line_that_is_surely_seen_for_long_ends_it():
    tracker, frames = past_a_side_road(), 0
    bent = LANE + np.array([0.0, 4.0, 16.0])
    while tracker.straight_on.on:
        tracker.moved(1.0, 0.0, WHEELBASE_CM)
        curve = np.stack([-20.0 + 16.0 * (np.arange(40.0) / 30.0) ** 2, np.arange(40.0)], axis=1)
        tracker.follow(bent.reshape(6), np.full(6, 1.0), np.ones(2), edges_of(curve))
        frames += 1
    assert frames == 8


def test_a_caller_that_stops_telling_the_cars_motion_is_not_sent_straight_on_for_ever():
    tracker, nothing = past_a_side_road(), RoadEdges(np.empty((0, 2)), np.empty((0, 2)))
    for _ in range(41):
        tracker.follow(LANE.reshape(6), np.full(6, 1.0), np.zeros(2), nothing)
    assert not tracker.straight_on.on


def test_a_reset_forgets_the_side_road():
    tracker = LaneTracker(LaneMemory(WIDTH_CM), view=VIEW)
    drive(tracker)
    assert tracker.side_road.road is not None
    tracker.reset()
    assert tracker.side_road.road is None
