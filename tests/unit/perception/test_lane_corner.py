from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
import pytest

from lanenet.control.steering import SteeringSettings, corner_target_rad
from lanenet.geometry.frames import car_from_map
from lanenet.geometry.lane import rows_of_polyline
from lanenet.perception.edges.road import RoadEdges
from lanenet.perception.estimate import LaneMemory
from lanenet.perception.network.corner import corners
from lanenet.perception.network.refinement import RoadBorders
from lanenet.perception.network.tracking.lane_corner import CornerAhead, LaneCorner, Leg, find_corner
from lanenet.perception.network.tracking.tracker import LaneTracker
from tests.unit.perception.tapes import tape, together

WIDTH_CM, WHEELBASE_CM, MARKINGS_CM = 40.0, 17.0, (3.0, 3.0)
LANE = np.array([[-20.0, -20.0, -20.0], [20.0, 20.0, 20.0]])


def lines_of(turn_deg: float, corner_cm: float, begin_cm: float = 0.0) -> np.ndarray:
    """Both lines of a lane that goes straight ahead and turns there, by its middle, to the right."""
    turn = math.radians(turn_deg)
    places = [[way * 20.0, corner_cm - way * 20.0 * math.tan(0.5 * turn)] for way in (-1.0, 1.0)]
    on_cm = 150.0 * np.array([math.sin(turn), math.cos(turn)])
    return np.array([[[place[0], begin_cm], place, place + on_cm] for place in places])


def edges_of(lines_cm: Iterable[np.ndarray], marking_cm: float = 3.0, far_cm: float = 95.0) -> RoadEdges:
    """The borders of their tapes, as far as a car sees them."""
    edges = together(*(tape(line_cm, marking_cm) for line_cm in lines_cm))
    x, y = edges.points_cm.T
    seen = (y > -4.0) & (y < far_cm) & (np.abs(x) < 64.0)
    return RoadEdges(edges.points_cm[seen], edges.normals[seen])


def found_in(
    edges: RoadEdges, lines_cm: np.ndarray = LANE, markings_cm: tuple[float, float] = MARKINGS_CM
) -> LaneCorner | None:
    hints = corners(lines_cm.tolist(), markings_cm, RoadBorders(edges))
    return find_corner(lines_cm, WIDTH_CM, markings_cm, hints, edges)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("turn_deg", [45.0, 60.0, 75.0, 90.0, -50.0, -70.0, -90.0])
def test_a_corner_of_both_lines_is_found(turn_deg, dtype):
    edges = edges_of(lines_of(turn_deg, corner_cm=40.0))
    edges = RoadEdges(edges.points_cm.astype(dtype), edges.normals.astype(dtype))
    found = found_in(edges)
    assert found is not None and math.degrees(found.turn) == pytest.approx(turn_deg, abs=1.0)
    expected_cm = lines_of(turn_deg, corner_cm=40.0)[:, 1]
    assert np.array([found.place_cm(-1.0), found.place_cm(1.0)]) == pytest.approx(expected_cm, abs=0.7)


def test_a_corner_of_dark_tape_is_found():
    found = found_in(edges_of(lines_of(70.0, 40.0), marking_cm=-3.0), markings_cm=(-3.0, -3.0))
    assert found is not None and math.degrees(found.turn) == pytest.approx(70.0, abs=1.0)


def test_a_mirrored_corner_is_found_mirrored():
    edges = edges_of(lines_of(65.0, 38.0))
    mirrored = RoadEdges(edges.points_cm * [-1.0, 1.0], edges.normals * [-1.0, 1.0])
    one, other = found_in(edges), found_in(mirrored)
    assert one is not None and other is not None and one.turn == pytest.approx(-other.turn, abs=1e-6)
    assert one.place_cm(1.0) == pytest.approx(other.place_cm(-1.0) * [-1.0, 1.0], abs=1e-6)


def side_road(centre: bool) -> RoadEdges:
    """The right line turns into a side road 25 cm ahead, and the left one ends there; or goes on beyond."""
    right = np.array([[20.0, 0.0], [20.0, 25.0], [100.0, 25.0]])
    left = [np.array([[-20.0, 0.0], [-20.0, 25.0]]), np.array([[-20.0, 110.0], [-20.0, 140.0]])]
    dashes = [np.array([[28.0, 65.0], [100.0, 65.0]])] if centre else []
    return edges_of([right, *left, *dashes])


