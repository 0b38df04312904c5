"""Cameras near a given one, and roads of all kinds."""

from __future__ import annotations

import math

import numpy as np
import pytest

from datagen.world.car.camera import CameraSettings, line_in_bend_car, sees_lane
from datagen.world.car.car import CarSettings
from datagen.world.car.driver import Driver, DriverSettings
from datagen.world.road.build import random_track
from datagen.world.road.track_settings import TrackSettings
from datagen.world.variety import (
    camera_like,
    first_world,
    tightest_bend_cm,
    vary_camera,
    vary_car,
    vary_driver,
    vary_road,
    vary_simulation,
)
from datagen.world.world import SimulationSettings, World, build_world
from lanenet.config import check_settings
from lanenet.errors import ConfigError
from lanenet.geometry.camera import Camera, Mounting
from lanenet.geometry.lane import rows_of_polyline


@pytest.mark.parametrize(
    ("model", "D"),
    [("fisheye", [-0.03, 0.0, 0.0, 0.0]), ("pinhole", [-0.2, 0.03, 0.0, 0.0, 0.0])],
)
def test_a_camera_comes_back_from_its_settings(model, D):
    K = np.array([[105.0, 0.0, 79.5], [0.0, 105.0, 59.5], [0.0, 0.0, 1.0]])
    mounting = Mounting(17.0, 0.3, 0.02, -0.01, 3.0, 1.0)
    camera = Camera(model, 160, 120, K, np.array(D), mounting, 24.0)
    again = camera_like(camera).build(24.0)
    np.testing.assert_allclose(again.K, K, rtol=1e-4)
    assert again.mounting == mounting
    np.testing.assert_allclose(again.D, D[:4])


def test_cameras_vary_around_the_given_one():
    base = CameraSettings(width=160, height=120, field_of_view_rad=2.0, pitch_down_rad=0.3)
    drawn = [vary_camera(base, np.random.default_rng(seed)) for seed in range(60)]
    pitch = np.array([camera.pitch_down_rad for camera in drawn])
    assert np.abs(pitch - 0.3).max() <= math.radians(4.0) and pitch.std() > 0.02
    fields = np.array([camera.field_of_view_rad for camera in drawn])
    assert 1.8 <= fields.min() < 1.85 and 2.15 < fields.max() <= 2.2
    heights = np.array([camera.height_cm for camera in drawn])
    assert heights.min() >= 11.0 and heights.max() <= 25.0
    assert all((camera.width, camera.height) == (160, 120) for camera in drawn)
    assert vary_camera(base, np.random.default_rng(3)) == drawn[3]


def test_roads_vary_and_can_be_laid():
    roads = [vary_road(np.random.default_rng(seed)) for seed in range(60)]
    widths = {round(road.lane_width_cm, 2) for road in roads}
    assert len(widths) > 20 and {road.lanes for road in roads} == {1, 2}
    assert sum(road.preset is not None for road in roads) in range(18, 43)
    own = [road for road in roads if road.preset is None]
    assert all(30.0 <= road.lane_width_cm <= 69.0 and 1.5 <= road.line_width_cm <= 8.0 for road in own)
    assert 0 < sum(road.line_width_cm > 5.1 for road in own) <= len(own) // 4
    assert {road.right.kind for road in own} == {"solid", "dashed"}
    cornered = [road.corners for road in roads if road.corners > 0.0]
    assert 3 <= len(cornered) <= len(own) // 2 and 0.3 <= min(cornered) < max(cornered) <= 0.8
    kinked, wider, dark = (
        [road for road in own if road.pieces],
        [road for road in own if road.widening > 0.0],
        [road for road in own if road.right.colour in ("black", "blue", "red")],
    )
    assert kinked and wider and dark and all(road.lanes == 1 for road in kinked + wider)
    assert all(min(road.floor_bgr) > 135.0 and road.right.colour != "white" for road in dark)
    for seed, road in enumerate([*own[:4], kinked[0], wider[0], dark[0]]):
        track = random_track(road.model_copy(update={"length_cm": 400.0}), np.random.default_rng(seed))
        # Where a lane widens its lines are laid piece by piece.
        assert len(track.boxes) > 20 if road.widening > 0.0 else len(track.markings) >= 2


