"""The guessed camera: its geometry, its scale, and the yaw that closes a lap."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.slam.calibrate import (
    NOMINAL_HEIGHT_CM,
    GuessSettings,
    guessed_camera,
    heading_error_per_lap,
    mapping_range,
    next_yaw,
    with_known_scale,
)
from datagen.slam.places import Revisit
from lanenet.perception.birdseye import RangeSettings

GUESS = GuessSettings()


def test_the_guessed_camera_sits_ahead_of_the_rear_axle():
    camera = guessed_camera(160, 120, 80.0, 0.25, GUESS)
    m = camera.mounting
    lever = camera.wheelbase_cm + m.ahead_of_front_axle_cm
    assert lever == pytest.approx(0.9 * NOMINAL_HEIGHT_CM)
    assert camera.wheelbase_cm == GUESS.wheelbase_cm
    # The axis meets the road straight ahead, at height over tan(pitch).
    centre = camera.intersect_ground(np.array([[79.5, 59.5]]))[0]
    np.testing.assert_allclose(
        centre, [0.0, m.ahead_of_front_axle_cm + NOMINAL_HEIGHT_CM / np.tan(0.25)], atol=1e-9
    )


@pytest.mark.parametrize("factor", [0.6, 1.0, 1.7])
def test_a_known_scale_stretches_the_road_and_keeps_the_car(factor):
    camera = guessed_camera(160, 120, 80.0, 0.25, GUESS)
    scaled = with_known_scale(camera, factor, GUESS)
    assert scaled.wheelbase_cm == camera.wheelbase_cm
    assert scaled.mounting.height_cm == pytest.approx(factor * camera.mounting.height_cm)
    lever, scaled_lever = (c.wheelbase_cm + c.mounting.ahead_of_front_axle_cm for c in (camera, scaled))
    assert scaled_lever == pytest.approx(factor * lever)
    # Seen from the rear axle, where poses are, every point of the road is `factor` as far.
    pixels = np.array([[80.0, 80.0], [20.0, 100.0], [140.0, 70.0]])
    rear = np.array([0.0, camera.wheelbase_cm])
    np.testing.assert_allclose(
        scaled.intersect_ground(pixels) + rear, factor * (camera.intersect_ground(pixels) + rear)
    )


def test_the_mapping_range_grows_with_the_camera():
    base = RangeSettings(top_row=40, bottom_rows=7)
    small, large = mapping_range(10.0, base), mapping_range(20.0, base)
    assert (small.far_cm, small.side_cm, small.max_cm_per_px) == pytest.approx((60.0, 60.0, 3.0))
    assert large.far_cm == pytest.approx(2.0 * small.far_cm)
    assert (large.top_row, large.bottom_rows) == (40, 7)


@pytest.mark.parametrize("direction", [1.0, -1.0])
@pytest.mark.parametrize("drift", [0.5, -0.4, 0.0])
def test_heading_error_is_what_a_lap_misses(direction, drift):
    heading = np.linspace(0.0, direction * 4.0 * np.pi + 2.0 * drift, 201)
    poses = np.column_stack([np.zeros((201, 2)), heading])
    revisits = [Revisit(k, k + 100, np.array([1.0, -2.0, 0.0]), 0.8) for k in range(0, 100, 10)]
    assert heading_error_per_lap(poses, revisits) == pytest.approx(drift, abs=1e-9)
    # A revisit at an angle is not drift, and one wrong revisit does not move the median.
    poses[150, 2] += 0.3
    revisits[5] = Revisit(50, 150, np.array([1.0, -2.0, 0.3]), 0.8)
    revisits[0] = Revisit(0, 70, np.array([0.0, 0.0, 0.0]), 0.8)
    assert heading_error_per_lap(poses, revisits) == pytest.approx(drift, abs=1e-9)


def test_the_first_yaw_takes_the_usual_sensitivity():
    # One degree of yaw turns a lap by about 30.
    assert next_yaw([(0.0, 0.6)]) == pytest.approx(-0.02)
    assert next_yaw([(0.01, -0.3)]) == pytest.approx(0.02)


def test_the_next_yaw_follows_the_secant():
    # Error = 20 (yaw - 0.03): the secant hits the zero.
    assert next_yaw([(0.0, -0.6), (0.02, -0.2)]) == pytest.approx(0.03)
    # A sensitivity of the other sign is believed when it is large enough,
    assert next_yaw([(0.0, 0.6), (0.02, 0.2)]) == pytest.approx(0.03)
    # and a flat one, or two tries at one yaw, are not.
    assert next_yaw([(0.0, 0.30), (0.02, 0.27)]) == pytest.approx(0.02 - 0.27 / 30.0)
    assert next_yaw([(0.02, 0.30), (0.02, 0.27)]) == pytest.approx(0.02 - 0.27 / 30.0)


@pytest.mark.parametrize("error", [10.0, -10.0])
def test_a_step_of_yaw_is_bounded_to_three_degrees(error):
    step = next_yaw([(0.01, error)]) - 0.01
    assert abs(step) == pytest.approx(np.deg2rad(3.0), abs=1e-3)
    assert np.sign(step) == -np.sign(error)


def test_iterating_converges_for_a_bent_response():
    def error(yaw: float) -> float:
        return 24.0 * (yaw + 0.045) + 120.0 * (yaw + 0.045) ** 2

    tried = [(0.0, error(0.0))]
    for _ in range(5):
        yaw = next_yaw(tried)
        tried.append((yaw, error(yaw)))
    assert abs(tried[-1][1]) < 1e-3
