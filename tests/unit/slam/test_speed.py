"""The usual step of a drive whose speed nobody recorded."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from tape_road import HEIGHT_CM, STEP_CM, WHEELBASE_CM, tape_road

from datagen.slam.filter import FilterSettings
from datagen.slam.motion import FACTOR, HEADING, OFFSET
from datagen.slam.scans import Scans
from datagen.slam.speed import STEPS_HEIGHTS, SpeedProfile, _peak, held_motion, middle_stretch, profile_speed

SMALL = FilterSettings(particles=80, max_points=100)
STEPS_CM = HEIGHT_CM * np.array(STEPS_HEIGHTS)


@cache
def _scans() -> Scans:
    return tape_road(90).scans()


def _profile(relative: np.ndarray, scans: Scans, seed: int, steps_cm: np.ndarray = STEPS_CM) -> SpeedProfile:
    return profile_speed(scans, relative, steps_cm, HEIGHT_CM, WHEELBASE_CM, seed, SMALL)


@pytest.mark.parametrize("seed", range(2))
def test_the_step_of_a_dashed_road_is_found(seed):
    profile = _profile(np.ones(90), _scans(), seed)
    assert profile.step_cm == pytest.approx(STEP_CM, rel=0.05)
    np.testing.assert_array_equal(profile.steps_cm, STEPS_CM)
    assert (profile.match >= 0.0).all() and (profile.match <= 1.0).all()
    # A step of half or of twice the size is a worse one.
    best = profile.match.max()
    for wrong in (0.5, 2.0):
        assert profile.match[np.argmin(np.abs(np.log(STEPS_CM / (wrong * STEP_CM))))] < 0.95 * best


def test_the_step_is_that_of_a_frame_of_usual_length():
    """Every third frame comes after twice the time."""
    kept = np.flatnonzero(np.arange(90) % 4 != 3)
    road = tape_road(90)
    relative = np.diff(kept, prepend=-1).astype(float)
    profile = _profile(relative, road.scans(road.poses[kept]), 0, STEP_CM * 1.25 ** np.arange(-3.0, 4.0))
    assert profile.step_cm == pytest.approx(STEP_CM, rel=0.05)


def test_progress_counts_the_steps_and_the_seed_decides():
    seen: list[tuple[int, int]] = []
    steps = np.array([2.4, 3.0, 3.75])
    scans = _scans().cut(slice(0, 40))
    one, same, other = (
        profile_speed(
            scans, np.ones(40), steps, HEIGHT_CM, WHEELBASE_CM, seed, SMALL, lambda *done: seen.append(done)
        )
        for seed in (1, 1, 2)
    )
    assert seen[:3] == [(1, 3), (2, 3), (3, 3)]
    np.testing.assert_array_equal(one.match, same.match)
    assert not np.array_equal(one.match, other.match)


def test_the_stretch_lies_within_the_drive():
    scans = _scans()
    assert middle_stretch(scans, 300) == slice(0, 90)
    assert middle_stretch(scans, 60) == slice(10, 70)


@pytest.mark.parametrize("top", [-0.3, 0.0, 0.45])
def test_the_peak_is_the_top_of_the_parabola(top):
    log_step = np.log(2.0) + 0.2 * np.arange(5.0)
    match = 0.8 - 0.01 * (np.arange(5.0) - 2.0 - top) ** 2
    assert _peak(log_step, match, 2) == pytest.approx(2.0 * np.exp(0.2 * (2.0 + top)))
    # At the rim, and where there is no top, the tried step itself.
    assert _peak(log_step, match, 0) == pytest.approx(2.0)
    assert _peak(log_step, -match, 3) == pytest.approx(2.0 * np.exp(0.6))


@pytest.mark.parametrize("seed", range(2))
def test_held_motion_keeps_the_step_and_lets_the_car_steer(seed):
    rng = np.random.default_rng(seed)
    motion = held_motion(3.0, np.full(61, 1.0), HEIGHT_CM)
    states = motion.start(500, rng)
    for k in range(1, 61):
        before = states[:, :3].copy()
        motion.predict(states, k, rng)
        step = np.linalg.norm(states[:, :2] - before[:, :2], axis=1)
        assert np.median(step) == pytest.approx(3.0, rel=0.02)
        assert np.abs(states[:, HEADING] - before[:, 2]).max() <= step.max() * 0.6 / HEIGHT_CM * 1.001
    # Nothing pulls the curvature back, so that it reaches a bend; the speed stays.
    assert np.std(states[:, FACTOR]) < 0.05 * 3.0
    assert 0.05 / HEIGHT_CM < np.std(states[:, OFFSET]) < 0.2 / HEIGHT_CM