def test_a_road_without_room_gives_way_to_the_next_seed(monkeypatch):
    def only_from(seed: int):
        def build(simulation: SimulationSettings) -> World:
            if simulation.seed < seed:
                raise ConfigError("no room")
            return build_world(simulation)

        monkeypatch.setattr("datagen.world.variety.build_world", build)

    simulation = SimulationSettings(seed=3, frames=20)
    for seed, expected in ((0, 3), (5, 5), (10, 10)):
        only_from(seed)
        assert first_world(simulation).settings.seed == expected
    only_from(11)
    with pytest.raises(ConfigError, match="no room"):
        first_world(simulation)


def test_no_bend_is_tighter_than_the_car_can_turn():
    rng = np.random.default_rng(2)
    cars = [vary_car(CarSettings(), rng) for _ in range(40)]
    assert min(car.wheelbase_cm for car in cars) < 16.0 and max(car.wheelbase_cm for car in cars) > 25.0
    for car in cars:
        # The front axle's middle turns on this radius when the wheels are as far round as they go.
        assert tightest_bend_cm(car) > car.wheelbase_cm / math.sin(car.max_steering_rad)
    roads = [vary_road(rng, tightest_bend_cm(car)) for car in cars]
    own = [(car, road) for car, road in zip(cars, roads, strict=True) if road.preset is None]
    assert all(road.min_radius_cm >= tightest_bend_cm(car) for car, road in own)
    assert min(road.min_radius_cm for _, road in own) < 45.0


def test_the_camera_sees_the_lane_that_it_drives_in():
    narrow = CameraSettings(width=160, height=120, field_of_view_rad=1.2, pitch_down_rad=0.4, height_cm=15.0)
    # 32 cm ahead of the lens, 34 degrees to either side: 22 cm.
    wide_bends = {width: TrackSettings(lane_width_cm=width, min_radius_cm=500.0) for width in (30, 40, 50)}
    assert sees_lane(narrow, wide_bends[40], 20.0) and not sees_lane(narrow, wide_bends[50], 20.0)
    # A lens that looks above the road sees no line near the car.
    assert not sees_lane(narrow.model_copy(update={"pitch_down_rad": -0.4}), wide_bends[30], 20.0)
    for number in range(40):
        sequence = np.random.SeedSequence([5, number])
        drawn = vary_simulation(SimulationSettings(), sequence, number, cameras=(narrow,))
        assert sees_lane(drawn.camera, drawn.track, drawn.car.wheelbase_cm)


def _in_bend(radius_cm: float, width_cm: float, wheelbase_cm: float) -> tuple[np.ndarray, np.ndarray]:
    """Left and right line, frame car, of a road that is one bend (a negative radius to the right)."""
    bend = {
        "radius_cm": abs(radius_cm),
        "angle_deg": 180.0,
        "direction": "left" if radius_cm > 0.0 else "right",
    }
    track = random_track(
        TrackSettings(lane_width_cm=width_cm, pieces=({"arc": bend},)), np.random.default_rng(0)
    )
    car = CarSettings(wheelbase_cm=wheelbase_cm)
    driver = Driver(DriverSettings(), track, 0.0, car, 20.0, np.random.default_rng(0))
    return track.lines_car(driver.pose_at(70.0), wheelbase_cm, near_s_cm=70.0)


