from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from datagen.world.car.camera import CameraSettings
from datagen.world.car.driver import PilotSettings, Sight
from datagen.world.road.track_settings import TrackSettings
from datagen.world.simulate import ClosedLoop
from datagen.world.world import SimulationSettings, World, build_world
from lanenet.config import check_settings
from lanenet.control.controller import ControlSettings, LaneController
from lanenet.perception.estimate import LaneEstimate

RATE_HZ, SPEED_CM_S, FRAMES = 30.0, 60.0, 500
NOISE_CM = 1.0


class NoisyEyes:
    """The true lane with noise, steered by the car's own controller; the right line is missing at times."""

    needs_image = False

    def __init__(self, world: World, smoothing: bool, seed: int) -> None:
        self._track, self._wheelbase_cm = world.track, world.settings.car.wheelbase_cm
        steering = {"wheelbase_cm": self._wheelbase_cm}
        self._controller = LaneController(
            check_settings(
                ControlSettings, {"steering": steering, "smoothing": {"enabled": smoothing}}, "test"
            )
        )
        self._rng = np.random.default_rng(seed)
        self._frame = 0

    def steer(self, sight: Sight) -> float:
        points_cm = self._track.truth(sight.pose, self._wheelbase_cm, sight.s_cm)
        points_cm = points_cm + self._rng.normal(0.0, NOISE_CM, 6)
        if self._frame % 40 >= 30:
            points_cm[3:] = np.nan
        estimate = LaneEstimate(points_cm, np.full(6, NOISE_CM), confidence=1.0)
        self._frame += 1
        return self._controller.target(estimate, sight.t_s, sight.speed_cm_s, sight.steering_rad).steering_rad

    def reset(self) -> None:
        self._controller.reset()


@dataclass(frozen=True)
class Driven:
    answered: float
    offset_rms_cm: float
    offset_worst_cm: float
    jerk_rad: float


def drive(seed: int, smoothing: bool) -> Driven:
    settings = SimulationSettings(
        seed=seed,
        frames=FRAMES,
        rate_hz=RATE_HZ,
        camera=CameraSettings(width=16, height=16),
        track=TrackSettings(min_radius_cm=70.0),
        random_look=False,
    )
    world = build_world(settings)
    loop = ClosedLoop(world, NoisyEyes(world, smoothing, seed), PilotSettings(keep_s=0.0), SPEED_CM_S)
    frames = [loop.next_frame() for _ in range(FRAMES)]
    offsets = np.array([frame.offset_cm for frame in frames])
    steering = np.array([frame.state.steering_rad for frame in frames])
    return Driven(
        float(np.mean([frame.answered for frame in frames])),
        float(np.sqrt(np.mean(offsets**2))),
        float(np.abs(offsets).max()),
        float(np.diff(steering).std()),
    )


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3))])
def test_smoothing_calms_the_steering_and_keeps_the_lane(seed: int) -> None:
    plain, smooth = drive(seed, False), drive(seed, True)
    # One line is enough, thanks to the width of the frames before.
    assert plain.answered == smooth.answered == 1.0
    # The lane is 40 cm wide and the car some 18.
    assert smooth.offset_worst_cm < 8.0
    assert smooth.offset_rms_cm < plain.offset_rms_cm + 0.5
    assert smooth.jerk_rad < 0.5 * plain.jerk_rad
