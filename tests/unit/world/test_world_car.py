"""The car: the exact arc, servo, delay, errors."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from datagen.world.car import Car, CarSettings, advance

EXACT = CarSettings(
    steering_gain=1.0,
    steering_trim_rad=0.0,
    servo_rate_rad_s=1e6,
    delay_frames=0,
    speed_gain=1.0,
    speed_noise=0.0,
    steering_noise_rad=0.0,
)


def _exact(**changes: object) -> CarSettings:
    return EXACT.model_copy(update=changes)


def _drive(settings: CarSettings, commands: list[tuple[float, float]], seed: int = 0) -> np.ndarray:
    car = Car(settings, np.zeros(3), np.random.default_rng(seed))
    return np.array([car.step(v, b, 0.05) for v, b in commands])


def test_constant_steering_makes_the_analytic_circle():
    poses = _drive(EXACT, [(60.0, 0.3)] * 200)
    radius = 26.0 / np.tan(0.3)
    angle = np.arange(1, 201) * 3.0 / radius
    np.testing.assert_allclose(poses[:, 0], radius * np.sin(angle), atol=1e-9)
    np.testing.assert_allclose(poses[:, 1], radius * (1.0 - np.cos(angle)), atol=1e-9)
    np.testing.assert_allclose(poses[:, 2], angle, atol=1e-9)  # not wrapped


def test_positive_steering_turns_left_and_zero_goes_straight():
    assert _drive(EXACT, [(60.0, 0.2)] * 10)[-1, 1] > 0.0
    np.testing.assert_allclose(_drive(EXACT, [(60.0, 0.0)] * 10)[-1], [30.0, 0.0, 0.0], atol=1e-12)


@given(
    distance=st.floats(-20.0, 20.0),
    steering=st.floats(-0.45, 0.45),
    heading=st.floats(-10.0, 10.0),
    share=st.floats(0.0, 1.0),
)
def test_a_step_is_the_sum_of_its_parts(distance, steering, heading, share):
    start = np.array([3.0, -2.0, heading])
    whole = advance(start, distance, steering, 26.0)
    part = advance(start, share * distance, steering, 26.0)
    np.testing.assert_allclose(advance(part, (1.0 - share) * distance, steering, 26.0), whole, atol=1e-9)


def test_small_steps_agree_with_the_euler_form_of_the_paper():
    pose, speed, dt, beta = np.array([0.0, 0.0, 0.4]), 60.0, 1e-4, 0.3
    euler = pose + dt * np.array([speed * np.cos(0.4), speed * np.sin(0.4), speed / 26.0 * np.tan(beta)])
    np.testing.assert_allclose(advance(pose, speed * dt, beta, 26.0), euler, atol=1e-6)


def test_gain_trim_and_stop():
    def curvature(settings: CarSettings, command: float) -> float:
        return float(_drive(settings, [(20.0, command)] * 5)[-1, 2]) / 5.0

    assert curvature(_exact(steering_gain=0.8), 0.25) == pytest.approx(np.tan(0.2) / 26.0)
    assert curvature(_exact(steering_trim_rad=0.05), 0.0) == pytest.approx(np.tan(0.05) / 26.0)
    assert curvature(EXACT, 1.2) == pytest.approx(np.tan(0.45) / 26.0)
    assert _drive(_exact(speed_gain=0.5), [(60.0, 0.0)] * 4)[-1, 0] == pytest.approx(6.0)


def test_a_command_arrives_late_and_the_servo_takes_time():
    commands = [(60.0, 0.0)] * 2 + [(60.0, 0.4)] * 10
    late = np.diff(_drive(_exact(delay_frames=3), commands)[:, 2], prepend=0.0)
    assert np.flatnonzero(late)[0] == 2 + 3
    car = Car(_exact(servo_rate_rad_s=2.0), np.zeros(3), np.random.default_rng(0))
    angles = []
    for _ in range(6):
        car.step(60.0, 0.4, 0.05)
        angles.append(car.wheels_rad)
    np.testing.assert_allclose(angles, [0.1, 0.2, 0.3, 0.4, 0.4, 0.4])


def test_noise_is_seeded_unbiased_and_of_the_stated_size():
    noisy = _exact(speed_noise=0.05)
    commands = [(60.0, 0.0)] * 400
    np.testing.assert_array_equal(_drive(noisy, commands, 3), _drive(noisy, commands, 3))
    speeds = [np.diff(_drive(noisy, commands, seed)[:, 0], prepend=0.0) / 3.0 - 1.0 for seed in range(30)]
    assert abs(np.mean(speeds)) < 0.005
    assert np.std(speeds) == pytest.approx(0.05, rel=0.1)
    # It varies slowly: neighbours are alike.
    flat = np.concatenate([s[1:] * s[:-1] for s in speeds])
    assert flat.mean() / np.var(speeds) == pytest.approx(np.exp(-0.05 / 0.7), abs=0.03)


def test_steering_noise_does_not_move_the_speed():
    commands = [(60.0, 0.0)] * 50
    quiet = _drive(_exact(speed_noise=0.03), commands)
    both = _drive(_exact(speed_noise=0.03, steering_noise_rad=0.01), commands)
    way = [np.hypot(*np.diff(p[:, :2], axis=0).T) for p in (quiet, both)]
    np.testing.assert_allclose(way[0], way[1], rtol=1e-5)
