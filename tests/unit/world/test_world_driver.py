"""The scripted driver and its scripts: tracking, recoveries, crawl, pauses; throttle and angle."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from datagen.world.car.camera import CameraSettings
from datagen.world.car.car import DonkeyCommands, DonkeySettings, draw_donkey
from datagen.world.car.driver import (
    DriverSettings,
    Script,
    place_on_track,
    shortest_excursion_spacing_cm,
    shortest_lane_change_cm,
)
from datagen.world.road.track_settings import TrackSettings
from datagen.world.simulate import scripted_states
from datagen.world.world import SimulationSettings, World, build_world
from lanenet.config import check_settings
from lanenet.data.drives import open_drive
from lanenet.data.drives.folder import read_truth
from lanenet.errors import ConfigError
from lanenet.geometry.frames import map_from_car

TINY = CameraSettings(width=16, height=16)


def _world(driver: DriverSettings, **changes: object) -> World:
    settings = {"frames": 340, "camera": TINY, "random_look": False, "driver": driver, **changes}
    return build_world(SimulationSettings(**{"track": TrackSettings(closed=True), **settings}))


def _offsets_cm(world: World) -> tuple[np.ndarray, np.ndarray]:
    """Way and offset of the front axle, from the true poses."""
    near_cm, places = world.driver.s_cm, []
    for state in scripted_states(world):
        front_cm = map_from_car(np.zeros((1, 2)), state.pose, 26.0)[0]
        near_cm, offset_cm = place_on_track(world.track, front_cm, near_cm)
        places.append([near_cm, offset_cm])
    return tuple(np.array(places).T)


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("rate_hz", [12.0, 30.0])
def test_the_driver_keeps_its_line_although_the_car_is_off(seed, rate_hz):
    driver = DriverSettings(wander_cm=0.0)
    _, offset_cm = _offsets_cm(_world(driver, seed=seed, rate_hz=rate_hz, frames=int(12 * rate_hz)))
    assert np.abs(offset_cm).mean() < 0.6
    assert np.abs(offset_cm).max() < 4.0


def test_the_driver_starts_on_its_line():
    for seed in range(2):
        world = _world(DriverSettings(), seed=seed, frames=1)
        way_cm, offset_cm = _offsets_cm(world)
        assert offset_cm[0] == pytest.approx(world.driver.script.offset_cm(way_cm[0]), abs=0.05)


def test_recoveries_go_out_and_come_back():
    driver = DriverSettings(style="recover", wander_cm=0.0, recover_cm=12.0, recover_every_cm=200.0)
    way_cm, offset_cm = _offsets_cm(_world(driver, seed=3))
    cells = (way_cm // 200.0).astype(int)
    full = [c for c in range(1, cells.max()) if np.sum(cells == c) > 40]
    assert len(full) >= 3
    for cell in full:
        inside = cells == cell
        assert 5.0 < np.abs(offset_cm[inside]).max() < 15.0
        home = inside & (way_cm % 200.0 > 175.0)
        assert np.abs(offset_cm[home]).max() < 2.0
    script = Script(driver, 20.0, np.random.default_rng(0))
    heights = np.array([script.offset_cm(200.0 * (k + 0.35)) for k in range(40)])
    assert (np.abs(heights) >= 6.0).all() and (np.abs(heights) <= 12.0).all()
    assert 5 < np.sum(heights > 0.0) < 35  # both sides


def test_crawl_is_a_centimetre_per_frame_and_fast_a_metre_per_second():
    for rate_hz in (10.0, 25.0):
        assert DriverSettings(style="crawl").chosen_speed_cm_s(rate_hz) == rate_hz
    assert DriverSettings(style="fast").chosen_speed_cm_s(20.0) == 100.0
    assert DriverSettings(style="fast", speed_cm_s=70.0).chosen_speed_cm_s(20.0) == 70.0
    world = _world(DriverSettings(style="crawl"), frames=80)
    assert world.settings.driver.speed_cm_s is None
    poses = np.array([state.pose for state in scripted_states(world)])
    step_cm = np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1)
    assert step_cm.mean() == pytest.approx(0.94, abs=0.06)


def test_pauses_stop_the_car_for_their_time():
    world = _world(DriverSettings(pauses_per_m=1.0, pause_s=1.0), frames=300)
    states = list(scripted_states(world))
    told = np.array([state.speed_cm_s for state in states])
    true = np.array([state.true_speed_cm_s for state in states])
    begins = np.flatnonzero((told[1:] == 0.0) & (told[:-1] > 0.0)) + 1
    assert len(begins) >= 2
    for begin in begins[:-1]:
        assert np.sum(told[begin : begin + 20] == 0.0) == 20
        assert true[begin + 19] < 2.0
    assert set(np.round(told, 6)) == {0.0, 60.0}


def test_speed_varies_slowly_within_its_bounds():
    world = _world(DriverSettings(speed_variation=0.4), frames=200)
    told = np.array([state.speed_cm_s for state in scripted_states(world)])
    assert (np.abs(told / 60.0 - 1.0) <= 0.4).all()
    assert told.std() > 3.0
    assert np.abs(np.diff(told)).max() < 5.0


def test_a_new_style_leaves_the_wandering_as_it_is():
    plain = Script(DriverSettings(), 20.0, np.random.default_rng(5))
    varied = Script(DriverSettings(speed_variation=0.2, pauses_per_m=1.0), 20.0, np.random.default_rng(5))
    assert [plain.offset_cm(s) for s in (0.0, 77.0)] == [varied.offset_cm(s) for s in (0.0, 77.0)]


def test_lanes_are_changed_and_changed_back():
    driver = DriverSettings(wander_cm=0.0, change_lanes_every_cm=300.0, lane_change_cm=100.0)
    script = Script(driver, 20.0, np.random.default_rng(0), other_lane_cm=40.0)
    places = (0.0, 299.0, 300.0, 350.0, 400.0, 599.0, 600.0, 650.0, 700.0, 899.0, 900.0, 1000.0)
    aimed = [0.0, 0.0, 0.0, 20.0, 40.0, 40.0, 40.0, 20.0, 0.0, 0.0, 0.0, 40.0]
    assert [script.offset_cm(s) for s in places] == pytest.approx(aimed)
    # Halfway it is steepest: half as steep again as the straight way across.
    assert max(script.slope(s) for s in np.arange(300.0, 401.0)) == pytest.approx(1.5 * 0.4, rel=0.01)


def test_the_first_change_begins_where_it_is_told_to():
    driver = DriverSettings(
        wander_cm=0.0, change_lanes_every_cm=300.0, first_change_cm=70.0, lane_change_cm=100.0
    )
    script = Script(driver, 20.0, np.random.default_rng(0), other_lane_cm=40.0)
    places = (0.0, 69.0, 70.0, 120.0, 170.0, 369.0, 370.0, 420.0, 470.0, 669.0, 720.0)
    aimed = [0.0, 0.0, 0.0, 20.0, 40.0, 40.0, 40.0, 20.0, 0.0, 0.0, 20.0]
    assert [script.offset_cm(s) for s in places] == pytest.approx(aimed)
    with pytest.raises(ConfigError, match="first_change_cm 70 needs change_lanes_every_cm, found none"):
        check_settings(DriverSettings, {"first_change_cm": 70.0}, "driver")


@pytest.mark.parametrize("radius_cm", [35.0, 90.0])
def test_excursions_and_changes_can_be_as_sharp_as_a_circle_and_no_sharper(radius_cm):
    every_cm = shortest_excursion_spacing_cm(24.0, radius_cm)
    change_cm = shortest_lane_change_cm(40.0, radius_cm)
    out = DriverSettings(style="recover", wander_cm=0.0, recover_cm=24.0, recover_every_cm=every_cm)
    across = DriverSettings(wander_cm=0.0, change_lanes_every_cm=2.0 * change_cm, lane_change_cm=change_cm)
    for settings, steps in ((out, 12.0 * every_cm), (across, 2.9 * change_cm)):
        script = Script(settings, 20.0, np.random.default_rng(3), other_lane_cm=40.0)
        offset_cm = np.array([script.offset_cm(s) for s in np.arange(0.0, steps, 0.5)])
        bend = np.abs(np.diff(offset_cm, 2)) / 0.5**2
        # Excursions are of half the height or more: the highest of a dozen is nearly as high as they get.
        assert 0.85 / radius_cm < bend.max() < 1.001 / radius_cm


def test_truth_is_of_the_lane_that_the_car_is_in():
    driver = DriverSettings(change_lanes_every_cm=250.0)
    track = TrackSettings(lanes=2, lane_width_cm=40.0)
    world = _world(driver, track=track, frames=250)
    middles, offsets = [], []
    for state in scripted_states(world):
        front = map_from_car(np.zeros((1, 2)), state.pose, world.settings.car.wheelbase_cm)[0]
        offsets.append(place_on_track(world.track, front, world.driver.s_cm)[1])
        # Where the car is in its lane, by the two lines at its axle.
        middles.append(0.5 * (state.points_cm[0] + state.points_cm[3]))
    offsets, middles = np.array(offsets), np.array(middles)
    other = offsets > 20.0
    # There, back, and there again.
    assert np.flatnonzero(np.diff(other.astype(int))).size in (2, 3)
    np.testing.assert_allclose(middles, offsets - 40.0 * other, atol=4.0)
    assert np.abs(middles).max() < 26.0 and offsets.max() == pytest.approx(40.0, abs=8.0)


def test_lanes_are_not_changed_where_there_is_one():
    with pytest.raises(ConfigError, match=r"change_lanes_every_cm: found a road with one lane, expected .*2"):
        _world(DriverSettings(change_lanes_every_cm=300.0))
    with pytest.raises(ConfigError, match="lane_change_cm 150 exceeds change_lanes_every_cm 100"):
        check_settings(DriverSettings, {"change_lanes_every_cm": 100.0}, "driver")


def test_contradictory_waves_are_refused():
    with pytest.raises(ConfigError, match="shortest_wander_cm 500 exceeds longest_wander_cm 400"):
        check_settings(DriverSettings, {"shortest_wander_cm": 500.0}, "driver")


DONKEY = DonkeyCommands(
    DonkeySettings(
        full_steering_rad=0.4,
        angle_deadband=0.1,
        angle_exponent=2.0,
        full_speed_cm_s=200.0,
        throttle_deadband=0.2,
        throttle_exponent=1.0,
    )
)


def test_donkey_commands_by_hand():
    assert DONKEY.angle(0.1) == pytest.approx(-0.55)  # a quarter is half the way beyond the deadband
    assert DONKEY.steering_rad(-0.55) == pytest.approx(0.1)
    assert DONKEY.angle(-9.0) == 1.0 and DONKEY.steering_rad(1.0) == pytest.approx(-0.4)
    assert DONKEY.steering_rad(0.1) == 0.0 and DONKEY.angle(0.0) == 0.0
    assert DONKEY.throttle(100.0) == pytest.approx(0.6) and DONKEY.speed_cm_s(0.2) == 0.0


@given(steering_rad=st.floats(-0.4, 0.4), speed_cm_s=st.floats(0.0, 200.0))
def test_donkey_commands_undo_each_other(steering_rad, speed_cm_s):
    assert DONKEY.steering_rad(DONKEY.angle(steering_rad)) == pytest.approx(steering_rad, abs=1e-9)
    assert DONKEY.speed_cm_s(DONKEY.throttle(speed_cm_s)) == pytest.approx(speed_cm_s, abs=1e-9)


def test_undrawn_gains_are_refused_and_fixing_one_moves_no_other():
    with pytest.raises(ValueError, match="draw_donkey"):
        DonkeyCommands(DonkeySettings())
    free = draw_donkey(DonkeySettings(), np.random.default_rng(1))
    fixed = draw_donkey(DonkeySettings(full_speed_cm_s=123.0), np.random.default_rng(1))
    assert fixed == free.model_copy(update={"full_speed_cm_s": 123.0})
    assert 0.3 <= free.full_steering_rad <= 0.45


def test_a_donkey_recording_holds_throttle_and_angle_only(tmp_path):
    from datagen.world.simulate import simulate_drive

    settings = SimulationSettings(
        seed=4, frames=40, camera=CameraSettings(width=32, height=24), recording="donkeycar"
    )
    drive = open_drive(simulate_drive(settings, tmp_path / "drive"))
    header = (tmp_path / "drive" / "frames.csv").read_text().splitlines()[0]
    assert header == "frame,file,t_s,throttle,angle"
    assert drive.max_steering_rad is None
    assert drive.commands.angle is not None and np.ptp(drive.commands.angle) > 0.0
    truth = read_truth(tmp_path / "drive")
    assert truth is not None
    turn = np.diff(truth["heading_rad"])
    # Donkeycar's left is negative; the car answers late.
    assert np.corrcoef(-drive.commands.angle[:-3], turn[2:])[0, 1] > 0.5