def bend(radius_cm: float, begins_cm: float, width_cm: float = WIDTH_CM) -> RoadEdges:
    """Both lines of a lane that bends to the right by 90 degrees, that far about the middle."""
    angle, lines = np.linspace(0.0, 0.5 * np.pi, 60), []
    for r in (radius_cm + 0.5 * width_cm, radius_cm - 0.5 * width_cm):
        arc = np.stack([radius_cm - r * np.cos(angle), begins_cm + r * np.sin(angle)], axis=1)
        lines.append(np.vstack([[arc[0, 0], 0.0], arc, arc[-1] + [100.0, 0.0]]))
    return edges_of(lines)


STOP_LINE = np.array([[-20.0, 30.0], [20.0, 30.0]])


def shown(
    lines_cm: np.ndarray, inner_cm: float = 60.0, outer_cm: float = 60.0, gap_cm: float = 0.0
) -> list[np.ndarray]:
    """So much of the lines beyond a corner to the right, and a gap before and after that of the outer one."""
    pieces = []
    sides = zip(lines_cm, (outer_cm, inner_cm), (gap_cm, 0.0), strict=True)
    for (begin, place, end), length_cm, free_cm in sides:
        on = (end - place) / math.dist(end, place)
        pieces.append(np.array([begin, place - [0.0, free_cm]]))
        pieces.append(np.array([place + free_cm * on, place + (free_cm + length_cm) * on]))
    return pieces


def straight(x_cm: float, begin_cm: float, end_cm: float) -> np.ndarray:
    return np.array([[x_cm, begin_cm], [x_cm, end_cm]])


def crossing_road() -> list[np.ndarray]:
    return [np.array([[-64.0, y], [64.0, y]]) for y in (22.0, 62.0)]


def dashes() -> list[np.ndarray]:
    """Both lines of a lane straight ahead, beyond 22 cm in dashes of 10 cm."""
    pieces = [(0.0, 22.0), *((y, y + 10.0) for y in np.arange(32.0, 95.0, 20.0))]
    return [np.array([[x, a], [x, b]]) for x in (-20.0, 20.0) for a, b in pieces]


TO_STOP_LINE = [np.array([[x, 0.0], [x, 30.0]]) for x in (-20.0, 20.0)]


@pytest.mark.parametrize(
    "edges",
    [
        pytest.param(edges_of([lines_of(0.0, 40.0)[0], lines_of(0.0, 40.0)[1]]), id="straight"),
        pytest.param(edges_of([lines_of(70.0, 40.0)[1]]), id="the inner line alone"),
        pytest.param(edges_of([lines_of(70.0, 40.0)[0]]), id="the outer line alone"),
        pytest.param(edges_of([lines_of(70.0, 40.0)[1], lines_of(0.0, 40.0)[0]]), id="one goes straight on"),
        pytest.param(side_road(centre=False), id="a side road"),
        pytest.param(side_road(centre=True), id="a side road with a centre line"),
        pytest.param(edges_of([*lines_of(0.0, 40.0), STOP_LINE]), id="a stop line"),
        pytest.param(edges_of([*TO_STOP_LINE, STOP_LINE]), id="a stop line at the end"),
        pytest.param(edges_of([*crossing_road(), *dashes()]), id="a crossing road, and dashes that go on"),
        pytest.param(edges_of(lines_of(30.0, 40.0)), id="a kink"),
        pytest.param(edges_of(shown(lines_of(70.0, 40.0), inner_cm=6.0)), id="hardly an inner line"),
        pytest.param(edges_of(shown(lines_of(70.0, 40.0), outer_cm=6.0)), id="hardly an outer line"),
        pytest.param(edges_of(shown(lines_of(70.0, 40.0), gap_cm=12.0)), id="no outer line at its corner"),
        pytest.param(edges_of([lines_of(70.0, 25.0)[0]]), id="the outer line alone, near"),
        pytest.param(edges_of(shown(lines_of(70.0, 40.0), inner_cm=8.0, outer_cm=10.0)), id="short pieces"),
        pytest.param(edges_of([*lines_of(70.0, 40.0), straight(-20.0, 54.0, 75.0)]), id="a fork"),
        pytest.param(edges_of([*lines_of(70.0, 40.0), straight(20.0, 50.0, 88.0)]), id="goes on later"),
        pytest.param(edges_of(lines_of(90.0, 61.5)), id="far away"),
        pytest.param(RoadEdges(np.empty((0, 2)), np.empty((0, 2))), id="nothing"),
    ],
)
def test_what_is_no_corner_of_the_lane_is_not_found(edges):
    assert found_in(edges) is None


