"""Points by the patch: totals kept, directions kept apart, the heaviest first."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.slam.odometry.scans import Scan, condense


def _points(seed: int, n: int = 300) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    angle = rng.uniform(-np.pi, np.pi, n)
    normals = np.column_stack([np.cos(angle), np.sin(angle)])
    return rng.uniform(-20.0, 20.0, (n, 2)), normals, rng.uniform(0.1, 1.0, n)


@pytest.mark.parametrize("seed", range(3))
def test_weighted_normals_add_up_to_the_same(seed):
    points, normals, weights = _points(seed)
    few, directions, heavy = condense(Scan(points, normals, weights), 4.0, 1000)
    assert len(few) < len(points)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0)
    np.testing.assert_allclose(heavy @ directions, weights @ normals, atol=1e-9)
    assert (np.abs(few) <= 20.0).all()


def test_a_patch_becomes_its_weighted_mean():
    points = np.array([[1.0, 1.0], [1.4, 1.0], [9.0, 9.0]])
    normals = np.array([[1.0, 0.0]] * 3)
    few, directions, heavy = condense(Scan(points, normals, np.array([1.0, 3.0, 0.5])), 2.0, 10)
    np.testing.assert_allclose(few, [[1.3, 1.0], [9.0, 9.0]])
    np.testing.assert_allclose(directions, normals[:2])
    np.testing.assert_allclose(heavy, [4.0, 0.5])


def test_both_edges_of_a_tape_stay_apart():
    points = np.array([[1.0, 1.0], [1.1, 1.0]])
    normals = np.array([[1.0, 0.0], [-1.0, 0.0]])
    few, _, heavy = condense(Scan(points, normals, np.ones(2)), 2.0, 10)
    assert len(few) == 2
    np.testing.assert_allclose(heavy, 1.0)


def test_the_heaviest_patches_are_kept():
    points, normals, weights = _points(5)
    every = condense(Scan(points, normals, weights), 4.0, 1000)[2]
    kept = condense(Scan(points, normals, weights), 4.0, 20)[2]
    np.testing.assert_allclose(np.sort(kept), np.sort(every)[-20:])


def test_no_points_give_no_points():
    few, directions, heavy = condense(Scan(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0)), 1.0, 10)
    assert few.shape == directions.shape == (0, 2)
    assert heavy.shape == (0,)
