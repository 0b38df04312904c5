from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from lanenet.data.segments import equal_runs, map_segments, true_runs


def plain(runs: list[np.ndarray]) -> list[list[int]]:
    return [run.tolist() for run in runs]


def test_runs_of_known_values():
    assert plain(equal_runs(np.array([4, 4, 7, 4, 4, 4]))) == [[0, 1], [2], [3, 4, 5]]
    assert plain(true_runs(np.array([True, False, False, True, True]))) == [[0], [3, 4]]
    assert plain(true_runs(np.array([False, True, False]))) == [[1]]
    assert true_runs(np.zeros(3, bool)) == []


def test_in_a_closed_row_a_run_may_cross_the_seam():
    flags = np.array([True, False, True, False, True, True])
    assert plain(true_runs(flags, closed=True)) == [[2], [4, 5, 0]]
    assert plain(true_runs(flags)) == [[0], [2], [4, 5]]
    assert plain(true_runs(~flags, closed=True)) == [[1], [3]]
    assert plain(true_runs(np.ones(3, bool), closed=True)) == [[0, 1, 2]]


def test_of_nothing_there_are_no_runs():
    assert equal_runs(np.empty(0, int)) == [] and true_runs(np.empty(0, bool)) == []


@pytest.mark.parametrize("seed", range(5))
def test_runs_are_all_of_it_in_order_and_none_can_be_longer(seed: int):
    values = np.random.default_rng(seed).integers(-1, 2, 40)
    runs = equal_runs(values)
    np.testing.assert_array_equal(np.concatenate(runs), np.arange(40))
    assert all(len(set(values[run])) == 1 for run in runs)
    assert all(values[a[-1]] != values[b[0]] for a, b in pairwise(runs))
    flags = values > 0
    kept = np.concatenate([*true_runs(flags), np.empty(0, int)])
    np.testing.assert_array_equal(kept, np.flatnonzero(flags))


def test_segments_begin_where_poses_jump():
    frames = np.array([0, 1, 2, 12, 13, 14, 15])
    x = np.array([0.0, 3.0, 6.0, 36.0, 39.0, 500.0, 503.0])
    poses = np.stack([x, 0 * x, 0 * x], axis=1)
    # Ten frames without labels were driven; five metres in one frame were not.
    np.testing.assert_array_equal(map_segments(frames, poses), [0, 0, 0, 0, 0, 1, 1])
    np.testing.assert_array_equal(map_segments(frames[:1], poses[:1]), [0])
    assert map_segments(frames[:0], poses[:0]).shape == (0,)