@pytest.mark.parametrize("width_cm", [25.0, 30.0, 40.0])
@pytest.mark.parametrize("inner_cm", [10.0, 15.0, 20.0, 25.0, 35.0])
def test_a_bend_is_no_corner(inner_cm, width_cm):
    lines_cm = LANE * width_cm / WIDTH_CM
    for begins_cm in np.arange(2.0, 66.0, 8.0):
        edges = bend(inner_cm + 0.5 * width_cm, begins_cm, width_cm)
        hints = corners(lines_cm.tolist(), MARKINGS_CM, RoadBorders(edges))
        assert find_corner(lines_cm, width_cm, MARKINGS_CM, hints, edges) is None


@pytest.mark.parametrize("width_cm", [30.0, 52.0])
def test_lines_of_another_distance_are_not_the_lanes_corner(width_cm):
    edges = edges_of(lines_of(70.0, 40.0) * [width_cm / WIDTH_CM, 1.0])
    assert found_in(edges) is None


def ahead(corner_cm: float = 40.0, turn_deg: float = 70.0) -> LaneCorner:
    turn = math.radians(turn_deg)
    return LaneCorner(Leg(0.0, 0.0, 0.0), Leg(0.0, corner_cm, turn), WIDTH_CM)


def test_its_lines_meet_where_both_legs_do():
    assert ahead().line_cm(-1.0)[1] == pytest.approx(lines_of(70.0, 40.0)[0, 1])
    assert ahead().line_cm(1.0)[1] == pytest.approx(lines_of(70.0, 40.0)[1, 1])
    assert ahead().line_cm(0.0)[1] == pytest.approx([0.0, 40.0])


def test_a_corner_is_believed_once_it_was_found_twice_in_the_same_place():
    corner = CornerAhead()
    for found_cm, is_believed in ((60.0, False), (48.0, False), (47.0, True)):
        # It lies 2 cm nearer now.
        corner.moved(2.0, 0.0, WHEELBASE_CM)
        corner.look(ahead(found_cm))
        assert corner.on == is_believed


def test_a_car_that_stands_believes_no_corner():
    corner = CornerAhead()
    for _ in range(5):
        corner.moved(0.0, 0.0, WHEELBASE_CM)
        corner.look(ahead(40.0))
    assert not corner.on


def test_a_slow_car_believes_a_corner_as_well():
    corner, believed = CornerAhead(), []
    for frame in range(4):
        corner.moved(0.4, 0.0, WHEELBASE_CM)
        corner.look(ahead(40.0 - 0.4 * frame))
        believed.append(corner.on)
    # It has driven 1.2 cm since it found the corner first.
    assert believed == [False, False, False, True]


def test_a_corner_is_forgotten_where_nobody_knows_how_the_car_moved():
    corner = on_the_way()
    corner.moved(math.nan, 0.0, WHEELBASE_CM)
    assert corner.corner is None and not corner.on


def test_the_way_around_begins_near_the_inner_lines_corner():
    corner = CornerAhead()
    for y_cm in (64.0, 62.0, 60.0):
        corner.moved(2.0, 0.0, WHEELBASE_CM)
        corner.look(ahead(y_cm))
    assert not corner.on
    corner.moved(12.0, 0.0, WHEELBASE_CM)
    corner.look(None)
    assert corner.on


def test_a_corner_that_is_not_seen_again_is_forgotten():
    corner = CornerAhead()
    corner.look(ahead(80.0))
    corner.moved(46.0, 0.0, WHEELBASE_CM)
    corner.look(None)
    assert corner.corner is None and not corner.on


@pytest.mark.parametrize(("travel_cm", "turn_rad"), [(5.0, 0.0), (4.0, 0.3), (6.0, -0.2), (-3.0, 0.1)])
def test_the_corner_moves_with_the_car(travel_cm, turn_rad):
    corner = CornerAhead()
    corner.look(ahead())
    corner.moved(travel_cm, turn_rad, WHEELBASE_CM)
    pose = np.array([travel_cm * math.cos(turn_rad / 2), travel_cm * math.sin(turn_rad / 2), turn_rad])
    # In the map of the frame before, x leads ahead and y to the left.
    before_cm = np.concatenate([ahead().line_cm(way) for way in (-1.0, 1.0)])
    on_map = np.stack([before_cm[:, 1] + WHEELBASE_CM, -before_cm[:, 0]], axis=1)
    assert corner.corner is not None
    after_cm = np.concatenate([corner.corner.line_cm(way) for way in (-1.0, 1.0)])
    assert after_cm == pytest.approx(car_from_map(on_map, pose, WHEELBASE_CM), abs=1e-9)


