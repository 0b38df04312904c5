"""Closed loop: pilots, what happens when the lane is lost, drives written by a pilot or by processes."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from datagen.world.car.camera import CameraSettings
from datagen.world.car.driver import (
    DetectorPilot,
    DriverPilot,
    LostLane,
    PilotSettings,
    Sight,
    TruePointsPilot,
    control_settings,
)
from datagen.world.render.appearance import Appearance
from datagen.world.road.track_settings import TrackSettings
from datagen.world.simulate import ClosedLoop, simulate_drive
from datagen.world.world import SimulationSettings, World, assemble_world
from lanenet.control.controller import ControlSettings, LaneController
from lanenet.data.drives import open_drive
from lanenet.perception.estimate import LaneEstimate

SMALL = CameraSettings(width=64, height=48)


def _control(**changes: object) -> ControlSettings:
    return control_settings(PilotSettings.model_validate(changes), 26.0, 0.45, 40.0)


class Recorder:
    """A detector that keeps what it was shown and always answers the same."""

    def __init__(self, estimate: LaneEstimate) -> None:
        self.estimate, self.seen, self.resets = estimate, [], 0

    def detect(self, frame_bgr: np.ndarray) -> LaneEstimate:
        self.seen.append(np.array(frame_bgr))
        return self.estimate

    def reset(self) -> None:
        self.resets += 1


def _lane(shift_cm: float) -> LaneEstimate:
    points = np.repeat([-20.0 + shift_cm, 20.0 + shift_cm], 3)
    return LaneEstimate(points_cm=points, steering_rad=0.7)


def _loop(
    pilot: DetectorPilot | TruePointsPilot | DriverPilot, world: World, **changes: object
) -> ClosedLoop:
    return ClosedLoop(world, pilot, PilotSettings(**changes), 60.0)


def _world(**changes: object) -> World:
    settings = {"camera": SMALL, "track": TrackSettings(closed=True), "seed": 2, **changes}
    return assemble_world(SimulationSettings(**settings))


def test_a_lost_lane_keeps_the_steering_then_goes_straight_or_stops():
    for then, speed_cm_s in (("straight", 60.0), ("stop", 0.0)):
        lost = LostLane(PilotSettings(keep_s=0.3, then=then), rate_hz=10.0)
        assert lost.command(math.nan, 60.0) == (60.0, 0.0)  # nothing to keep yet
        assert lost.command(0.2, 60.0) == (60.0, 0.2)
        assert [lost.command(math.nan, 60.0) for _ in range(3)] == [(60.0, 0.2)] * 3
        assert lost.command(math.nan, 60.0) == (speed_cm_s, 0.0)
        assert lost.command(-0.1, 60.0) == (60.0, -0.1)
        lost.reset()
        assert lost.command(math.nan, 60.0) == (60.0, 0.0)


def test_a_detector_steers_by_its_points_or_by_its_own_target():
    sight = Sight(np.zeros((4, 4, 3), np.uint8), np.zeros(3), 0.0)
    pursuit = DetectorPilot(Recorder(_lane(-5.0)), _control(law="pure-pursuit"))
    assert pursuit.steer(sight) == pytest.approx(math.atan(26.0 * 10.0 / (41.0**2 + 25.0)))
    proportional = DetectorPilot(Recorder(_lane(-5.0)), _control())
    assert proportional.steer(sight) == pytest.approx(math.atan(5.0 / 15.0))
    own = DetectorPilot(Recorder(_lane(-5.0)), _control(law="own"))
    assert own.steer(sight) == 0.45  # 0.7 is more than the servo can
    assert math.isnan(DetectorPilot(Recorder(LaneEstimate()), _control(law="own")).steer(sight))
    with pytest.raises(ValueError, match="needs an image"):
        pursuit.steer(Sight(None, np.zeros(3), 0.0))


def test_a_doubtful_frame_moves_the_wheels_less_than_a_sure_one():
    image = np.zeros((4, 4, 3), np.uint8)

    def steered(sigma_cm: float, **changes: object) -> float:
        detector = Recorder(replace(_lane(0.0), sigma_cm=np.full(6, 0.5), confidence=1.0))
        pilot = DetectorPilot(detector, _control(**changes))
        pilot.steer(Sight(image, np.zeros(3), 0.0))
        detector.estimate = replace(_lane(-5.0), sigma_cm=np.full(6, sigma_cm), confidence=1.0)
        return pilot.steer(Sight(image, np.zeros(3), 3.0, 0.05, 60.0, 0.0))

    at_once = math.atan(5.0 / 15.0)
    assert steered(8.0) < 0.1 * at_once < 0.4 * at_once < steered(0.5) < at_once
    assert steered(8.0, smoothing={"enabled": False}) == pytest.approx(at_once)


def test_a_detector_steers_as_the_controller_of_the_car_does():
    rng = np.random.default_rng(5)
    image, detector = np.zeros((4, 4, 3), np.uint8), Recorder(_lane(0.0))
    pilot, controller = DetectorPilot(detector, _control()), LaneController(_control())
    steered, wished = [], []
    for frame in range(30):
        points_cm = _lane(rng.normal()).points_cm
        points_cm[3:] = np.nan if frame % 3 == 2 else points_cm[3:]
        detector.estimate = LaneEstimate(points_cm, np.full(6, 0.5), confidence=rng.uniform())
        told = (60.0 * (frame > 0), rng.normal(0.0, 0.1))
        steered.append(pilot.steer(Sight(image, np.zeros(3), 3.0 * frame, 0.05 * frame, *told)))
        wished.append(controller.target(detector.estimate, 0.05 * frame, *told).steering_rad)
        if frame == 20:
            pilot.reset()
            controller.reset()
    assert steered == wished
    assert np.isfinite(steered).all()
    assert np.std(steered) > 0.01


def test_the_loop_tells_the_pilot_when_it_looks_and_what_was_commanded():
    world, sights = _world(), []

    class Watcher(TruePointsPilot):
        def steer(self, sight: Sight) -> float:
            sights.append(sight)
            return super().steer(sight)

    loop = _loop(Watcher(world.track, _control().steering), world)
    states = [loop.next_frame().state for _ in range(3)]
    loop.put_back()
    states.append(loop.next_frame().state)
    assert [sight.t_s for sight in sights] == [state.t_s for state in states]
    commanded = [(0.0, 0.0), *((state.speed_cm_s, state.steering_rad) for state in states[:2]), (0.0, 0.0)]
    assert [(sight.speed_cm_s, sight.steering_rad) for sight in sights] == commanded


def test_a_perfect_detector_stays_in_the_lane():
    world = _world()
    loop = _loop(TruePointsPilot(world.track, _control().steering), world)
    frames = [loop.next_frame() for _ in range(200)]
    assert all(frame.answered and frame.image_bgr is None for frame in frames)
    assert max(abs(frame.offset_cm) for frame in frames) < 8.0
    assert frames[-1].s_cm > 500.0


def test_a_detector_that_sees_the_lane_on_the_left_leaves_it_there():
    world = _world()
    loop = _loop(DetectorPilot(Recorder(_lane(-15.0)), _control()), world)
    offsets_cm = [loop.next_frame().offset_cm for _ in range(24)]
    assert offsets_cm[-1] > 15.0
    loop.put_back()
    assert abs(loop.next_frame().offset_cm) < 0.5


def test_putting_back_resets_the_detector_and_keeps_the_place():
    world, detector = _world(), Recorder(_lane(-15.0))
    loop = _loop(DetectorPilot(detector, _control()), world)
    for _ in range(15):
        before = loop.next_frame()
    loop.put_back(ahead_cm=30.0)
    after = loop.next_frame()
    assert detector.resets == 1
    assert after.s_cm == pytest.approx(before.s_cm + 30.0, abs=0.1)
    assert after.state.true_speed_cm_s == pytest.approx(60.0 * 0.94, rel=0.12)
    assert after.state.frame == 15


def test_the_pilot_sees_what_the_file_holds(tmp_path: Path):
    detector = Recorder(_lane(0.0))
    settings = SimulationSettings(
        seed=1, frames=5, camera=SMALL, random_look=False, look=Appearance(noise_level=6.0, jpeg_quality=60)
    )
    out = simulate_drive(settings, tmp_path / "d", pilot=lambda world: DetectorPilot(detector, _control()))
    drive = open_drive(out)
    assert len(drive) == len(detector.seen) == 5
    for i, seen in enumerate(detector.seen):
        np.testing.assert_array_equal(drive.image(i), seen)
    np.testing.assert_allclose(drive.commands.steering_rad, 0.0, atol=1e-9)


def test_a_drive_by_a_pilot_without_eyes_has_images_too(tmp_path: Path):
    settings = SimulationSettings(seed=1, frames=4, camera=SMALL)
    out = simulate_drive(settings, tmp_path / "d", pilot=lambda world: DriverPilot(world.driver))
    assert open_drive(out).image(3).shape == (48, 64, 3)


def test_two_processes_write_the_same_bytes(tmp_path: Path):
    settings = SimulationSettings(seed=9, frames=40, camera=SMALL)
    calls: list[tuple[int, int]] = []
    one = simulate_drive(settings, tmp_path / "one")
    two = simulate_drive(settings, tmp_path / "two", lambda *done: calls.append(done), workers=2)
    assert calls == [(k, 40) for k in range(1, 41)]
    names = sorted(path.relative_to(one) for path in one.rglob("*") if path.is_file())
    assert names == sorted(path.relative_to(two) for path in two.rglob("*") if path.is_file())
    assert len(names) == 40 + 6
    for name in names:
        assert (one / name).read_bytes() == (two / name).read_bytes(), name
