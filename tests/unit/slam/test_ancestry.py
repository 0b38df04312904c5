from __future__ import annotations

import numpy as np
import pytest
from reference_filter import reference_filter
from tape_road import HEIGHT_CM, STEP_CM, WHEELBASE_CM, tape_road

from datagen.slam.filter import FilterSettings, ParticleFilter, thin_scan
from datagen.slam.motion import MotionModel

FRAMES = 40


def _motion(frames: int) -> MotionModel:
    return MotionModel(
        distance_cm=np.full(frames, STEP_CM),
        curvature_per_cm=np.zeros(frames),
        factor_start=(1.0, 0.1),
        factor_walk=0.005,
        factor_pull=0.02,
        distance_noise=0.02,
        offset_walk_per_cm=0.012 / HEIGHT_CM,
        offset_decay=0.0,
        curvature_noise_per_cm=0.02 / HEIGHT_CM,
        max_curvature_per_cm=0.8 / HEIGHT_CM,
    )


@pytest.mark.parametrize("likelihood", ["direction", "count"])
@pytest.mark.parametrize("seed", range(2))
def test_the_shared_map_equals_a_map_per_particle(seed, likelihood):
    scans, motion = tape_road(FRAMES).scans(), _motion(FRAMES)
    settings = FilterSettings(particles=24, likelihood=likelihood, max_points=40, map_points=25)
    states, weights = reference_filter(
        scans, motion, settings, HEIGHT_CM, WHEELBASE_CM, np.random.default_rng(seed)
    )
    rng = np.random.default_rng(seed)
    shared = ParticleFilter(motion, settings, HEIGHT_CM, WHEELBASE_CM, rng)
    for k in range(FRAMES):
        shared.step(*thin_scan(scans, k, settings.max_points, rng), motion, k)
        np.testing.assert_allclose(shared.states, states[k], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(shared.weights, weights[k], rtol=1e-9, atol=0.0)
    assert shared.map.forced == 0
