"""Parts of a drive: no frame to learn from is near one to judge by, by number or by way."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.datasets.settings import RecordedSettings
from datagen.datasets.splits import driven_cm, split_along_time, split_by_lap, split_recording
from lanenet.data.label_set import LabelMeta, LabelSet
from lanenet.errors import ConfigError
from lanenet.geometry.birdseye import BirdseyeWindow


def drive(laps: np.ndarray, step_cm: np.ndarray | float = 3.0, frames: np.ndarray | None = None) -> LabelSet:
    """A car that goes round a circle of 1 m radius, so that places come again and ways do not."""
    n, nothing = len(laps), np.empty((0, 2))
    way = np.cumsum(np.broadcast_to(step_cm, n))
    poses = np.stack([100.0 * np.cos(way / 100.0), 100.0 * np.sin(way / 100.0), way / 100.0], axis=1)
    return LabelSet(
        meta=LabelMeta(BirdseyeWindow(), "camera", 17.0, 40.0, "map"),
        drive=["drive"] * n,
        file=[""] * n,
        frame=np.arange(n) if frames is None else frames,
        t_s=way,
        lap=laps,
        poses=poses,
        points_cm=np.zeros((n, 6)),
        edges=[np.empty((0, 6), np.float32)] * n,
        lines=[(nothing, nothing)] * n,
        quality=np.ones(n),
        divides=np.zeros((n, 2), dtype=bool),
    )


@settings(max_examples=80, deadline=None)
@given(
    counts=st.lists(st.integers(150, 300), min_size=3, max_size=6),
    gap_frames=st.integers(0, 60),
    gap_cm=st.floats(0.0, 150.0),
    by_lap=st.booleans(),
    seed=st.integers(0, 99),
)
def test_no_frame_to_learn_from_lies_within_the_gap_of_another_part(counts, gap_frames, gap_cm, by_lap, seed):
    rng = np.random.default_rng(seed)
    laps = np.repeat(np.arange(len(counts)), counts)
    # Some frames have no labels, and the car is now faster and now slower.
    frames = np.cumsum(rng.integers(1, 4, len(laps)))
    step_cm = rng.uniform(2.0, 4.0, len(laps))
    labels = drive(laps, step_cm, frames)
    recorded = RecordedSettings.model_validate(
        {
            "path": "d",
            "lane_width_cm": 40,
            "split": "lap" if by_lap else "time",
            "gap_frames": gap_frames,
            "gap_cm": gap_cm,
        }
    )
    parts = split_recording(labels, recorded)
    true_way = dict(zip(frames.tolist(), np.cumsum(step_cm), strict=True))
    for before, after in combinations(parts, 2):
        numbers = np.abs(before.frame[:, None] - after.frame[None, :])
        assert numbers.min() > gap_frames
        ways = [np.array([true_way[int(f)] for f in part.frame]) for part in (before, after)]
        # The chords between frames are a little shorter than the arcs that were driven.
        assert np.abs(ways[0][:, None] - ways[1][None, :]).min() >= gap_cm
    if by_lap:
        assert set(parts[2].lap) == {len(counts) - 1} and set(parts[1].lap) == {len(counts) - 2}
        assert set(parts[0].lap) == set(range(len(counts) - 2))


def test_the_longer_gap_counts():
    labels = drive(np.zeros(1000, int), 2.0)
    by_frames = split_along_time(labels, (0.5, 0.25), 40, 30.0)
    by_way = split_along_time(labels, (0.5, 0.25), 10, 160.0)
    assert [int(p.frame[0]) for p in by_frames] == [0, 540, 790]
    assert by_way[1].frame[0] - by_way[0].frame[-1] == pytest.approx(80, abs=1)


def test_a_lap_that_was_not_finished_joins_the_one_before():
    laps = np.repeat([0, 1, 2, 3], [200, 210, 190, 40])
    parts = split_by_lap(drive(laps), 10)
    assert [sorted(set(part.lap.tolist())) for part in parts] == [[0], [1], [2, 3]]


def test_a_map_in_two_pieces_starts_its_laps_again():
    laps = np.repeat([0, 1, 2, 0, 1], 100)
    parts = split_by_lap(drive(laps), 5)
    assert [int(part.frame[0]) for part in parts] == [0, 305, 405]


def test_too_few_laps_are_refused():
    with pytest.raises(ConfigError, match="2 complete laps, expected 3 at least"):
        split_by_lap(drive(np.repeat([0, 1, 2], [200, 200, 30])), 10)
    with pytest.raises(ConfigError, match="400 frames and 0 cm leave a part empty"):
        split_by_lap(drive(np.repeat([0, 1, 2], 200)), 400)


def test_the_way_does_not_grow_where_the_map_is_interrupted():
    labels = drive(np.zeros(100, int), 3.0)
    assert driven_cm(labels)[-1] == pytest.approx(99 * 3.0, rel=1e-3)
    labels.poses[50:, :2] += 5000.0
    assert driven_cm(labels)[-1] == pytest.approx(98 * 3.0, rel=1e-3)
    # A longer step where frames have no labels is way all the same.
    gaps = drive(
        np.zeros(60, int), np.where(np.arange(60) == 30, 30.0, 3.0), np.arange(60) + 9 * (np.arange(60) >= 30)
    )
    assert driven_cm(gaps)[-1] == pytest.approx(58 * 3.0 + 30.0, rel=1e-2)
    assert len(driven_cm(labels.subset(slice(0, 1)))) == 1 and len(driven_cm(labels.subset(slice(0, 0)))) == 0
