"""A recording with repeated frames, from its folder to its map."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from picture_road import loop_drive
from pixel_road import fisheye

from datagen.pipeline import MapRequest, map_drive
from datagen.settings import MapSettings
from datagen.slam.adjustment.adjust import BundleSettings
from datagen.slam.filter.dp_slam import FilterSettings
from lanenet.data.drives.folder import DriveWriter
from lanenet.data.maps.folder import read_map


def test_repeated_frames_are_not_mapped_and_do_not_cut_the_drive(tmp_path: Path):
    """A camera thread that falls behind records a picture twice, and the car stands for a while."""
    camera = fisheye(pitch_down_rad=0.42)
    camera = replace(camera, K=camera.K * np.array([[0.75, 0.0, 1.0], [0.0, 0.75, 1.0], [0.0, 0.0, 1.0]]))
    drive, _ = loop_drive(camera, 76, 90, 360.0)
    rows = np.arange(76)
    # Two pictures twice while the car drives on, and the fortieth over and over: it was told to stand.
    shown = np.concatenate([rows[:20], [19], rows[21:31], [30], rows[32:40], np.full(15, 39), rows[40:]])
    repeats = np.flatnonzero(np.diff(shown, prepend=-1) == 0)
    with DriveWriter(tmp_path / "drive", camera=camera, lane_width_cm=36.0) as writer:
        for k, row in enumerate(shown):
            writer.add(drive.image(int(row)), 0.05 * k, speed_cm_s=0.0 if 38 < k < 54 else 80.0)
    settings = MapSettings(
        filter=FilterSettings(particles=80, max_points=80), bundle=BundleSettings(points=40)
    )
    report = map_drive(MapRequest(tmp_path / "drive", 36.0), settings, tmp_path / "map")
    assert (
        f"{len(repeats)} frames show the same as the one before, and are left out" in report.figures["notes"]
    )
    assert report.figures["segments"] == 1 and report.figures["frames"] == 74
    mapped = read_map(tmp_path / "map")
    np.testing.assert_array_equal(mapped.frames, np.setdiff1d(np.arange(len(shown)), repeats))
    np.testing.assert_allclose(mapped.t_s, 0.05 * mapped.frames, atol=1e-6)
    assert not mapped.segment.any()
    # The car drove on from where it stood; only the two pictures that are missing make longer steps.
    step = np.linalg.norm(np.diff(mapped.poses[:, :2], axis=0), axis=1) / 4.0
    after = np.diff(shown[mapped.frames])
    assert step[after == 1].max() < 1.5
    assert (step[after == 2] > 1.5).all() and (step[after == 2] < 2.5).all()
    assert step.sum() == pytest.approx(75.0, rel=0.1)
