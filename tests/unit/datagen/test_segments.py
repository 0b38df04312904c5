"""Segments of a drive: each keeps its own poses, and one that cannot be mapped leaves the others."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from made_up_drive import made_up_drive

from datagen import pipeline, prepare
from datagen import segments as drive_segments
from datagen.lanes.find import MappedSegment
from datagen.lanes.trace import TracedLane
from datagen.segments import LanesOfDrive
from datagen.settings import MapSettings
from datagen.slam.adjustment.adjust import BundleResult
from datagen.slam.camera.coarse import guessed_camera
from datagen.slam.filter.dp_slam import Trajectory
from datagen.slam.odometry.scans import pack_scans
from datagen.slam.segment import SegmentSolver, SolvedSegment
from datagen.slam.settings import GuessSettings
from lanenet.data.drives.recording import Drive
from lanenet.data.maps.line import LaneLine, Side
from lanenet.errors import CalibrationError, TrackingLostError
from lanenet.geometry.camera import Camera
from lanenet.perception.edges.road import RoadEdges

CAMERA = guessed_camera(160, 120, 80.0, 15.0, GuessSettings())
SETTINGS = MapSettings(find_bumper=False)


class _StopError(Exception):
    """Ends a run once what it hands on has been seen."""


def _solved(n: int) -> SolvedSegment:
    poses = np.column_stack([3.0 * np.arange(n), np.zeros(n), np.zeros(n)])
    nothing = pack_scans([RoadEdges(np.empty((0, 2)), np.empty((0, 2)))] * n, 15.0)
    bundle = BundleResult(poses, np.zeros((n, 2)), CAMERA, {}, np.zeros(5), 1.0, 10)
    trajectory = Trajectory(poses, np.ones(n), np.ones(n), np.zeros(n))
    return SolvedSegment(np.arange(n), CAMERA, nothing, trajectory, poses, poses, None, [], None, bundle)


@pytest.mark.parametrize("at", [70, 130])
def test_each_segment_keeps_its_own_poses_where_the_longest_gave_the_camera(monkeypatch, at):
    drive = made_up_drive(200, [at], first_frame=1000)
    longest = _solved(130)
    seen: list[SolvedSegment] = []

    def join(found: tuple[SolvedSegment, ...], *_: object) -> None:
        seen.extend(found)
        raise _StopError

    def find(part: Drive, *_: object, **__: object) -> SimpleNamespace:
        assert len(part) == 130
        return SimpleNamespace(solved=longest, camera=CAMERA, how="found", figures={}, note="found")

    monkeypatch.setattr(prepare, "open_drive", lambda path: drive)
    monkeypatch.setattr(prepare, "following_frames", lambda drive: (drive, []))
    monkeypatch.setattr(prepare, "keep_images", lambda drive: drive)
    monkeypatch.setattr(prepare, "check_moving", lambda *_: None)
    monkeypatch.setattr(prepare, "readable_frames", lambda drive: (drive, []))
    monkeypatch.setattr(prepare, "check_lens", lambda *_: None)
    monkeypatch.setattr(drive_segments, "check_edges", lambda *_: None)
    monkeypatch.setattr(drive_segments, "find_camera", find)
    monkeypatch.setattr(SegmentSolver, "solve", lambda self, part, camera: _solved(len(part)))
    monkeypatch.setattr(pipeline, "join_segments", join)
    with pytest.raises(_StopError):
        pipeline.map_drive(pipeline.MapRequest(Path("made-up"), 40.0), SETTINGS, Path("nowhere"))
    assert [(int(s.rows[0]), int(s.rows[-1])) for s in seen] == [(0, at - 1), (at, 199)]
    assert [len(s.poses) for s in seen] == [at, 200 - at]
    assert next(s for s in seen if len(s.rows) == 130).poses is longest.poses


def _line(side: Side, until_cm: float) -> LaneLine:
    knots = np.concatenate([np.zeros(3), np.linspace(0.0, 3000.0, 6), np.full(3, 3000.0)])
    return LaneLine(side, knots, np.zeros((8, 2)), np.array([[0.0, until_cm]]), 0.1)


def _map(
    monkeypatch: pytest.MonkeyPatch,
    drive: Drive,
    no_edges: tuple[int, ...] = (),
    no_lane: tuple[int, ...] = (),
    one_line: tuple[int, ...] = (),
    other_lane: tuple[int, ...] = (),
) -> LanesOfDrive:
    """Map a drive whose segments of some lengths show no edges, no lane, one line only, or another lane."""

    def solve(self: SegmentSolver, part: Drive, camera: Camera) -> SolvedSegment:
        if len(part) in no_edges:
            raise TrackingLostError(f"{part.path}: {len(part)} frames, 3 edge points per frame")
        return _solved(len(part))

    def find_lane(segment: SolvedSegment, *_: object) -> MappedSegment:
        n = len(segment.rows)
        if n in no_lane:
            raise TrackingLostError(f"no pair of lines in {n} frames")
        if n in other_lane:
            raise CalibrationError(f"a lane of 30 cm in {n} frames, expected 40 cm")
        lane = TracedLane(np.zeros(2), np.zeros(2), np.zeros(2), 40.0, 2.0)
        # The right line ends early where there is one line only.
        lines = [_line("left", 3.0 * n), _line("right", 0.3 * n if n in one_line else 3.0 * n)]
        return MappedSegment(segment, 3.0 * np.arange(n), lane, lines)

    monkeypatch.setattr(SegmentSolver, "solve", solve)
    monkeypatch.setattr(drive_segments, "find_lane", find_lane)
    prepared = prepare.PreparedDrive(
        request=prepare.MapRequest(drive.path, 40.0),
        drive=drive,
        segments=prepare.split_segments(drive),
        held_out=np.zeros(len(drive), dtype=bool),
        settings=SETTINGS,
        camera=CAMERA,
        notes=(),
    )
    solver = SegmentSolver(SETTINGS, np.random.default_rng(0))
    camera = drive_segments.camera_of_drive(prepared, solver)
    solved = drive_segments.solve_segments(prepared, camera, solver)
    return drive_segments.fit_lanes(prepared, solved.segments, solved.refused)


@pytest.mark.parametrize(
    ("bad", "why"),
    [
        ({"no_edges": (70,)}, "70 frames, 3 edge points per frame"),
        ({"no_lane": (70,)}, "no pair of lines in 70 frames"),
        ({"one_line": (70,)}, "one line only bounds the driven lane"),
        ({"other_lane": (70,)}, "a lane of 30 cm in 70 frames, expected 40 cm"),
    ],
)
def test_a_segment_that_cannot_be_mapped_is_left_out_and_said(monkeypatch, bad, why):
    mapped = _map(monkeypatch, made_up_drive(1000, [300, 370], first_frame=1000), **bad)
    assert [(int(s.rows[0]), int(s.rows[-1])) for s in mapped.segments] == [(0, 299), (370, 999)]
    (note,) = mapped.notes
    assert note.startswith(f"frames 1300-1369 left out: {why}")


def test_the_longest_segment_says_why_nothing_could_be_mapped(monkeypatch):
    with pytest.raises(TrackingLostError, match="no pair of lines in 130 frames"):
        _map(monkeypatch, made_up_drive(200, [70], first_frame=1000), no_edges=(70,), no_lane=(130,))
    with pytest.raises(TrackingLostError, match="130 frames, 3 edge points"):
        _map(monkeypatch, made_up_drive(200, [70], first_frame=1000), no_edges=(130,), no_lane=(70,))
    with pytest.raises(CalibrationError, match="a lane of 30 cm in 130 frames"):
        _map(monkeypatch, made_up_drive(200, [70], first_frame=1000), no_edges=(70,), other_lane=(130,))


def test_nothing_is_said_where_all_is_mapped(monkeypatch):
    mapped = _map(monkeypatch, made_up_drive(200, [70], first_frame=1000))
    assert len(mapped.segments) == 2 and not mapped.notes
