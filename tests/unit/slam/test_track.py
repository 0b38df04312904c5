"""Commands to predictions, the fit of the steering, and tracking with both."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from picture_road import made_up_drive
from pixel_road import fisheye, pixels
from tape_road import HEIGHT_CM, STEP_CM, tape_road

from datagen.slam.commands import CommandedMotion, commands_of, delayed, fit_steering
from datagen.slam.filter.dp_slam import FilterSettings
from datagen.slam.odometry.image_pairs import ImagePairs, OdometrySettings
from datagen.slam.odometry.odometry import Odometry, typical_step
from datagen.slam.settings import MotionSettings, SlamSettings
from datagen.slam.track import motion_about, track
from datagen.slam.view import RoadView, SegmentView
from lanenet.data.drives.recording import Commands, Drive
from lanenet.perception.edges.road import RangeSettings


class _NoImages:
    def read(self, row: int) -> np.ndarray:
        raise AssertionError("commands need no image")


def _drive(t_s: list[float], **commands: list[float]) -> Drive:
    n = len(t_s)
    return Drive(
        name="made-up",
        path=Path("made-up"),
        frames=np.arange(n),
        t_s=np.array(t_s),
        times_trusted=True,
        commands=Commands(**{name: np.array(values) for name, values in commands.items()}),
        deleted=np.zeros(n, dtype=bool),
        breaks=np.zeros(n, dtype=bool),
        camera=None,
        lane_width_cm=None,
        problems=(),
        width=160,
        height=120,
        images=_NoImages(),
        rows=np.arange(n),
    )


def test_delayed_repeats_the_first_value():
    values = np.array([1.0, 2.0, 3.0, 4.0])
    np.testing.assert_array_equal(delayed(values, 0), values)
    np.testing.assert_array_equal(delayed(values, 2), [1.0, 1.0, 1.0, 2.0])
    np.testing.assert_array_equal(delayed(values, 9), np.ones(4))


def test_speed_and_steering_give_distance_and_curvature():
    drive = _drive([0.0, 0.1, 0.3, 0.4], speed_cm_s=[50.0] * 4, steering_rad=[0.0, 0.2, -0.2, 0.3])
    commands = commands_of(drive, 26.0)
    assert commands.speed_known
    np.testing.assert_allclose(commands.distance_cm, [0.0, 5.0, 10.0, 5.0])
    assert commands.turn is not None
    # The bicycle model: curvature = tan(steering) / wheelbase, positive left.
    np.testing.assert_allclose(commands.turn, np.tan([0.0, 0.2, -0.2, 0.3]) / 26.0)


def test_donkeycar_full_left_turns_left():
    commands = commands_of(_drive([0.0, 0.05, 0.1], angle=[-1.0, 0.0, 0.5]), 17.0)
    assert not commands.speed_known
    assert commands.turn is not None
    np.testing.assert_array_equal(commands.turn, [1.0, 0.0, -0.5])
    # Without a speed, distance is in usual time steps; the first frame has no step before it.
    np.testing.assert_allclose(commands.distance_cm, [0.0, 1.0, 1.0])


def test_a_step_over_a_gap_is_as_long_as_its_time():
    times_s = [0.0, 0.05, 0.1, 0.15, 0.35, 0.4, 3.4]
    drive = _drive(times_s, angle=[0.0] * 7)
    commands = commands_of(drive, 17.0)
    # In a long gap the car may have stopped.
    np.testing.assert_allclose(commands.distance_cm, [0.0, 1.0, 1.0, 1.0, 4.0, 1.0, 20.0], rtol=1e-9)
    np.testing.assert_allclose(commands.periods, [1.0, 1.0, 1.0, 1.0, 4.0, 1.0, 60.0], rtol=1e-9)
    np.testing.assert_array_equal(commands.part, [0, 0, 0, 0, 0, 0, 1])
    # Time in which it stood, in frames that were left out, is not driven.
    stood = replace(drive, standing_s=np.array([0.0] * 6 + [2.95]))
    np.testing.assert_allclose(commands_of(stood, 17.0).distance_cm[-1], 1.0, rtol=1e-9)


def test_yaw_rate_over_speed_is_curvature():
    commands = commands_of(
        _drive([0.0, 0.1, 0.2], speed_cm_s=[40.0, 40.0, 0.0], yaw_rate_rad_s=[0.4, -0.8, 0.0]), 26.0
    )
    assert commands.turn is not None
    np.testing.assert_allclose(commands.turn, [0.01, -0.02, 0.0])


def test_steering_counts_before_the_angle():
    commands = commands_of(_drive([0.0, 0.1], steering_rad=[0.1, 0.1], angle=[1.0, 1.0]), 20.0)
    assert commands.turn is not None
    np.testing.assert_allclose(commands.turn, np.tan(0.1) / 20.0)


def test_rows_without_a_command_hold_the_last_one():
    nan = float("nan")
    drive = _drive(
        [0.0, 0.1, 0.2, 0.3, 0.4], speed_cm_s=[nan, 30.0, nan, nan, 60.0], angle=[nan, nan, -0.4, nan, 0.2]
    )
    commands = commands_of(drive, 17.0)
    np.testing.assert_allclose(commands.distance_cm, [0.0, 3.0, 3.0, 3.0, 6.0])
    assert commands.turn is not None
    np.testing.assert_allclose(commands.turn, [0.0, 0.0, 0.4, 0.4, -0.2])


def test_a_drive_without_commands_has_no_turn():
    assert commands_of(_drive([0.0, 0.1, 0.2]), 17.0).turn is None


def _answer(
    rng: np.random.Generator, gain: float, trim: float, lag: int, noise_rad: float, n: int = 400
) -> tuple[np.ndarray, CommandedMotion]:
    """Poses of a path whose curvature answers to a slowly changing command."""
    turn = np.convolve(rng.normal(size=n + 40), np.ones(12) / 3.0, mode="same")[20 : 20 + n]
    curvature = gain * delayed(turn, lag) + trim
    heading = np.cumsum(curvature * STEP_CM) + np.cumsum(noise_rad * rng.normal(size=n))
    middle = heading - 0.5 * curvature * STEP_CM
    xy = np.cumsum(STEP_CM * np.column_stack([np.cos(middle), np.sin(middle)]), axis=0)
    return np.column_stack([xy, heading]), CommandedMotion.without_gaps(np.full(n, STEP_CM), True, turn)


@pytest.mark.parametrize("lag", [0, 4, 10])
@pytest.mark.parametrize("seed", range(3))
def test_the_fit_finds_gain_trim_and_lag(seed, lag):
    poses, commands = _answer(np.random.default_rng(seed), 0.009, 0.002, lag, 0.005)
    fit = fit_steering(poses, commands, HEIGHT_CM)
    assert fit is not None
    assert fit.lag_frames == lag
    assert fit.gain == pytest.approx(0.009, rel=0.03)
    assert fit.trim_per_cm == pytest.approx(0.002, abs=2e-4)
    assert fit.correlation > 0.95


def test_frames_at_standstill_do_not_disturb_the_fit():
    poses, commands = _answer(np.random.default_rng(0), 0.009, 0.0, 3, 0.002)
    # From frame 200 the car stands for 40 frames; its heading jitters over next to no distance.
    shift = np.zeros_like(poses[240:])
    shift[:, :2] = poses[200, :2] - poses[239, :2]
    poses[240:] += shift
    poses[200:240] = poses[200]
    poses[200:240, 2] += 0.02 * np.random.default_rng(1).normal(size=40)
    poses[200:240, 0] += np.linspace(0.0, 0.1, 40)
    fit = fit_steering(poses, commands, HEIGHT_CM)
    assert fit is not None
    assert fit.lag_frames == 3
    assert fit.gain == pytest.approx(0.009, rel=0.1)


def test_no_fit_without_a_command_that_explains_the_path():
    rng = np.random.default_rng(0)
    poses, commands = _answer(rng, 0.009, 0.0, 3, 0.002)
    n = len(poses)

    def fit_of(turn: np.ndarray | None) -> object:
        return fit_steering(poses, CommandedMotion.without_gaps(commands.distance_cm, True, turn), HEIGHT_CM)

    assert fit_of(None) is None
    assert fit_of(np.full(n, 0.3)) is None
    assert fit_of(rng.normal(size=n)) is None
    # Too short a drive to tell.
    assert commands.turn is not None
    assert (
        fit_steering(
            poses[:40], CommandedMotion.without_gaps(np.ones(40), True, commands.turn[:40]), HEIGHT_CM
        )
        is None
    )


@pytest.mark.parametrize("speed_known", [True, False])
def test_tracking_finds_the_answer_of_the_steering_and_uses_it(speed_known):
    n = 110
    road = tape_road(n, curvature_per_cm=0.002, swing_per_cm=0.012)
    curvature = np.diff(road.poses[:, 2], prepend=0.0) / STEP_CM
    # The command comes two frames before the wheels answer, as an angle of about +-0.7.
    turn = np.concatenate([curvature[2:], curvature[-1:], curvature[-1:]]) / 0.02
    commands = CommandedMotion.without_gaps(np.full(n, STEP_CM if speed_known else 1.0), speed_known, turn)
    calls: list[tuple[int, int]] = []
    camera = fisheye()
    edges = pixels(road, camera)
    rng = np.random.default_rng(0)
    pictures = ImagePairs(edges, camera, OdometrySettings(), rng)
    blank = made_up_drive([np.zeros((camera.height, camera.width, 3), np.uint8)] * n)
    everywhere = np.ones((camera.height, camera.width), np.uint8)
    road_view = RoadView(edges, everywhere, RangeSettings())
    usual = typical_step(pictures, commands.distance_cm, speed_known)
    seen = SegmentView(blank, camera, commands, road_view, road_view.scans(camera), pictures, usual)
    settings = SlamSettings(filter=FilterSettings(particles=200))
    trajectory, fit = track(seen, settings, rng, lambda done, total: calls.append((done, total)))
    assert calls == [(k, 2 * n) for k in range(1, 2 * n + 1)]
    assert fit is not None
    assert abs(fit.lag_frames - 2) <= 1
    assert fit.gain == pytest.approx(0.02, rel=0.1)
    assert abs(fit.trim_per_cm) < 0.001
    assert np.linalg.norm(trajectory.poses[-1, :2] - road.poses[-1, :2]) < 9.0
    assert np.abs(trajectory.poses[:, 2] - road.poses[:, 2]).max() < np.deg2rad(4.0)


def test_the_filter_moves_as_the_odometry_says():
    odometry = Odometry(np.array([0.0, 3.0, 4.0]), np.array([0.0, 0.06, -0.02]))
    settings = MotionSettings(
        factor_walk=1e-9, distance_noise=1e-9, curvature_noise_heights=1e-9, offset_walk_heights=1e-9
    )
    motion = motion_about(odometry, settings, HEIGHT_CM, np.ones(3))
    rng = np.random.default_rng(0)
    states = motion.start(20, rng)
    for k in (1, 2):
        motion.predict(states, k, rng)
    np.testing.assert_allclose(states[:, :3], np.tile(odometry.poses[-1], (20, 1)), atol=1e-6)


def test_steps_are_relative_to_the_typical_one():
    commands = CommandedMotion.without_gaps(np.array([0.0, 2.0, 2.0, 4.0, 0.0]), True, None)
    np.testing.assert_allclose(commands.relative_steps, [0.0, 1.0, 1.0, 2.0, 0.0])
    np.testing.assert_array_equal(
        CommandedMotion.without_gaps(np.zeros(3), True, None).relative_steps, np.zeros(3)
    )
