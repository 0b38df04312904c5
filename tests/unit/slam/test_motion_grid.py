"""The hidden Markov model of the motion, and turns by what is far away.

The model: its changes, and what it makes of sure and of missing evidence. The turns: measured in images, and
believed only where the road agrees.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from picture_road import made_up_drive
from pixel_road import fisheye

from datagen.slam.odometry.image_pairs import turns_up_to
from datagen.slam.odometry.motion_grid import MotionGrid, far_turns, follow_motion, seen_turns
from lanenet.geometry.camera import Camera

TURNS = turns_up_to(0.09, 0.006)
WALK_RAD = 0.008


def _grid(spread: float = 0.2, keep: float = 0.95, jump: float = 0.0) -> MotionGrid:
    return MotionGrid(0.15, spread, keep, jump, TURNS, WALK_RAD)


def _seen(grid: MotionGrid, steps: np.ndarray, turns: np.ndarray, sharp: float = 8.0) -> np.ndarray:
    """Log likelihood that peaks at a motion, between the states too."""
    off_step = (grid.log_factors - np.log(steps / grid.typical)[:, None]) / 0.056
    off_turn = (TURNS - turns[:, None]) / 0.006
    return (-0.5 * sharp * (off_step[:, :, None] ** 2 + off_turn[:, None, :] ** 2)).astype(np.float32)


def test_steps_lie_about_the_usual_one():
    grid = _grid()
    np.testing.assert_allclose(np.sqrt(grid.steps[0] * grid.steps[-1]), 0.15)
    assert grid.steps[0] < 0.15 * np.exp(-2.5 * 0.2) and grid.shape == (len(grid.steps), len(TURNS))
    np.testing.assert_allclose(np.diff(np.log(grid.steps)), 0.056)


@pytest.mark.parametrize(("spread", "keep", "jump"), [(0.05, 0.95, 0.0), (0.2, 0.99, 0.01), (0.25, 0.9, 0.0)])
def test_changes_are_probabilities_with_the_drift_and_variance_asked_for(spread, keep, jump):
    grid = _grid(spread, keep, jump)
    changes = grid.step_changes()
    assert (changes >= 0.0).all()
    np.testing.assert_allclose(changes.sum(axis=1), 1.0)
    np.testing.assert_allclose(grid.turn_changes().sum(axis=1), 1.0)
    if jump == 0.0:
        x = grid.log_factors
        middle = np.abs(x) < 0.1
        np.testing.assert_allclose((changes @ x)[middle], keep * x[middle], atol=1e-12)
        variance = changes @ x**2 - (changes @ x) ** 2
        assert variance[len(x) // 2] == pytest.approx(spread**2 * (1.0 - keep**2), rel=0.01)


def test_a_sure_motion_is_found_between_the_states():
    grid, n = _grid(), 60
    steps = 0.15 * np.exp(0.25 * np.sin(np.arange(n) / 12.0))
    turns = 0.05 * np.sin(np.arange(n) / 15.0)
    found, turned = follow_motion(grid, _seen(grid, steps, turns), np.ones(n), np.zeros(n), 0.6)
    np.testing.assert_allclose(found, steps, rtol=0.03)
    np.testing.assert_allclose(turned, turns, atol=0.003)


def test_frames_that_show_nothing_are_bridged_from_both_sides():
    grid, n = _grid(), 60
    steps, turns = np.full(n, 0.18), np.full(n, 0.03)
    seen = _seen(grid, steps, turns)
    seen[20:35] = 0.0
    found, turned = follow_motion(grid, seen, np.ones(n), np.zeros(n), 0.6)
    np.testing.assert_allclose(found[20:35], 0.18, rtol=0.08)
    np.testing.assert_allclose(turned[20:35], 0.03, atol=0.005)


def test_with_nothing_to_see_the_car_does_as_it_usually_does():
    grid, n = _grid(), 30
    found, turned = follow_motion(grid, np.zeros((n, *grid.shape), np.float32), np.ones(n), np.zeros(n), 0.3)
    np.testing.assert_allclose(found, 0.15, rtol=0.03)
    np.testing.assert_allclose(turned, 0.0, atol=0.003)


def test_the_steering_settles_what_the_pictures_leave_open():
    # Along an arc of a solid line every step fits that turns with it, and pictures alone say no more.
    grid, n, curvature = _grid(0.05), 40, 0.3
    off = (TURNS[None, :] - curvature * grid.steps[:, None]) / 0.006
    seen = np.repeat(-4.0 * off[None] ** 2, n, axis=0).astype(np.float32)
    relative = np.ones(n)
    predicted = np.full(n, curvature)
    found, turned = follow_motion(grid, seen, relative, predicted, 0.03)
    np.testing.assert_allclose(turned / found, curvature, rtol=0.1)
    # Without pictures the steering alone tells the turn, in proportion to the commanded way.
    relative[20:] = 1.5
    blind = np.zeros((n, *grid.shape), np.float32)
    found, turned = follow_motion(grid, blind, relative, predicted, 0.03)
    assert turned[8] == pytest.approx(curvature * 0.15, rel=0.15)
    assert turned[32] == pytest.approx(1.5 * curvature * 0.15, rel=0.15)


def test_one_wrong_frame_does_not_carry_the_motion_away():
    grid, n = _grid(0.05), 40
    steps, turns = np.full(n, 0.15), np.zeros(n)
    seen = _seen(grid, steps, turns, sharp=0.1)
    seen[20] = _seen(grid, np.full(1, 0.19), np.full(1, 0.05), sharp=0.1)[0]
    found, turned = follow_motion(grid, seen, np.ones(n), np.zeros(n), 0.6)
    assert found[20] == pytest.approx(0.15, rel=0.06)
    assert abs(turned[20]) < 0.015


def _camera() -> Camera:
    # Less tilted than the other tests have it, so that walls are in view.
    return fisheye(pitch_down_rad=0.25)


def _pictures(turns_rad: np.ndarray, seed: int = 0) -> list[np.ndarray]:
    """A room around a car that turns, and a road that is another one in every picture, both blurred."""
    rng = np.random.default_rng(seed)
    per_rad = _camera().K[0, 0]
    around = cv2.GaussianBlur(rng.uniform(0.0, 255.0, (120, int(2.0 * np.pi * per_rad))), (0, 0), 1.5)
    images = []
    for heading in np.cumsum(turns_rad):
        columns = np.mod(np.arange(160) - heading * per_rad, around.shape[1] - 1.0)
        u, v = np.meshgrid(columns.astype(np.float32), np.arange(120, dtype=np.float32))
        picture = cv2.remap(around.astype(np.float32), u, v, cv2.INTER_LINEAR)
        picture[50:] = cv2.GaussianBlur(rng.uniform(0.0, 255.0, (70, 160)), (0, 0), 1.5)
        picture += rng.normal(0.0, 2.0, picture.shape)
        images.append(cv2.cvtColor(np.clip(picture, 0, 255).astype(np.uint8), cv2.COLOR_GRAY2BGR))
    return images


def test_a_room_shows_the_turns():
    true = 0.08 * np.sin(np.arange(80) / 7.0)
    far = far_turns(made_up_drive(_pictures(true)), _camera())
    assert np.isnan(far[0]) and np.isfinite(far[1:]).mean() > 0.95
    assert np.nanmax(np.abs(far - true)) < np.deg2rad(0.3)
    # Left is positive on the road as well.
    seen = seen_turns(far, true)
    assert seen is not None
    np.testing.assert_allclose(seen.turns_rad[1:], far[1:], rtol=0.02)


def test_larger_pictures_show_the_same():
    true = 0.08 * np.sin(np.arange(30) / 4.0)
    small, camera = _pictures(true), _camera()
    large = [cv2.resize(image, None, fx=2.0, fy=2.0, interpolation=cv2.INTER_CUBIC) for image in small]
    K = camera.K * np.array([[2.0, 1.0, 2.0], [1.0, 2.0, 2.0], [1.0, 1.0, 1.0]])
    twice = replace(camera, width=320, height=240, K=K)
    for drive, seen_by in ((made_up_drive(large), twice), (made_up_drive(small), camera)):
        off = np.abs(far_turns(drive, seen_by) - true)
        assert np.isfinite(off[1:]).all() and np.nanmedian(off) < np.deg2rad(0.2)
        assert np.nanmax(off) < np.deg2rad(0.6)


def test_a_camera_that_does_not_see_the_distance_shows_no_turns():
    drive = made_up_drive(_pictures(np.full(10, 0.05)))
    assert np.isfinite(far_turns(drive, _camera())[1:]).all()
    assert np.isnan(far_turns(drive, _camera().with_mounting(pitch_down_rad=1.2))).all()


def test_a_blank_distance_shows_no_turns():
    images = [np.full((120, 160, 3), 90, np.uint8) for _ in range(60)]
    far = far_turns(made_up_drive(images), _camera())
    assert np.isnan(far).all()
    assert seen_turns(far, np.linspace(-0.1, 0.1, 60)) is None


def test_what_goes_with_the_car_shows_no_turns():
    # The same picture again and again, as lamps or the sky's gradient make it, while the car turns.
    rng = np.random.default_rng(0)
    view = rng.integers(0, 255, (120, 160, 3)).astype(np.uint8)
    far = far_turns(made_up_drive([view] * 60), _camera())
    assert np.nanmax(np.abs(far)) < 1e-3
    assert seen_turns(far, 0.05 * np.sin(np.arange(60) / 5.0)) is None


@pytest.mark.parametrize("factor", [0.7, 1.0, 1.6])
def test_the_road_says_how_much_a_shift_is_although_it_misses_slides(factor):
    rng = np.random.default_rng(1)
    true = 0.06 * np.sin(np.arange(300) / 9.0)
    far = true / factor + rng.normal(0.0, 0.003, 300)
    far[::11] = np.nan
    by_road = true + rng.normal(0.0, 0.004, 300)
    by_road[100:120] = 0.0
    by_road[200:215] = 0.1
    seen = seen_turns(far, by_road)
    assert seen is not None
    np.testing.assert_array_equal(np.isnan(seen.turns_rad), np.isnan(far))
    assert np.nanmedian(seen.turns_rad / far) == pytest.approx(factor, rel=0.05)
    assert 0.004 <= seen.sigma_rad < 0.01
    off = np.abs(seen.turns_rad - true)
    assert np.nanmax(off) < 0.025


def test_turns_that_the_road_does_not_know_are_not_believed():
    rng = np.random.default_rng(2)
    far, by_road = 0.03 * rng.normal(size=(2, 300))
    assert seen_turns(far, by_road) is None
    # A lens three times as long as believed, and a drive too short to tell.
    assert seen_turns(by_road / 3.0, by_road) is None
    assert seen_turns(by_road[:30], by_road[:30]) is None
    assert seen_turns(by_road, by_road) is not None
