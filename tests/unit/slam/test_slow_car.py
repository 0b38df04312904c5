"""A car that is slow for a part of its drive: tracked by keyframes, every frame on the map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from picture_road import loop_drive, made_up_drive
from pixel_road import fisheye

from datagen.settings import MapSettings
from datagen.slam.adjustment.adjust import BundleResult, BundleSettings
from datagen.slam.commands import commands_of
from datagen.slam.filter.dp_slam import FilterSettings, Trajectory
from datagen.slam.keyframes import keyframe_pairs
from datagen.slam.loops.revisits import Revisit
from datagen.slam.odometry.scans import pack_scans
from datagen.slam.segment import SegmentSolver, SolvedSegment
from lanenet.data.drives.recording import Commands, Drive
from lanenet.geometry.camera import Camera
from lanenet.geometry.poses import path_lengths

SMALL = MapSettings(filter=FilterSettings(particles=80, max_points=80), bundle=BundleSettings(points=40))
STEP_CM, SLOW_FRAMES = 0.6, 180


def _camera() -> Camera:
    """A wide lens that looks well down, so that many of the few dashes are in view."""
    camera = fisheye(pitch_down_rad=0.42)
    return replace(camera, K=camera.K * np.array([[0.75, 0.0, 1.0], [0.0, 0.75, 1.0], [0.0, 0.0, 1.0]]))


def _drive() -> tuple[Drive, np.ndarray]:
    """Frames 6 mm apart, then 3 cm, on a loop of 360 cm, most of it driven."""
    drive, poses = loop_drive(_camera(), 480, 600, 600 * STEP_CM, seed=1)
    rows = np.r_[0:SLOW_FRAMES, SLOW_FRAMES:480:5]
    step_cm = np.where(rows < SLOW_FRAMES, STEP_CM, 5.0 * STEP_CM)
    thinned = replace(drive.subset(rows), t_s=0.05 * np.arange(len(rows)))
    return replace(thinned, commands=Commands(speed_cm_s=step_cm / 0.05)), poses[rows]


@pytest.fixture(scope="module")
def solved() -> tuple[SolvedSegment, np.ndarray]:
    drive, true = _drive()
    return SegmentSolver(SMALL, np.random.default_rng(0)).solve(drive, _camera()), true


def test_the_distance_is_that_of_the_car_slow_or_not(solved):
    segment, true = solved
    assert len(segment.poses) == len(segment.scans) == len(true)
    found, driven = path_lengths(segment.poses), path_lengths(true)
    for start, stop in ((0, SLOW_FRAMES), (SLOW_FRAMES, len(true) - 1)):
        distance = driven[stop] - driven[start]
        assert found[stop] - found[start] == pytest.approx(distance, rel=0.04)
    assert found[-1] == pytest.approx(driven[-1], rel=0.02)
    turn = segment.poses[-1, 2] - segment.poses[0, 2]
    assert turn == pytest.approx(true[-1, 2] - true[0, 2], abs=np.deg2rad(3.0))


def test_every_frame_of_the_slow_part_moves_on(solved):
    segment, _ = solved
    steps_cm = np.diff(path_lengths(segment.poses))[: SLOW_FRAMES - 1]
    assert steps_cm.min() > 0.3 * STEP_CM and steps_cm.max() < 1.8 * STEP_CM
    assert segment.bundle.robust_sd_px < 0.3
    # Steps from keyframe to keyframe are those of a drive.
    matches = len(np.unique(segment.trajectory.match[1:]))
    assert matches == pytest.approx(SLOW_FRAMES / 4 + 60, abs=8)


def test_where_no_speed_was_recorded_a_slow_car_shows_by_its_step():
    drive, poses = loop_drive(_camera(), 130, 600, 600 * STEP_CM, seed=1)
    segment = SegmentSolver(SMALL, np.random.default_rng(0)).solve(drive, _camera())
    assert len(np.unique(segment.trajectory.match[1:])) < 50
    assert path_lengths(segment.poses)[-1] == pytest.approx(path_lengths(poses)[-1], rel=0.1)


class _StopError(Exception):
    """The rest is another test's."""


def test_revisits_that_the_map_of_keyframes_contradicts_hold_no_frames(monkeypatch):
    lap, keys = 150, np.arange(0, 301, 3)
    angle = 2.0 * np.pi * np.arange(301) / lap
    poses = np.column_stack([60.0 * np.sin(angle), -60.0 * np.cos(angle), angle])
    true = Revisit(5, 5 + lap // 3, np.zeros(3), 0.8, turns=1)
    # Half a lap further on it only looks alike.
    false = Revisit(10, 10 + lap // 2, np.zeros(3), 0.8)
    on_keys = poses[keys]
    still = np.zeros(len(keys))
    bundle = BundleResult(
        on_keys,
        np.zeros((len(keys), 2)),
        _camera(),
        {},
        np.zeros(1),
        np.zeros((0, 2), int),
        np.zeros(0, int),
        np.zeros(0),
    )
    solved = SolvedSegment(
        keys, _camera(), pack_scans([], 15.0), Trajectory(on_keys, still, still, still), on_keys, on_keys,
        None, [true, false], bundle, np.zeros(len(keys), np.int64),
    )  # fmt: skip
    drive = made_up_drive([np.zeros((120, 160, 3), np.uint8)] * 301)
    held: list[tuple[int, int]] = []

    def adjust(*args: object, **_: object) -> None:
        held.extend(args[5])
        raise _StopError

    monkeypatch.setattr("datagen.slam.segment.adjust", adjust)
    with pytest.raises(_StopError):
        solver = SegmentSolver(SMALL, np.random.default_rng(0))
        solver.place_between(solved, keys, np.full(301, 0.05), drive, commands_of(drive, 17.0))
    assert {(15 + d, 15 + lap + d) for d in range(-12, 13, 4)} <= set(held)
    assert not {(30 + d, 30 + 3 * lap // 2 + d) for d in range(-12, 13, 4)} & set(held)
    assert set(keyframe_pairs(keys, SMALL.bundle.lags, np.zeros(keys[-1] + 1, np.int64))) <= set(held)
