"""Which frames are held out, and scans without them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from datagen.lanes.path import without_frames
from datagen.quality.measure import held_out_frames
from datagen.settings import MapSettings
from datagen.slam.odometry.scans import pack_scans
from lanenet.config import check_settings
from lanenet.errors import ConfigError
from lanenet.perception.edges.road import RoadEdges


@given(st.integers(1, 300), st.integers(2, 40), st.integers(0, 1000))
def test_one_of_every_so_many(count, every, seed):
    chosen = np.flatnonzero(held_out_frames(count, every, seed))
    assert (np.diff(chosen) == every).all()
    assert abs(len(chosen) - count / every) < 1.0
    np.testing.assert_array_equal(chosen, np.flatnonzero(held_out_frames(count, every, seed)))


def test_the_seed_decides_the_phase_and_zero_holds_nothing_out():
    assert len({int(np.argmax(held_out_frames(100, 10, seed))) for seed in range(20)}) > 3
    assert not held_out_frames(100, 0, 3).any()


@pytest.mark.parametrize("every", [1, -1])
def test_frames_are_left_for_the_lines(every):
    with pytest.raises(ConfigError, match="held_out_every"):
        check_settings(MapSettings, {"held_out_every": every}, "here")


def test_scans_without_frames_keep_the_others_in_place():
    rng = np.random.default_rng(0)
    frames = [RoadEdges(rng.normal(size=(n, 2)), rng.normal(size=(n, 2))) for n in (3, 0, 5, 2)]
    scans = pack_scans(frames, 15.0)
    left = without_frames(scans, np.array([False, False, True, False]))
    assert len(left) == 4 and len(left.points_cm) == 5
    for k in (0, 1, 3):
        np.testing.assert_array_equal(left.points_cm[left.frame(k)], scans.points_cm[scans.frame(k)])
        np.testing.assert_array_equal(left.weights[left.frame(k)], scans.weights[scans.frame(k)])
    assert left.frame(2).start == left.frame(2).stop
    np.testing.assert_array_equal(without_frames(scans, np.zeros(4, bool)).normals, scans.normals)