@pytest.mark.parametrize("radius_cm", [50.0, -50.0, 90.0])
@pytest.mark.parametrize("wheelbase_cm", [16.0, 26.0])
def test_lines_of_a_bend_lie_where_a_road_has_them(radius_cm, wheelbase_cm):
    for line, offset_cm in zip(_in_bend(radius_cm, 40.0, wheelbase_cm), (20.0, -20.0), strict=True):
        drawn = line_in_bend_car(1.0 / radius_cm, offset_cm, wheelbase_cm)
        np.testing.assert_allclose(np.linalg.norm(np.diff(drawn, axis=0), axis=1), 0.5, atol=1e-3)
        assert (drawn[:, 1] >= 0.0).all() and (drawn[:, 1] <= 45.0).all()
        # The road's samples are about a centimetre apart.
        assert np.linalg.norm(drawn[:, None] - line[None], axis=2).min(axis=1).max() < 0.8
        # Where the line inside turns away before a row, neither crosses it.
        crossed = np.interp((15.0, 30.0), drawn[:, 1], drawn[:, 0], right=np.nan)
        np.testing.assert_allclose(crossed, rows_of_polyline(line)[1:], atol=0.05)


def test_a_bend_needs_a_stretch_of_line_that_is_longer_than_its_gaps():
    # A long lens: on a straight both lines are in the picture 30 cm ahead.
    lens = CameraSettings(width=160, height=120, field_of_view_rad=1.1, pitch_down_rad=0.3, height_cm=18.0)
    wheelbase_cm, width_cm = 24.0, 34.0
    seen = []
    for radius_cm in (40.0, 60.0, 90.0, 150.0, 400.0):
        longest_cm = []
        for side in (1.0, -1.0):
            stretches_cm = []
            for line in _in_bend(side * radius_cm, width_cm, wheelbase_cm):
                near = line[(line[:, 1] >= 0.0) & (line[:, 1] <= 45.0) & (np.gradient(line[:, 1]) > 0.0)]
                pixels = lens.build(wheelbase_cm).project_ground(near)
                visible = near[((pixels >= 0.0) & (pixels <= [159.0, 119.0])).all(axis=1)]
                # A line that has left the picture does not come back here: one stretch.
                stretches_cm.append(float(np.linalg.norm(np.diff(visible, axis=0), axis=1).sum()))
            longest_cm.append(max(stretches_cm))
        for gap_cm in (0.0, 4.0, 8.0, 12.0, 16.0, 20.0, 24.0):
            # Samples of the road and of the rule are not the same.
            if abs(min(longest_cm) - gap_cm - 10.0) < 2.0:
                continue
            line = {"kind": "dashed" if gap_cm else "solid", "gap_cm": max(gap_cm, 1.0)}
            road = {"lane_width_cm": width_cm, "left": line, "right": line}
            expected = min(longest_cm) >= gap_cm + 10.0
            assert sees_lane(lens, TrackSettings(**road, min_radius_cm=radius_cm), wheelbase_cm) == expected
            # A road from pieces is judged by its own bends, not by a key that has no effect on it.
            arc = {"arc": {"radius_cm": radius_cm, "angle_deg": 20.0, "direction": "left"}}
            pieces = ({"straight": {"length_cm": 100.0}}, arc)
            assert sees_lane(lens, TrackSettings(**road, pieces=pieces), wheelbase_cm) == expected
            seen.append(expected)
    assert True in seen and False in seen


def test_a_road_without_paint_in_sight_is_not_seen():
    road = TrackSettings(pieces=({"straight": {"length_cm": 200.0}},))
    assert road.tightest_radius_cm == math.inf
    assert sees_lane(CameraSettings(), road, 26.0)
    bare = {"left": {"kind": "none"}, "right": {"kind": "none"}}
    assert not sees_lane(CameraSettings(), TrackSettings(**bare), 26.0)
    # No such road can be laid; that is told where it is laid.
    assert not sees_lane(CameraSettings(), TrackSettings(min_radius_cm=20.0, lane_width_cm=40.0), 26.0)


def test_what_is_not_drawn_stays():
    given = SimulationSettings(car=CarSettings(wheelbase_cm=21.0), camera=CameraSettings(height_cm=19.0))
    drawn = vary_simulation(given, np.random.SeedSequence([5, 0]), 0, road=False, driver=False)
    assert drawn.model_copy(update={"seed": given.seed}) == given
    lens = CameraSettings(height_cm=19.0)
    cars = [
        vary_simulation(given, np.random.SeedSequence([5, number]), number, cameras=(lens,))
        for number in range(40)
    ]
    assert len({one.car.wheelbase_cm for one in cars}) == 40
    own = [one for one in cars if one.track.preset is None]
    assert all(one.track.min_radius_cm >= tightest_bend_cm(one.car) for one in own)