def on_the_way(corner_cm: float = 40.0) -> CornerAhead:
    corner = CornerAhead()
    for before_cm in (2.0, 0.0):
        corner.moved(2.0, 0.0, WHEELBASE_CM)
        corner.look(ahead(corner_cm + before_cm))
    assert corner.on
    return corner


def test_points_are_answered_but_where_a_line_runs_along_a_row():
    points_cm, sigma_cm = on_the_way(20.0).lane()
    # The right line turns 6 cm ahead, the left one 34 cm ahead.
    assert points_cm[0] == pytest.approx([-20.0, -20.0, -20.0])
    assert points_cm[1, 0] == pytest.approx(20.0) and np.isnan(points_cm[1, 1:]).all()
    assert np.isfinite(sigma_cm).tolist() == np.isfinite(points_cm).tolist()


def test_sigma_grows_while_nothing_of_it_is_seen_and_on_a_line_that_runs_aside():
    corner = on_the_way(20.0)
    at_first = corner.lane()[1][0, 0]
    corner.moved(20.0, 0.0, WHEELBASE_CM)
    corner.follow(MARKINGS_CM, RoadEdges(np.empty((0, 2)), np.empty((0, 2))))
    assert corner.lane()[1][0, 0] > 1.2 * at_first
    corner.moved(0.0, -0.6, WHEELBASE_CM)
    points_cm, sigma_cm = corner.lane()
    aside = np.isfinite(points_cm)
    assert aside.any() and sigma_cm[aside] == pytest.approx(
        math.hypot(0.7, 0.8) / math.cos(math.radians(70.0) - 0.6), rel=0.2
    )


def test_it_is_given_up_when_nothing_of_it_is_seen():
    corner, nothing = on_the_way(), RoadEdges(np.empty((0, 2)), np.empty((0, 2)))
    for _ in range(12):
        corner.moved(5.0, 0.0, WHEELBASE_CM)
        assert corner.follow(MARKINGS_CM, nothing)
    corner.moved(5.0, 0.0, WHEELBASE_CM)
    assert not corner.follow(MARKINGS_CM, nothing) and not corner.on and not corner.is_behind


def test_it_is_given_up_by_a_caller_that_stops_telling_the_cars_motion():
    corner, nothing = on_the_way(), RoadEdges(np.empty((0, 2)), np.empty((0, 2)))
    assert [corner.follow(MARKINGS_CM, nothing) for _ in range(41)] == [True] * 40 + [False]


def test_it_ends_beyond_the_corner():
    corner = on_the_way()
    corner.moved(0.0, 0.0, WHEELBASE_CM)
    corner.corner = LaneCorner(Leg(0.0, -40.0, -1.0), Leg(0.0, -30.0, 0.1), WIDTH_CM)
    edges = edges_of([np.array([[x - 2.0, 0.0], [x + 8.0, 95.0]]) for x in (-20.0, 20.0)])
    assert not corner.follow(MARKINGS_CM, edges) and corner.is_behind
    beyond_cm = corner.lane_beyond()
    assert beyond_cm is not None and beyond_cm[1] - beyond_cm[0] == pytest.approx(np.full(3, 40.0), abs=0.5)


@pytest.mark.parametrize("after", [Leg(0.0, 20.0, 2.3), Leg(0.0, 20.0, 0.2)])
def test_a_lane_that_leads_back_or_no_longer_turns_is_given_up(after):
    corner, nothing = on_the_way(), RoadEdges(np.empty((0, 2)), np.empty((0, 2)))
    corner.corner = LaneCorner(Leg(0.0, 0.0, 0.0), after, WIDTH_CM)
    assert not corner.follow(MARKINGS_CM, nothing) and not corner.is_behind


