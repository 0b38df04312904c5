"""The hidden Markov model of the motion: its changes, and what it makes of sure and of missing evidence."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.slam.odometry.image_pairs import turns_up_to
from datagen.slam.odometry.motion_grid import MotionGrid, follow_motion

TURNS = turns_up_to(0.09, 0.006)
WALK_RAD = 0.008


def _grid(spread: float = 0.2, keep: float = 0.95, jump: float = 0.0) -> MotionGrid:
    return MotionGrid(0.15, spread, keep, jump, TURNS)


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
    np.testing.assert_allclose(grid.turn_changes(WALK_RAD).sum(axis=1), 1.0)
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
    found, turned = follow_motion(grid, _seen(grid, steps, turns), np.ones(n), WALK_RAD, np.zeros(n), 0.6)
    np.testing.assert_allclose(found, steps, rtol=0.03)
    np.testing.assert_allclose(turned, turns, atol=0.003)


def test_frames_that_show_nothing_are_bridged_from_both_sides():
    grid, n = _grid(), 60
    steps, turns = np.full(n, 0.18), np.full(n, 0.03)
    seen = _seen(grid, steps, turns)
    seen[20:35] = 0.0
    found, turned = follow_motion(grid, seen, np.ones(n), WALK_RAD, np.zeros(n), 0.6)
    np.testing.assert_allclose(found[20:35], 0.18, rtol=0.08)
    np.testing.assert_allclose(turned[20:35], 0.03, atol=0.005)


def test_with_nothing_to_see_the_car_does_as_it_usually_does():
    grid, n = _grid(), 30
    found, turned = follow_motion(
        grid, np.zeros((n, *grid.shape), np.float32), np.ones(n), WALK_RAD, np.zeros(n), 0.3
    )
    np.testing.assert_allclose(found, 0.15, rtol=0.03)
    np.testing.assert_allclose(turned, 0.0, atol=0.003)


def test_the_steering_settles_what_the_pictures_leave_open():
    # Along an arc of a solid line every step fits that turns with it, and pictures alone say no more.
    grid, n, curvature = _grid(0.05), 40, 0.3
    off = (TURNS[None, :] - curvature * grid.steps[:, None]) / 0.006
    seen = np.repeat(-4.0 * off[None] ** 2, n, axis=0).astype(np.float32)
    relative = np.ones(n)
    predicted = np.full(n, curvature)
    found, turned = follow_motion(grid, seen, relative, WALK_RAD, predicted, 0.03)
    np.testing.assert_allclose(turned / found, curvature, rtol=0.1)
    # Without pictures the steering alone tells the turn, in proportion to the commanded way.
    relative[20:] = 1.5
    blind = np.zeros((n, *grid.shape), np.float32)
    found, turned = follow_motion(grid, blind, relative, WALK_RAD, predicted, 0.03)
    assert turned[8] == pytest.approx(curvature * 0.15, rel=0.15)
    assert turned[32] == pytest.approx(1.5 * curvature * 0.15, rel=0.15)


def test_one_wrong_frame_does_not_carry_the_motion_away():
    grid, n = _grid(0.05), 40
    steps, turns = np.full(n, 0.15), np.zeros(n)
    seen = _seen(grid, steps, turns, sharp=0.1)
    seen[20] = _seen(grid, np.full(1, 0.19), np.full(1, 0.05), sharp=0.1)[0]
    found, turned = follow_motion(grid, seen, np.ones(n), WALK_RAD, np.zeros(n), 0.6)
    assert found[20] == pytest.approx(0.15, rel=0.06)
    assert abs(turned[20]) < 0.015
