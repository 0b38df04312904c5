from __future__ import annotations

import math

import numpy as np
import pytest

from lanenet.config import check_settings
from lanenet.control.controller import (
    ControlSettings,
    LaneController,
    SpeedSettings,
    curve_speed_cm_s,
    lane_curvature_per_cm,
    throttle_of,
)
from lanenet.errors import ConfigError
from lanenet.geometry.lane import ROWS_CM, lane_width_cm
from lanenet.perception.estimate import LaneEstimate

ROWS = np.array(ROWS_CM)


def lane(centre_cm: float = 0.0, width_cm: float = 40.0, bend: float = 0.0) -> np.ndarray:
    middle = centre_cm + bend * ROWS**2
    return np.concatenate([middle - 0.5 * width_cm, middle + 0.5 * width_cm])


def settings(**changes: object) -> ControlSettings:
    return check_settings(ControlSettings, {"steering": {"wheelbase_cm": 26.0}, **changes}, "test")


def test_speed_in_a_bend_keeps_the_sideways_acceleration() -> None:
    speed = SpeedSettings(cruise_cm_s=100.0, least_cm_s=20.0, max_lateral_cm_s2=150.0)
    assert curve_speed_cm_s(0.0, speed) == 100.0
    # v^2 / r = 150 on a radius of 50 cm.
    assert curve_speed_cm_s(1.0 / 50.0, speed) == pytest.approx(math.sqrt(150.0 * 50.0))
    assert curve_speed_cm_s(1.0, speed) == 20.0
    assert curve_speed_cm_s(math.nan, speed) == 20.0


def test_throttle_follows_the_timed_stretch() -> None:
    speed = SpeedSettings(throttle_at_rest=0.1, cm_s_per_throttle=400.0)
    assert throttle_of(60.0, speed) == pytest.approx(0.25)
    assert throttle_of(0.0, speed) == 0.0 and throttle_of(math.nan, speed) == 0.0
    assert throttle_of(1e6, speed) == 1.0


def test_speeds_in_the_wrong_order_are_refused() -> None:
    with pytest.raises(ConfigError, match="least_cm_s"):
        check_settings(SpeedSettings, {"cruise_cm_s": 10.0, "least_cm_s": 30.0}, "test")


def test_curvature_of_a_known_parabola() -> None:
    # x = 0.01 y^2: 0.02 / (1 + 0.3^2)^1.5 at y = 15, of either line alone as well.
    expected = 0.02 / 1.09**1.5
    both = LaneEstimate(lane(bend=0.01))
    one = LaneEstimate(np.where(np.arange(6) < 3, np.nan, lane(bend=0.01)))
    assert lane_curvature_per_cm(both, 15.0) == pytest.approx(expected)
    assert lane_curvature_per_cm(one, 15.0) == pytest.approx(expected)
    assert math.isnan(lane_curvature_per_cm(LaneEstimate(), 15.0))


def test_width_is_measured_across_the_lane() -> None:
    slope = 0.5
    half = 20.0 * math.hypot(1.0, slope)
    assert lane_width_cm(np.concatenate([slope * ROWS - half, slope * ROWS + half])) == pytest.approx(40.0)
    assert lane_width_cm(np.concatenate([lane()[3:], lane()[:3]])) < 0.0
    assert math.isnan(lane_width_cm(np.full(6, np.nan)))


def test_one_line_is_enough_once_the_width_is_known() -> None:
    one = np.where(np.arange(6) < 3, np.nan, lane(5.0))
    no_smoothing = {"smoothing": {"enabled": False}}
    forgetful = LaneController(settings(**no_smoothing, width_memory=False))
    for k in range(20):
        forgetful.target(LaneEstimate(lane(), confidence=1.0), 0.03 * k)
    assert math.isnan(forgetful.target(LaneEstimate(one, confidence=1.0), 0.6).steering_rad)
    controller = LaneController(settings(**no_smoothing))
    assert controller.lane_width_cm is None
    for k in range(20):
        both = controller.target(LaneEstimate(lane(5.0), confidence=1.0), 0.03 * k)
    assert controller.lane_width_cm == pytest.approx(40.0, rel=0.01)
    fallback = controller.target(LaneEstimate(one, confidence=1.0), 0.6)
    assert fallback.steering_rad == pytest.approx(both.steering_rad, abs=1e-3)
    controller.reset()
    assert controller.target(LaneEstimate(one, confidence=1.0), 0.0).steering_rad == fallback.steering_rad


