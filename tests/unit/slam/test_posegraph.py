"""Loop closure: drifted laps come back, and one wrong revisit is left alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from datagen.slam.commands import BREAK_PERIODS
from datagen.slam.loops.pose_graph import close_loops, inlier_revisits, revisit_residuals
from datagen.slam.loops.revisits import Revisit
from lanenet.geometry.poses import relative_pose

HEIGHT_CM = 15.0
LAP = 100
RADIUS_CM = 60.0


def _laps(drift_rad: float, laps: int = 2, speed_error: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """True poses of laps around a circle, and the same with a heading that drifts along the way."""
    angle = np.arange(laps * LAP + 1) * 2.0 * np.pi / LAP
    true = np.column_stack([RADIUS_CM * np.sin(angle), RADIUS_CM * (1.0 - np.cos(angle)), angle])
    heading = angle + drift_rad * np.arange(len(angle)) / LAP
    step = 2.0 * RADIUS_CM * np.sin(np.pi / LAP) * (1.0 + speed_error)
    middle = 0.5 * (heading[1:] + heading[:-1])
    steps = step * np.column_stack([np.cos(middle), np.sin(middle)])
    xy = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    return true, np.column_stack([xy, heading])


def _revisits(true: np.ndarray, frames: range, noise: np.random.Generator | None = None) -> list[Revisit]:
    found = []
    for k in frames:
        relative = relative_pose(true[k], true[k + LAP])
        if noise is not None:
            relative = relative + noise.normal(size=3) * [0.5, 0.3, 0.01]
        found.append(Revisit(k, k + LAP, relative, 0.8, turns=1))
    return found


@pytest.mark.parametrize("drift_deg", [30.0, -30.0, 10.0])
def test_two_laps_with_drifting_heading_close(drift_deg):
    true, drifted = _laps(np.deg2rad(drift_deg))
    assert np.linalg.norm(drifted[LAP, :2] - drifted[0, :2]) > 9.0
    closed, residuals = close_loops(drifted, _revisits(true, range(5, 96, 10)), HEIGHT_CM)
    assert residuals.shape == (10, 3)
    assert np.abs(residuals[:, :2]).max() < 0.5
    assert np.abs(residuals[:, 2]).max() < np.deg2rad(0.5)
    # The first pose stays; the headings stay unwrapped and turn twice.
    np.testing.assert_allclose(closed[0], drifted[0], atol=1e-9)
    assert closed[-1, 2] == pytest.approx(4.0 * np.pi, abs=np.deg2rad(8.0))
    assert np.abs(np.diff(closed[:, 2])).max() < 0.2
    # Both laps lie on each other, and on a circle of nearly the true size.
    assert np.linalg.norm(closed[:LAP, :2] - closed[LAP:-1, :2], axis=1).max() < 1.0
    centre = closed[:, :2].mean(axis=0)
    radius = np.linalg.norm(closed[:, :2] - centre, axis=1)
    assert np.abs(radius - RADIUS_CM).max() < 0.06 * RADIUS_CM


@pytest.mark.parametrize("seed", range(3))
def test_noisy_revisits_leave_residuals_of_their_own_size(seed):
    true, drifted = _laps(np.deg2rad(20.0), laps=3, speed_error=0.02)
    rng = np.random.default_rng(seed)
    _, residuals = close_loops(drifted, _revisits(true, range(3, 2 * LAP, 7), rng), HEIGHT_CM)
    assert np.median(np.abs(residuals[:, :2])) < 0.5
    assert np.abs(residuals[:, :2]).max() < 2.5
    assert np.abs(residuals[:, 2]).max() < np.deg2rad(3.0)


@pytest.mark.parametrize("wrong", [2, 5, 9])
def test_one_wrong_revisit_among_ten_is_left_unsatisfied(wrong):
    true, drifted = _laps(np.deg2rad(30.0))
    revisits = _revisits(true, range(5, 96, 10))
    good = revisits[wrong]
    # The next dash but one, seen from a metre beside: 40 cm along, 25 cm across, 10 degrees.
    relative = good.relative + [40.0, 25.0, np.deg2rad(10.0)]
    revisits[wrong] = Revisit(good.earlier, good.later, relative, 0.8, turns=1)
    closed, residuals = close_loops(drifted, revisits, HEIGHT_CM)
    size = np.linalg.norm(residuals[:, :2], axis=1)
    assert size[wrong] > 40.0
    others = np.delete(size, wrong)
    assert np.median(others) < 0.5
    assert others.max() < 1.5
    # Between the good revisits both laps lie on each other; beyond the last one the drift goes on.
    apart = np.linalg.norm(closed[:LAP, :2] - closed[LAP:-1, :2], axis=1)
    assert apart[15:86].max() < 1.5


@pytest.mark.parametrize("dashes", [2.0, -2.0])
def test_a_revisit_that_shows_the_next_dash_is_no_inlier(dashes):
    true, drifted = _laps(np.deg2rad(20.0))
    revisits = _revisits(true, range(5, 96, 10))
    revisits[4] = replace(revisits[4], relative=revisits[4].relative + [dashes * HEIGHT_CM, 0.0, 0.0])
    revisits[7] = replace(revisits[7], relative=revisits[7].relative + [0.0, 0.0, 0.4])
    closed, _ = close_loops(drifted, revisits, HEIGHT_CM)
    kept = inlier_revisits(closed, revisits, HEIGHT_CM)
    assert kept == revisits[:4] + revisits[5:7] + revisits[8:]
    assert inlier_revisits(closed, [], HEIGHT_CM) == []


def test_without_revisits_nothing_moves():
    _, drifted = _laps(0.3)
    closed, residuals = close_loops(drifted, [], HEIGHT_CM)
    np.testing.assert_array_equal(closed, drifted)
    assert residuals.shape == (0, 3)


def test_exact_revisits_of_an_exact_path_change_nothing():
    true, _ = _laps(0.0)
    closed, residuals = close_loops(true, _revisits(true, range(5, 96, 10)), HEIGHT_CM)
    np.testing.assert_allclose(closed, true, atol=1e-6)
    np.testing.assert_allclose(residuals, 0.0, atol=1e-6)


def test_where_the_drive_starts_does_not_matter():
    true, drifted = _laps(np.deg2rad(20.0))
    revisits = _revisits(true, range(5, 96, 10))
    turn, shift = 1.9, np.array([300.0, -120.0])
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])

    def move(poses: np.ndarray) -> np.ndarray:
        return np.column_stack([poses[:, :2] @ rotation.T + shift, poses[:, 2] + turn])

    here, _ = close_loops(drifted, revisits, HEIGHT_CM)
    there, _ = close_loops(move(drifted), revisits, HEIGHT_CM)
    np.testing.assert_allclose(there, move(here), atol=0.05)


def test_motion_across_a_break_is_not_believed():
    true, drifted = _laps(np.deg2rad(5.0))
    # From the break on the path is laid down elsewhere, by less than a turn.
    moved = drifted.copy()
    c, s = np.cos(0.8), np.sin(0.8)
    moved[150:, :2] = moved[150:, :2] @ np.array([[c, s], [-s, c]]) + [40.0, -25.0]
    moved[150:, 2] += 0.8
    periods = np.where(np.arange(len(true)) == 150, BREAK_PERIODS, 1.0)
    revisits = _revisits(true, range(0, LAP, 5))
    closed, residuals = close_loops(moved, revisits, HEIGHT_CM, periods)
    assert np.abs(residuals[:, :2]).max() < 0.5
    assert np.linalg.norm(closed[:, :2] - true[:, :2], axis=1).max() < 3.0
    # Taken for motion, the jump would bend the road.
    bent, _ = close_loops(moved, revisits, HEIGHT_CM)
    assert np.linalg.norm(bent[:, :2] - true[:, :2], axis=1).max() > 5.0


def test_what_revisits_miss_is_measured_in_the_poses_that_are_given():
    true, _ = _laps(0.0)
    revisits = _revisits(true, range(5, 96, 10))
    assert np.abs(revisit_residuals(true, revisits)).max() < 1e-9
    moved = true.copy()
    # The later frame of the third revisit: ahead, to its left, and turned by it. A turn moves the axes.
    heading = true[125, 2]
    moved[125, :2] += 2.0 * np.array([np.cos(heading), np.sin(heading)])
    moved[125, :2] += 0.5 * np.array([-np.sin(heading), np.cos(heading)])
    moved[125, 2] += 0.1 + 2.0 * np.pi
    missed = revisit_residuals(moved, revisits)
    np.testing.assert_allclose(missed[2], [2.0, 0.5, 0.1], atol=1e-9)
    assert np.abs(np.delete(missed, 2, axis=0)).max() < 1e-9
    assert revisit_residuals(true, []).shape == (0, 3)
