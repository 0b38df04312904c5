"""A simulated car steers by what it sees; its images are as calibrated, or pitched."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from datagen.judge.run import Entrant, build_pilot
from datagen.judge.settings import JudgeSettings, contest_roads
from datagen.world.car.driver import Pilot, Sight
from datagen.world.simulate import ClosedLoop
from datagen.world.world import assemble_world
from lanenet.geometry.camera import Camera
from lanenet.perception.camera_check import CameraCheck, Concern
from lanenet.perception.network.detector import NetworkDetector

pytestmark = pytest.mark.slow
MODEL = Path(__file__).resolve().parents[2] / "checkpoints" / "small"
SETTINGS = JudgeSettings()


class Watched:
    """A pilot whose images are moved down by some pixels and compared with the camera's calibration."""

    needs_image = True

    def __init__(self, pilot: Pilot, camera: Camera, down_px: float) -> None:
        self._pilot, self._check = pilot, CameraCheck(camera)
        self._move = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, down_px]])
        self.concerns = {Concern.NONE}

    def steer(self, sight: Sight) -> float:
        assert sight.image_bgr is not None
        height, width = sight.image_bgr.shape[:2]
        image = cv2.warpAffine(sight.image_bgr, self._move, (width, height), borderMode=cv2.BORDER_REPLICATE)
        seen = Sight(image, sight.pose, sight.s_cm, sight.t_s, sight.speed_cm_s, sight.steering_rad)
        steering_rad = self._pilot.steer(seen)
        if math.isfinite(steering_rad):
            self.concerns.add(self._check.look(image, sight.t_s, sight.steering_rad).concern)
        return steering_rad

    def reset(self) -> None:
        self._pilot.reset()


@pytest.mark.parametrize(("pitch_deg", "worst"), [(0.0, {Concern.NONE}), (-5.0, {Concern.STOP})])
@pytest.mark.parametrize("road", [0, 1])
def test_a_driving_car_notices_its_camera(road: int, pitch_deg: float, worst: set[Concern]) -> None:
    world = assemble_world(contest_roads(SETTINGS)[road].simulation)
    entrant = Entrant(
        "network", lambda camera, width_cm, _: NetworkDetector(MODEL, camera, lane_width_cm=width_cm)
    )
    down_px = float(world.camera.K[1, 1]) * math.radians(pitch_deg)
    pilot = Watched(build_pilot(world, entrant, SETTINGS.pilot), world.camera, down_px)
    loop = ClosedLoop(world, pilot, SETTINGS.pilot, SETTINGS.speed_cm_s)
    for _ in range(160):
        loop.next_frame()
    assert {max(pilot.concerns)} == worst