def test_a_wrong_width_moves_the_memory_little() -> None:
    controller = LaneController(settings())
    for k in range(200):
        controller.target(
            LaneEstimate(lane(width_cm=80.0 if k % 10 == 0 else 40.0), confidence=1.0), 0.03 * k
        )
    assert controller.lane_width_cm == pytest.approx(40.0, abs=1.0)
    doubtful = LaneController(settings())
    guessed = LaneController(settings())
    for k in range(20):
        doubtful.target(LaneEstimate(lane(), confidence=0.2), 0.03 * k)
        # Six points of a network that does not see the right line.
        guessed.target(LaneEstimate(lane(), confidence=1.0, presence=np.array([1.0, 0.2])), 0.03 * k)
    assert doubtful.lane_width_cm is None and guessed.lane_width_cm is None


def test_a_given_width_stays() -> None:
    controller = LaneController(settings(steering={"wheelbase_cm": 26.0, "lane_width_cm": 35.0}))
    for k in range(20):
        controller.target(LaneEstimate(lane(width_cm=40.0), confidence=1.0), 0.03 * k)
    assert controller.lane_width_cm == 35.0


def test_a_bend_slows_down_and_an_unknown_lane_has_no_answer() -> None:
    controller = LaneController(settings(speed={"cruise_cm_s": 200.0}))
    straight = controller.target(LaneEstimate(lane(), confidence=1.0), 0.0)
    assert straight.steering_rad == pytest.approx(0.0) and straight.speed_cm_s == 200.0
    controller.reset()
    bend = controller.target(LaneEstimate(lane(bend=-0.01), confidence=1.0), 0.0)
    assert bend.steering_rad > 0.0 and 30.0 <= bend.speed_cm_s < 100.0
    controller.reset()
    nothing = controller.target(LaneEstimate(), 0.0)
    assert math.isnan(nothing.steering_rad) and nothing.speed_cm_s == 30.0


def test_smoothing_does_not_carry_a_blind_frame() -> None:
    controller = LaneController(settings())
    controller.target(LaneEstimate(lane(), confidence=1.0), 0.0)
    assert math.isnan(controller.target(LaneEstimate(confidence=1.0), 0.03).steering_rad)


class Passenger:
    """A detector that only writes down how it was moved."""

    def __init__(self) -> None:
        self.motions: list[tuple[float, float, float]] = []

    def detect(self, frame_bgr: np.ndarray) -> LaneEstimate:
        return LaneEstimate(lane(), confidence=1.0)

    def reset(self) -> None:
        pass

    def moved(self, travel_cm: float, turn_rad: float, wheelbase_cm: float) -> None:
        self.motions.append((travel_cm, turn_rad, wheelbase_cm))


def test_a_detector_that_follows_the_lane_is_told_how_the_car_moves() -> None:
    controller, detector = LaneController(settings()), Passenger()
    wheelbase_cm = settings().steering.wheelbase_cm
    for t_s in (1.0, 1.05):
        controller.tell(detector, t_s, 60.0, 0.2)
        controller.target(detector.detect(np.zeros((2, 2, 3), np.uint8)), t_s, 60.0, 0.2)
    # Nothing is known of the time before the first frame.
    (motion,) = detector.motions
    assert motion == pytest.approx((3.0, 3.0 * math.tan(0.2) / wheelbase_cm, wheelbase_cm))


def test_the_detectors_own_target_stays_within_the_lock() -> None:
    controller = LaneController(settings(own_target=True))
    assert controller.target(LaneEstimate(steering_rad=0.1), 0.0).steering_rad == 0.1
    assert controller.target(LaneEstimate(steering_rad=-1.5), 0.03).steering_rad == -0.45
    assert math.isnan(controller.target(LaneEstimate(), 0.06).steering_rad)
