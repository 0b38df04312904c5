"""Measures of one run: wheels over lines, departures as events, put-backs, the end of a run."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from synthetic_roads import move_track

from datagen.datasets.jobs import SyntheticJob
from datagen.datasets.settings import DataSettings, SyntheticSettings
from datagen.judge.run import (
    TRUE_POINTS,
    TRUTH,
    DepartureCounter,
    Entrant,
    RunResult,
    StartWatch,
    Trajectory,
    drive_run,
    gentle_start_cm,
    wheel_offsets_cm,
)
from datagen.judge.settings import JudgeSettings, competition_cars, contest_roads
from datagen.world.car.camera import CameraSettings
from datagen.world.road.track import Track
from datagen.world.road.track_settings import TrackSettings, preset_names
from datagen.world.world import SimulationSettings
from lanenet.errors import ConfigError
from lanenet.perception.estimate import LaneEstimate

COMMON = SimulationSettings(
    camera=CameraSettings(width=16, height=16),
    track=TrackSettings(length_cm=800.0, min_radius_cm=50.0),
    random_look=False,
)
SETTINGS = JudgeSettings(count=2, laps=1, simulation=COMMON)


class Always:
    """A detector that always gives one answer."""

    def __init__(self, points_cm: np.ndarray) -> None:
        self.points_cm = points_cm

    def __call__(self, *camera_and_lane: object) -> Always:
        return self

    def detect(self, frame_bgr: np.ndarray) -> LaneEstimate:
        return LaneEstimate(points_cm=self.points_cm)

    def reset(self) -> None:
        pass


LEFT = Entrant("left", Always(np.repeat([-40.0, 0.0], 3)))
BLIND = Entrant("blind", Always(np.full(6, np.nan)))


def _straight(length_cm: float = 400.0) -> Track:
    s = np.arange(0.0, length_cm)
    zero = np.zeros(len(s))
    return Track(s, np.stack([s, zero], axis=1), zero, zero, False, 40.0, ())


def _ring(radius_cm: float = 100.0) -> Track:
    n = 629
    s = np.arange(n) * 2.0 * np.pi * radius_cm / n
    turn = s / radius_cm
    xy = radius_cm * np.stack([np.sin(turn), 1.0 - np.cos(turn)], axis=1)
    return Track(s, xy, turn, np.full(n, 1.0 / radius_cm), True, 40.0, ())


def _run(
    entrant: Entrant, settings: JudgeSettings = SETTINGS, index: int = 0
) -> tuple[RunResult, Trajectory]:
    return drive_run(settings, contest_roads(settings)[index], entrant)


def test_wheels_on_a_straight_road_by_hand():
    offsets = wheel_offsets_cm(_straight(), np.array([100.0, 3.0, 0.0]), 26.0, 16.0, 100.0)
    np.testing.assert_allclose(offsets, [11.0, -5.0, 11.0, -5.0], atol=1e-9)
    turned = wheel_offsets_cm(_straight(), np.array([100.0, 0.0, np.pi / 6.0]), 26.0, 16.0, 100.0)
    across = 8.0 * np.cos(np.pi / 6.0)
    np.testing.assert_allclose(turned, [13.0 + across, 13.0 - across, across, -across], atol=1e-9)


def test_wheels_on_a_ring_by_hand():
    # The rear axle is on the circle; front and rear wheels lie at other distances from its centre.
    offsets = wheel_offsets_cm(_ring(), np.array([0.0, 0.0, 0.0]), 26.0, 16.0, 0.0)
    expected = [100.0 - np.hypot(26.0, 92.0), 100.0 - np.hypot(26.0, 108.0), 8.0, -8.0]
    np.testing.assert_allclose(offsets, expected, atol=1e-3)


@given(st.floats(-15.0, 15.0), st.floats(-0.5, 0.5), st.floats(0.0, 6.2))
def test_turning_the_world_leaves_the_wheels_where_they_are(offset_cm, heading, turn):
    pose = np.array([150.0, offset_cm, heading])
    c, s = np.cos(turn), np.sin(turn)
    moved = np.array([c * pose[0] - s * pose[1] + 5.0, s * pose[0] + c * pose[1] - 9.0, heading + turn])
    there = move_track(_straight(), np.array([5.0, -9.0, turn]))
    np.testing.assert_allclose(
        wheel_offsets_cm(there, moved, 26.0, 16.0, 150.0),
        wheel_offsets_cm(_straight(), pose, 26.0, 16.0, 150.0),
        atol=1e-6,
    )


def test_a_departure_is_an_event_and_ends_inside():
    counter = DepartureCounter(40.0)
    furthest = [19.9, 20.1, 25.0, 20.1, 19.5, 20.2, 18.9, 20.5, 10.0]
    out = [counter.update(np.array([-value, 0.0])) for value in furthest]
    # 19.5 is inside, but not by a centimetre: 20.2 belongs to the first departure.
    assert out == [False, True, True, True, True, True, False, True, False]
    assert counter.count == 2
    counter.update(np.array([30.0]))
    counter.over = False  # put back
    assert not counter.update(np.array([0.0])) and counter.count == 3


def test_the_truth_drives_a_lap_cleanly():
    for entrant in (Entrant(TRUTH), Entrant(TRUE_POINTS)):
        result, trajectory = _run(entrant)
        assert result.completed and result.ended == "completed" and result.laps == 1.0
        assert result.departures == result.put_backs == 0 and result.unanswered == 0.0
        assert result.mean_offset_cm == pytest.approx(np.abs(trajectory.offset_cm).mean())
        assert result.frames == len(trajectory.t_s)
        assert trajectory.s_cm[-1] - trajectory.s_cm[0] == pytest.approx(800.0, abs=4.0)
        assert result.time_s == pytest.approx(800.0 / (60.0 * 0.94), rel=0.08)
    assert _run(Entrant(TRUTH))[0].mean_offset_cm < 1.0


def test_a_detector_that_always_answers_left_departs():
    ended, _ = _run(LEFT, SETTINGS.model_copy(update={"put_back": False}))
    assert ended.ended == "left the lane" and not ended.completed
    assert ended.departures == 1 and ended.put_backs == 0 and ended.laps < 0.3
    assert 30.0 < ended.worst_offset_cm < 34.0
    result, trajectory = _run(LEFT)
    assert result.put_backs == trajectory.put_back.sum() > 3
    assert result.departures >= result.put_backs
    # It is put back into the middle, left lines behind it.
    after = np.flatnonzero(trajectory.put_back)[:-1] + 1
    assert np.abs(trajectory.offset_cm[after]).max() < 0.5
    assert (trajectory.offset_cm[trajectory.over] > 8.0).all()


def test_without_an_answer_the_car_goes_straight_or_stands():
    straight, _ = _run(BLIND, SETTINGS.model_copy(update={"put_back": False}))
    assert straight.unanswered == 1.0 and straight.steering_rms_rad_s == 0.0
    assert straight.ended == "left the lane"
    stop = SETTINGS.pilot.model_copy(update={"keep_s": 0.0, "then": "stop"})
    stopped, _ = _run(BLIND, SETTINGS.model_copy(update={"put_back": False, "pilot": stop}))
    assert stopped.ended == "stuck" and stopped.time_s < 4.0
    moved_on, _ = _run(BLIND, SETTINGS.model_copy(update={"pilot": stop}))
    assert moved_on.put_backs > 10 and moved_on.departures == 0  # 50 cm further on each time


def test_steering_is_measured_between_put_backs_only():
    result, trajectory = _run(LEFT)
    change = np.diff(trajectory.steering_rad) * 20.0
    assert result.steering_rms_rad_s <= np.sqrt(np.mean(change**2)) + 1e-12


def test_an_open_road_is_driven_once():
    settings = JudgeSettings(tracks=("open",), count=1, laps=5, simulation=COMMON)
    result, trajectory = _run(Entrant(TRUTH), settings)
    assert result.completed and result.laps == 1.0 and result.road == "open_00"
    assert 650.0 < trajectory.s_cm[-1] - trajectory.s_cm[0] < 700.0


def test_roads_differ_and_do_not_depend_on_the_rest_of_the_contest():
    first, second = (contest_roads(SETTINGS)[index].simulation for index in (0, 1))
    assert first.seed != second.seed and first.track.closed
    more = JudgeSettings(count=7, tracks=("open", "random"), simulation=COMMON)
    assert contest_roads(more)[7].simulation == first
    assert (
        contest_roads(more)[0].simulation.seed == first.seed
        and not contest_roads(more)[0].simulation.track.closed
    )
    assert contest_roads(SETTINGS.model_copy(update={"seed": 1}))[0].simulation.seed != first.seed
    with pytest.raises(ConfigError, match="each may be named once"):
        contest_roads(JudgeSettings(tracks=("open", "open")))


@pytest.mark.parametrize("seed", [0, 1])
def test_no_road_is_one_of_a_training_run_with_the_same_seed(seed, tmp_path):
    data = DataSettings(synthetic=SyntheticSettings(seed=seed, train=20, validation=4, test=20))
    trained = {
        SyntheticJob.draw(data, role, number, tmp_path).simulation.seed
        for role in ("train", "validation", "test")
        for number in range(getattr(data.synthetic, role))
    }
    settings = JudgeSettings(seed=seed, count=20)
    judged = {contest_roads(settings)[index].simulation.seed for index in range(20)}
    assert len(judged) == 20 and not judged & trained


def test_a_start_across_is_over_when_the_car_stays_in_its_lane():
    def watched(*frames: tuple[float, bool, bool]) -> tuple[bool, bool, float]:
        watch = StartWatch(True, within_s=2.0)
        for t_s, inside, straight in frames:
            watch.update(t_s, inside, straight)
        return watch.open, watch.back, watch.after_s

    # Straight for a moment while a wheel is out, inside for a moment, then both for half a second.
    swing = ((0.0, True, False), (0.4, False, True), (0.6, True, True), (0.8, False, True))
    assert watched(*swing) == (True, False, 0.8)
    assert watched(*swing, (1.0, True, True), (1.25, True, True)) == (True, False, 1.25)
    assert watched(*swing, (1.0, True, True), (1.5, True, True)) == (False, True, 1.0)
    assert watched(*swing, (2.0, True, False)) == (False, False, 2.0)
    # Whoever is inside when the time is up may stay there for its half second.
    assert watched((1.8, True, True), (2.1, True, True)) == (True, False, 2.1)
    assert watched((1.8, True, True), (2.3, True, True)) == (False, True, 1.8)
    straight = StartWatch(False, within_s=2.0)
    assert (straight.open, straight.back, straight.after_s) == (False, True, 0.0)


def test_a_start_across_is_where_a_car_can_come_back():
    assert gentle_start_cm(_straight(), 70.0, 40.0) == 40.0
    # On a ring as tight as the car turns no place is gentle; on one four times as wide, all are.
    assert 0.0 <= gentle_start_cm(_ring(), 100.0, 0.0) <= 315.0
    assert gentle_start_cm(_ring(420.0), 100.0, 0.0) == 0.0
    # A quarter turn with a radius of 70 cm, then a straight.
    s = np.arange(0.0, 500.0)
    heading = np.minimum(s / 70.0, 0.5 * np.pi)
    xy = np.cumsum(np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0)
    curvature = np.where(heading < 0.5 * np.pi, 1.0 / 70.0, 0.0)
    bend = Track(s, xy, heading, curvature, False, 40.0, ())
    assert gentle_start_cm(bend, 70.0, 0.0) == pytest.approx(70.0 * 0.5 * np.pi - 12.5, abs=1.5)


def test_cars_start_across_their_lane_and_come_back():
    settings = SETTINGS.model_copy(update={"start_across_deg": 30.0, "distance_cm": 120.0})
    for index, side in ((0, 1.0), (1, -1.0)):
        result, trajectory = _run(Entrant(TRUTH), settings, index)
        # The rear wheels stand over the line at first: not a departure while the car is coming back.
        assert result.across_deg == 30.0 * side and result.back and 0.2 < result.back_after_s < 2.0
        assert result.completed and result.departures == 0 and not trajectory.over.any()
        assert abs(trajectory.offset_cm[0]) < 0.1
        assert side * trajectory.offset_cm[np.abs(trajectory.offset_cm).argmax()] > 3.0
        assert result.laps == pytest.approx(0.15)
    lost, _ = _run(LEFT, settings.model_copy(update={"put_back": False}))
    assert not lost.back and lost.departures == 1 and lost.ended == "left the lane"
    assert lost.back_after_s == lost.time_s


def test_varied_roads_are_of_many_kinds_and_their_presets_have_their_cars():
    settings = JudgeSettings(tracks=("varied", "mat"), count=1, counts={"varied": 12})
    roads = contest_roads(settings)
    assert [(road.kind, road.number) for road in roads] == [*(("varied", n) for n in range(12)), ("mat", 0)]
    presets = {road.simulation.track.preset for road in roads[:12]}
    assert None in presets and len(presets) > 3
    assert roads[0].simulation == contest_roads(settings.model_copy(update={"count": 2}))[0].simulation
    assert [road.simulation.seed for road in roads[:2]] == [
        road.simulation.seed for road in contest_roads(JudgeSettings(count=2))
    ]
    for road in roads:
        own = competition_cars().get(road.simulation.track.preset or "")
        width_cm, wheelbase_cm = (16.0, 26.0) if own is None else (own.track_width_cm, own.wheelbase_cm)
        assert (road.track_width_cm, road.simulation.car.wheelbase_cm) == (width_cm, wheelbase_cm)
    with pytest.raises(ConfigError, match="counts: found 'moon'"):
        contest_roads(JudgeSettings(counts={"moon": 3}))


def test_cars_of_competitions_stand_back_behind_what_the_settings_name():
    (road,) = contest_roads(JudgeSettings(tracks=("duckietown",), count=1))
    assert road.track_width_cm + 9.0 < road.simulation.track.lane_width_cm
    assert road.simulation.camera.height_cm == competition_cars()["duckietown"].camera_height_cm < 15.0
    named = JudgeSettings.model_validate(
        {
            "tracks": ("duckietown",),
            "count": 1,
            "track_width_cm": 16.0,
            "simulation": {"car": {"wheelbase_cm": 20.0}, "camera": {"height_cm": 18.0}},
        }
    )
    (road,) = contest_roads(named)
    assert road.track_width_cm == 16.0
    assert road.simulation.car.wheelbase_cm == 20.0 and road.simulation.camera.height_cm == 18.0


def test_every_competition_car_has_its_road():
    assert set(competition_cars()) == {"carolo_cup", "bfmc", "duckietown"} <= set(preset_names())


def test_an_unknown_road_is_refused():
    settings = JudgeSettings(tracks=("no-such-road",), simulation=COMMON)
    with pytest.raises(ConfigError, match="no-such-road"):
        from datagen.world.world import draw_track

        draw_track(contest_roads(settings)[0].simulation)


def test_common_track_settings_hold_for_random_roads():
    common = COMMON.model_copy(update={"track": TrackSettings(lane_width_cm=36.0)})
    settings = JudgeSettings(tracks=("random", "open"), count=1, simulation=common)
    for index in (0, 1):
        assert contest_roads(settings)[index].simulation.track.lane_width_cm == 36.0