class Drive:
    """A car that is led around a corner by what the tracker answers; the network goes straight on."""

    def __init__(self, turn_deg: float, told: bool = True) -> None:
        self.lines_cm = lines_of(turn_deg, corner_cm=110.0, begin_cm=-30.0)
        self.tracker = LaneTracker(LaneMemory(WIDTH_CM))
        self.pose, self.told, self.steering_rad = np.zeros(3), told, 0.0
        self.steering = SteeringSettings(wheelbase_cm=WHEELBASE_CM, lane_width_cm=WIDTH_CM)

    def seen_cm(self) -> np.ndarray:
        on_map = np.stack([self.lines_cm[..., 1] + WHEELBASE_CM, -self.lines_cm[..., 0]], axis=-1)
        return np.array([car_from_map(line, self.pose, WHEELBASE_CM) for line in on_map])

    def step(self, travel_cm: float = 3.0) -> np.ndarray:
        """Drive on, and return the errors of what is answered."""
        turn_rad = travel_cm * math.tan(self.steering_rad) / WHEELBASE_CM
        x, y, heading = self.pose
        middle = heading + 0.5 * turn_rad
        self.pose = np.array(
            [x + travel_cm * math.cos(middle), y + travel_cm * math.sin(middle), heading + turn_rad]
        )
        if self.told:
            self.tracker.moved(travel_cm, turn_rad, WHEELBASE_CM)
        lines_cm = self.seen_cm()
        true_cm = np.concatenate([rows_of_polyline(line_cm) for line_cm in lines_cm])
        guess_cm = np.where(np.abs(true_cm) < 45.0, true_cm, LANE.reshape(6))
        found_cm = self.tracker.follow(guess_cm, np.full(6, 1.0), np.ones(2), edges_of(lines_cm))[0]
        if self.tracker.corner.on:
            assert self.tracker.corner.corner is not None
            path_cm = self.tracker.corner.corner.line_cm(0.0)
            self.steering_rad = corner_target_rad(path_cm, self.steering)
        else:
            middle_cm = np.nanmean([found_cm[1], found_cm[4]])
            self.steering_rad = 0.0 if np.isnan(middle_cm) else math.atan2(-middle_cm, 15.0)
        return found_cm - true_cm

    def beside_cm(self) -> float:
        """How far the front axle is to the right of the lane's middle, once it is around the corner."""
        left, right = (line_cm[1:] for line_cm in self.seen_cm())
        along = (left[1] - left[0]) / math.dist(*left)
        return float(-(0.5 * (left[0] + right[0])) @ [along[1], -along[0]])


@pytest.mark.parametrize("turn_deg", [50.0, 75.0, -60.0, -80.0])
def test_a_car_is_led_around_a_corner(turn_deg):
    drive, was_on, worst_cm = Drive(turn_deg), 0, 0.0
    for _ in range(65):
        off_cm = drive.step()
        if drive.tracker.corner.on:
            was_on += 1
            worst_cm = max([worst_cm, *np.abs(off_cm[np.isfinite(off_cm)])])
    assert was_on > 10 and not drive.tracker.corner.on
    assert drive.tracker.straight_on.expected_cm is not None
    assert worst_cm < 2.0 and abs(drive.beside_cm()) < 4.0
    assert np.abs(drive.step()).max() < 1.0


def test_without_the_cars_motion_no_corner_is_followed():
    drive = Drive(70.0, told=False)
    for _ in range(30):
        drive.step()
        assert drive.tracker.corner.corner is None


def test_a_corner_that_was_given_up_leaves_no_lane():
    drive, nothing = Drive(70.0), RoadEdges(np.empty((0, 2)), np.empty((0, 2)))
    while not drive.tracker.corner.on:
        drive.step()
    for _ in range(40):
        drive.tracker.moved(3.0, 0.0, WHEELBASE_CM)
        found_cm, _, _ = drive.tracker.follow(LANE.reshape(6), np.full(6, 5.0), np.zeros(2), nothing)
    assert not drive.tracker.corner.on and drive.tracker.straight_on.expected_cm is None
    assert np.isnan(found_cm).all()


def test_around_a_corner_the_motion_that_is_told_may_be_wrong():
    drive = Drive(70.0)
    told = drive.tracker.moved
    drive.tracker.moved = lambda travel, turn, wheelbase: told(1.1 * travel, 1.1 * turn, wheelbase)  # type: ignore[method-assign]
    worst_cm = 0.0
    for _ in range(65):
        off_cm = drive.step()
        if drive.tracker.corner.on:
            worst_cm = max([worst_cm, *np.abs(off_cm[np.isfinite(off_cm)])])
    assert 0.0 < worst_cm < 3.0 and abs(drive.beside_cm()) < 4.0


def test_a_reset_forgets_the_corner():
    drive = Drive(70.0)
    while not drive.tracker.corner.on:
        drive.step()
    drive.tracker.reset()
    assert not drive.tracker.corner.on and drive.tracker.corner.corner is None
