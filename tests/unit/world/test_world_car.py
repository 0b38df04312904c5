"""The car: the exact arc, servo, delay, errors."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from datagen.world.car.car import Car, CarSettings, advance, driven_curvature_per_cm

EXACT = CarSettings(
    steering_gain=1.0,
    steering_trim_rad=0.0,
    servo_rate_rad_s=1e12,
    delay_s=0.0,
    speed_gain=1.0,
    speed_lag_s=0.0,
    speed_noise=0.0,
    steering_noise_rad=0.0,
    understeer_speed_cm_s=None,
    rear_slip_rad_s2_per_cm=0.0,
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
    late = np.diff(_drive(_exact(delay_s=0.15), commands)[:, 2], prepend=0.0)
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
    speeds = [np.diff(_drive(noisy, commands, seed)[:, 0], prepend=0.0) / 3.0 - 1.0 for seed in range(20)]
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


def test_the_frame_rate_changes_next_to_nothing():
    car = CarSettings(delay_s=0.06)

    def end_pose(rate_hz: int) -> np.ndarray:
        moving = Car(car, np.zeros(3), np.random.default_rng(4))
        for frame in range(6 * rate_hz):
            t_s = frame // (rate_hz // 10) / 10.0  # commands change ten times per second at either rate
            moving.step(60.0 + 20.0 * np.sin(t_s), 0.3 * np.cos(1.7 * t_s), 1.0 / rate_hz)
        return moving.pose

    np.testing.assert_allclose(end_pose(10), end_pose(50), atol=0.02)


def test_a_delay_need_not_be_whole_frames():
    way = {
        delay_s: _drive(_exact(delay_s=delay_s), [(0.0, 0.0), (60.0, 0.0), (60.0, 0.0)])[-1, 0]
        for delay_s in (0.0, 0.025, 0.05)
    }
    assert way == pytest.approx({0.0: 6.0, 0.025: 4.5, 0.05: 3.0})


def test_speed_follows_with_its_time_constant():
    car = Car(_exact(speed_lag_s=0.2), np.zeros(3), np.random.default_rng(0))
    car.place(np.zeros(3), commanded_cm_s=0.0)
    for _ in range(8):
        car.step(60.0, 0.0, 0.05)
    # x(t) = v (t - T (1 - exp(-t / T))), v(t) = v (1 - exp(-t / T)), at t = 2 T.
    assert car.pose[0] == pytest.approx(60.0 * (0.4 - 0.2 * (1.0 - np.exp(-2.0))), abs=1e-9)
    assert car.speed_cm_s == pytest.approx(60.0 * (1.0 - np.exp(-2.0)))


def test_understeer_and_grip_widen_the_circle():
    kinematic = np.tan(0.3) / 26.0
    slow = driven_curvature_per_cm(0.3, 1.0, _exact(understeer_speed_cm_s=200.0))
    assert slow == pytest.approx(kinematic, rel=1e-4)
    assert driven_curvature_per_cm(0.3, 200.0, _exact(understeer_speed_cm_s=200.0)) == pytest.approx(
        0.5 * kinematic
    )
    # 100 cm/s on a radius of 84 cm asks for 119 cm/s^2; 90 are there, so that the radius is v^2 / a.
    assert driven_curvature_per_cm(-0.3, 100.0, _exact(grip_cm_s2=90.0)) == pytest.approx(-90.0 / 1e4)
    assert driven_curvature_per_cm(0.3, 80.0, _exact(grip_cm_s2=90.0)) == pytest.approx(kinematic)
    poses = _drive(_exact(grip_cm_s2=90.0), [(100.0, 0.3)] * 40)
    assert poses[-1, 2] == pytest.approx(200.0 * 90.0 / 1e4)


def test_the_rear_axle_slides_outwards():
    poses = _drive(_exact(rear_slip_rad_s2_per_cm=1e-3), [(60.0, 0.3)] * 40)
    slip = 1e-3 * 3600.0 * np.tan(0.3) / 26.0
    steps = np.diff(poses, axis=0)
    along = np.arctan2(steps[:, 1], steps[:, 0]) - 0.5 * (poses[1:, 2] + poses[:-1, 2])
    np.testing.assert_allclose(np.mod(along + np.pi, 2.0 * np.pi) - np.pi, -slip, atol=1e-6)
    np.testing.assert_allclose(poses[:, 2], _drive(EXACT, [(60.0, 0.3)] * 40)[:, 2])


def test_true_speed_and_turn_are_those_of_the_motion():
    car = Car(CarSettings(), np.zeros(3), np.random.default_rng(2))
    for _ in range(30):
        car.step(80.0, 0.2, 0.05)
    before, speed, turn = car.pose, car.speed_cm_s, car.yaw_rate_rad_s
    after = car.step(80.0, 0.2, 0.005)
    assert np.linalg.norm(after[:2] - before[:2]) / 0.005 == pytest.approx(speed, rel=0.01)
    assert (after[2] - before[2]) / 0.005 == pytest.approx(turn, rel=0.02)


def test_a_car_put_back_forgets_its_commands():
    car = Car(_exact(delay_s=0.2, servo_rate_rad_s=4.0), np.zeros(3), np.random.default_rng(0))
    for _ in range(10):
        car.step(60.0, 0.4, 0.05)
    assert car.wheels_rad > 0.3
    car.place(np.array([5.0, 6.0, 1.0]), commanded_cm_s=60.0)
    for _ in range(3):
        pose = car.step(60.0, 0.4, 0.05)
    np.testing.assert_allclose(pose, [5.0 + 9.0 * np.cos(1.0), 6.0 + 9.0 * np.sin(1.0), 1.0])
