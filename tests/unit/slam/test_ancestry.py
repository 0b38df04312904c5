"""The shared map: equal to a map per particle, pruned, bounded, and indifferent to how lineages fork."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference_filter import reference_filter
from tape_road import HEIGHT_CM, STEP_CM, WHEELBASE_CM, tape_road

from datagen.slam.filter.ancestry import AncestryMap, Likelihood, MapLayout
from datagen.slam.filter.dp_slam import FilterSettings, ParticleFilter, systematic_resample
from datagen.slam.filter.motion import MotionModel
from datagen.slam.odometry.scans import Scan

CELL_CM = 0.8
MEMORY = 30.0


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
@pytest.mark.parametrize("seed", range(3))
def test_the_filter_equals_one_with_a_map_per_particle(seed, likelihood):
    frames = 40
    scans, motion = tape_road(frames).scans(), _motion(frames)
    chosen = FilterSettings(particles=16, likelihood=likelihood, max_points=20)
    states, weights = reference_filter(
        scans, motion, chosen, HEIGHT_CM, WHEELBASE_CM, np.random.default_rng(seed)
    )
    shared = ParticleFilter(motion, chosen, HEIGHT_CM, WHEELBASE_CM, np.random.default_rng(seed))
    resampled = 0
    for k in range(frames):
        shared.step(scans.scan(k), motion, k)
        np.testing.assert_allclose(shared.states, states[k], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(shared.weights, weights[k], rtol=1e-9, atol=0.0)
        resampled += len(shared.survivors.states) < chosen.particles
    assert shared.map.forced == 0
    # The comparison is worth something: lineages forked and met all the way.
    assert resampled > 10


def _map(particles: int, likelihood: Likelihood = "direction", **changes: int) -> AncestryMap:
    layout = MapLayout(
        CELL_CM, 64, MEMORY, WHEELBASE_CM, 12, likelihood=likelihood, **({"pages": 3000} | changes)
    )
    return AncestryMap(particles, layout)


def _scan(rng: np.random.Generator, n: int = 12) -> Scan:
    angle = rng.uniform(-np.pi, np.pi, n)
    normals = np.column_stack([np.cos(angle), np.sin(angle)])
    return Scan(rng.uniform([-6.0, 2.0], [6.0, 14.0], (n, 2)), normals, rng.uniform(0.2, 2.0, n))


def _states(rng: np.random.Generator, particles: int) -> np.ndarray:
    return rng.normal(size=(particles, 3)) * [1.0, 1.0, 0.1]


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 12), st.integers(2, 9))
def test_any_family_tree_scores_as_separate_maps_do(seed, frames, particles):
    """A particle sees what a map with its own lineage alone holds."""
    rng = np.random.default_rng(seed)
    shared = _map(particles)
    lineages: list[list[tuple[np.ndarray, int]]] = [[] for _ in range(particles)]
    shown = []
    for frame in range(frames):
        states, scan = _states(rng, particles), _scan(rng)
        chosen = np.sort(rng.integers(0, particles, particles))
        shared.descend(states, chosen, frame)
        shared.enter(scan, frame)
        shown.append(scan)
        lineages = [[*lineages[parent], (states[parent], frame)] for parent in chosen]
    poses, view = _states(rng, particles), _scan(rng)
    matches = shared.score(poses, view, frames)
    for p, lineage in enumerate(lineages):
        alone = _map(1)
        for pose, frame in lineage:
            alone.descend(pose[None], np.zeros(1, np.int64), frame)
            alone.enter(shown[frame], frame)
        expected = alone.score(poses[p : p + 1], view, frames)[0]
        assert matches[p] == pytest.approx(expected, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("likelihood", ["direction", "count"])
def test_no_cell_of_the_plane_is_special(likelihood):
    """Whole cells to either side of the origin, what was entered is seen again alike."""
    rng = np.random.default_rng(4)
    states, scan = _states(rng, 3), _scan(rng)
    seen = []
    for ix in range(-42, 2):
        for iy in (-1, 0, 1):
            moved = states + [ix * CELL_CM, iy * CELL_CM, 0.0]
            shared = _map(3, likelihood)
            shared.descend(moved, np.arange(3), 0)
            shared.enter(scan, 0)
            seen.append(shared.score(moved, scan, 1))
    assert seen[0].min() > 1.0
    np.testing.assert_allclose(seen, np.tile(seen[0], (len(seen), 1)), rtol=1e-6)


def test_entries_live_exactly_as_long_as_their_lineages_differ():
    rng = np.random.default_rng(0)
    shared = _map(4)
    free = int(shared.arrays.pages.free[1])
    shared.descend(_states(rng, 4), np.arange(4), 0)
    shared.enter(_scan(rng), 0)
    assert shared.arrays.pages.free[1] < free
    # All descend from the third: the others' entries are dead, and its own belong to all.
    survivors = shared.descend(_states(rng, 4), np.full(4, 2), 1)
    assert survivors == 1
    assert shared.arrays.pages.free[1] == free
    assert shared.forced == 0
    assert (shared.arrays.cells.root != 0.0).any()


def test_a_full_window_takes_the_mean_of_the_ancestors_and_counts_it():
    rng = np.random.default_rng(1)
    shared, mean = _map(5, window=4), _map(1)
    ancestors = np.array(
        [[0.0, 0.0, 0.0], [3.0, 0.0, 0.1], [0.0, 2.0, 0.3], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
    )
    scan = _scan(rng)
    # One lineage of the first particle, three of the second, one of the third.
    chosen = np.array([0, 1, 1, 1, 2])
    shared.descend(ancestors, chosen, 0)
    shared.enter(scan, 0)
    poses = np.tile(ancestors[chosen].mean(axis=0), (5, 1))
    mean.descend(poses[:1], np.zeros(1, np.int64), 0)
    mean.enter(scan, 0)
    nothing = Scan(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))
    for frame in range(1, 5):
        shared.descend(poses, np.arange(5), frame)
        shared.enter(nothing, frame)
        mean.descend(poses[:1], np.zeros(1, np.int64), frame)
    assert shared.forced == 1
    # Nothing of it is left to single lineages.
    assert shared.arrays.pages.free[1] == len(shared.arrays.pages.used)
    expected = mean.score(poses[:1], scan, 5)[0]
    assert expected > 1.0
    np.testing.assert_allclose(shared.score(poses, scan, 5), expected, rtol=1e-6)


@pytest.mark.parametrize("pages", [700, 5000])
def test_memory_is_bounded_however_long_lineages_stay_apart(pages):
    rng = np.random.default_rng(2)
    shared = _map(6, window=16, pages=pages)
    size = shared.bytes
    for frame in range(60):
        # Nobody ever dies, the worst case.
        shared.descend(_states(rng, 6), np.arange(6), frame)
        shared.enter(_scan(rng), frame)
        assert shared.arrays.pages.free[1] >= 0
    assert shared.bytes == size
    # With room enough only the window binds; with little the pool does, earlier.
    assert shared.forced >= 60 - 16
    assert np.isfinite(shared.score(_states(rng, 6), _scan(rng), 60)).all()


def test_no_page_is_lost_over_many_generations():
    rng = np.random.default_rng(3)
    shared = _map(30)
    for frame in range(80):
        weights = rng.dirichlet(np.ones(30))
        shared.descend(_states(rng, 30), systematic_resample(weights, rng.random()), frame)
        shared.enter(_scan(rng), frame)
        shared.score(_states(rng, 30), _scan(rng), frame + 1)
    in_cells = 0
    for page in shared.arrays.cells.state[:, :, 2].ravel():
        while page >= 0:
            in_cells += 1
            page = shared.arrays.pages.following[page]
    assert in_cells + shared.arrays.pages.free[1] == len(shared.arrays.pages.used)
    assert in_cells > 0


def test_counting_takes_no_notice_of_directions():
    points, normals, weights = np.array([[1.0, 10.0], [-2.0, 12.0]]), np.array([[1.0, 0.0]] * 2), np.ones(2)
    results = {}
    for likelihood in ("direction", "count"):
        shared = _map(1, likelihood)
        shared.descend(np.zeros((1, 3)), np.zeros(1, np.int64), 0)
        shared.enter(Scan(points, normals, weights), 0)
        results[likelihood] = [
            shared.score(np.zeros((1, 3)), Scan(points, sign * normals, weights), 1)[0]
            for sign in (1.0, -1.0)
        ]
    assert results["count"] == [2.0, 2.0]
    assert results["direction"][0] == pytest.approx(-results["direction"][1])
    assert results["direction"][0] > 0.3
