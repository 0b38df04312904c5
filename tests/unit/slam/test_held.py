"""The drive at a held speed, compiled as a whole, against the filter it stands for."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from tape_road import HEIGHT_CM, STEP_CM, WHEELBASE_CM, tape_road

from datagen.slam.filter import FilterSettings, run_filter
from datagen.slam.held import HeldStretch
from datagen.slam.motion import MotionModel
from datagen.slam.scans import Scans
from datagen.slam.speed import held_motion

SETTINGS = FilterSettings(particles=60, max_points=90, maps="mean", stray_every=0)
FRAMES = 70


@cache
def _scans() -> Scans:
    return tape_road(FRAMES).scans()


def _held(
    scans: Scans, motion: MotionModel, seed: int = 0, settings: FilterSettings = SETTINGS
) -> np.ndarray:
    return HeldStretch.of(scans, settings, HEIGHT_CM, WHEELBASE_CM).match(motion, seed)


def _filtered(motion: MotionModel, seed: int = 0, settings: FilterSettings = SETTINGS) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return run_filter(_scans(), motion, settings, HEIGHT_CM, WHEELBASE_CM, rng).match


@pytest.mark.parametrize("step_cm", [STEP_CM, 1.3 * STEP_CM])
@pytest.mark.parametrize("size", [64, 512])
def test_without_noise_every_frame_matches_as_in_the_filter(step_cm, size):
    """Also where the map is so small that the road runs over itself."""
    still = replace(
        held_motion(step_cm, np.ones(FRAMES), HEIGHT_CM),
        curvature_per_cm=np.full(FRAMES, 0.004),
        factor_start=(step_cm, 0.0),
        factor_walk=0.0,
        distance_noise=0.0,
        offset_walk_per_cm=0.0,
        curvature_noise_per_cm=0.0,
    )
    settings = SETTINGS.model_copy(update={"field_size": size})
    found = _held(_scans(), still, settings=settings)
    assert np.isnan(found[0]) and np.ptp(found[1:]) > 0.05
    np.testing.assert_allclose(found, _filtered(still, settings=settings), rtol=1e-9, atol=1e-12)


def test_with_noise_it_matches_as_well_on_average():
    for share in (0.7, 1.0, 1.4):
        motion = held_motion(share * STEP_CM, np.ones(FRAMES), HEIGHT_CM)
        means = [
            np.mean([np.nanmean(match(seed)) for seed in range(4)])
            for match in (lambda s, m=motion: _held(_scans(), m, s), lambda s, m=motion: _filtered(m, s))
        ]
        assert means[0] == pytest.approx(means[1], abs=0.015), share


def test_the_seed_decides_and_frames_without_edges_are_unknown():
    motion = held_motion(STEP_CM, np.ones(FRAMES), HEIGHT_CM)
    np.testing.assert_array_equal(_held(_scans(), motion, 3), _held(_scans(), motion, 3))
    assert not np.array_equal(_held(_scans(), motion, 3), _held(_scans(), motion, 4))
    scans = _scans()
    starts = scans.starts.copy()
    starts[31:] -= starts[31] - starts[30]
    gone = np.r_[0 : scans.starts[30], scans.starts[31] : scans.starts[-1]]
    blind = Scans(scans.points_cm[gone], scans.normals[gone], scans.weights[gone], starts)
    found = _held(blind, motion)
    assert np.flatnonzero(np.isnan(found)).tolist() == [0, 30]
    assert np.nanmean(found[31:]) > 0.5