def _drivers(track: TrackSettings, **changes: object) -> list[DriverSettings]:
    simulation = SimulationSettings(**{"track": track, **changes})
    return [vary_driver(simulation, np.random.default_rng(seed)) for seed in range(60)]


def test_drivers_leave_the_middle_but_find_back():
    drivers = _drivers(TrackSettings(lane_width_cm=40.0))
    assert {driver.style for driver in drivers} == {"wander", "recover"}
    speeds = [driver.speed_cm_s for driver in drivers]
    # In a bend of 60 cm nobody exceeds 3 m/s^2.
    assert None not in speeds and all(40.0 <= speed <= 135.0 for speed in speeds if speed is not None)
    assert all(driver.wander_cm <= 12.0 and driver.recover_cm <= 24.0 for driver in drivers)
    assert max(driver.recover_cm for driver in drivers) > 20.0
    assert all(driver.change_lanes_every_cm is None for driver in drivers)
    every = [driver.change_lanes_every_cm for driver in _drivers(TrackSettings(lane_width_cm=69.0, lanes=2))]
    assert sum(way is not None for way in every) in range(12, 31)


@pytest.mark.parametrize(("kind", "crossed"), [("solid", False), ("dashed", True), ("random", True)])
def test_lanes_are_changed_over_dashes_alone(kind, crossed):
    road = {"lane_width_cm": 50, "lanes": 2, "middle": {"kind": kind}}
    track = check_settings(TrackSettings, road, "track")
    drawn = [
        vary_simulation(SimulationSettings(track=track), np.random.SeedSequence([3, k]), k, road=False)
        for k in range(30)
    ]
    changing = [one.track for one in drawn if one.driver.change_lanes_every_cm is not None]
    assert bool(changing) == crossed
    assert all(one.middle is not None and one.middle.kind == "dashed" for one in changing)
    # Whoever stays in the lane drives on the road as it was.
    assert all(one.track == track for one in drawn if one.driver.change_lanes_every_cm is None)


def test_nobody_swerves_more_sharply_than_the_car_can_turn():
    two_lanes = TrackSettings(lane_width_cm=60.0, lanes=2)
    for car in (CarSettings(wheelbase_cm=16.0), CarSettings(wheelbase_cm=60.0)):
        drivers = _drivers(two_lanes, car=car)
        for driver in drivers:
            # Over 0.7 of the spacing: height times the squared sine of half a turn.
            excursion = 2.0 * math.pi**2 * driver.recover_cm / (0.7 * driver.recover_every_cm) ** 2
            change = 6.0 * 60.0 / driver.lane_change_cm**2
            ways = [excursion, change] if driver.change_lanes_every_cm else [excursion]
            assert max(ways) * tightest_bend_cm(car) < 1.001
        assert all(driver.recover_every_cm >= 200.0 and driver.lane_change_cm >= 150.0 for driver in drivers)
    # The long car needs the longer way.
    assert min(driver.recover_every_cm for driver in drivers) > 250.0


@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize("frames", [20, 100, 300])
def test_lanes_are_changed_within_the_drive(frames, closed):
    track = TrackSettings(lane_width_cm=40.0, lanes=2, closed=closed)
    drivers = [one for one in _drivers(track, frames=frames) if one.change_lanes_every_cm is not None]
    # The front axle of a car on an open road starts a wheelbase beyond the rear axle's 40 cm.
    start_cm = 0.0 if closed else 66.0
    begins = np.array([one.first_change_cm for one in drivers]) - start_cm
    ways = np.array([one.speed_cm_s for one in drivers]) * frames / 20.0
    assert (begins >= 30.0).all()
    latest = np.maximum(30.0, ways - 75.0)
    assert (begins <= latest).all()
    if frames == 300:
        share = (begins - 30.0) / (latest - 30.0)
        assert share.min() < 0.25 and share.max() > 0.75
