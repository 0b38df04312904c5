"""Stages over the segments of a drive: the camera from one of them, then poses and lanes of each.

A segment that cannot be mapped does not spoil the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Int

from datagen.lanes.find import MappedSegment, check_lane, find_lane
from datagen.prepare import PreparedDrive, check_edges
from datagen.slam.camera.self_calibration import find_camera
from datagen.slam.join import frames_text
from datagen.slam.segment import SegmentSolver, SolvedSegment
from lanenet.data.drives import Drive
from lanenet.errors import CalibrationError, TrackingLostError
from lanenet.geometry.camera import Camera


@dataclass(frozen=True)
class CameraOfDrive:
    """The camera to map with.

    Attributes:
        camera: In centimetres where it was known, else of nominal height.
        how: How it was found, for the files.
        solved: Segments that were solved on the way, by their place among the segments.
        figures: For the report.
        notes: A sentence each.
    """

    camera: Camera
    how: str = "given"
    solved: dict[int, SolvedSegment] = field(default_factory=dict)
    figures: dict[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Refused:
    """A segment that cannot be mapped.

    Attributes:
        rows: Its frames, as positions in the drive.
        reason: Why.
    """

    rows: Int[np.ndarray, "n"]
    reason: TrackingLostError | CalibrationError

    def note(self, drive: Drive) -> str:
        """Name the frames that were left out, and why."""
        return f"{frames_text(drive, self.rows)} left out: {str(self.reason).removeprefix(f'{drive.path}: ')}"


@dataclass(frozen=True)
class SolvedDrive:
    """Segments of a drive with their poses, in its order, and those that could not be tracked."""

    segments: tuple[SolvedSegment, ...]
    refused: tuple[Refused, ...]


@dataclass(frozen=True)
class LanesOfDrive:
    """Segments of a drive with their lanes, at least one, in its order; and notes on those left out."""

    segments: tuple[MappedSegment, ...]
    notes: tuple[str, ...]


def camera_of_drive(prepared: PreparedDrive, solver: SegmentSolver) -> CameraOfDrive:
    """Take the known camera, or find it on the longest segment; refine it there if that was asked for.

    Raises:
        TrackingLostError: If that segment shows too few edges of the road.
    """
    segments = prepared.segments
    if prepared.camera is not None and not prepared.request.refine_camera:
        return CameraOfDrive(prepared.camera)
    longest = max(range(len(segments)), key=lambda i: segments[i].stop - segments[i].start)
    drive = prepared.drive.subset(segments[longest])
    check_edges(drive, prepared.settings.perception.edges)
    found = find_camera(drive, prepared.camera, solver, solver.progress)
    figures = {"calibration": found.figures}
    return CameraOfDrive(found.camera, found.how, {longest: found.solved}, figures, (found.note,))


def solve_segments(prepared: PreparedDrive, camera: CameraOfDrive, solver: SegmentSolver) -> SolvedDrive:
    """Track each segment, close its loops and adjust it."""
    found, refused = [], []
    for i, segment in enumerate(prepared.segments):
        rows = np.arange(segment.start, segment.stop)
        try:
            one = camera.solved.get(i) or solver.solve(prepared.drive.subset(segment), camera.camera)
        except (TrackingLostError, CalibrationError) as error:
            refused.append(Refused(rows, error))
        else:
            found.append(replace(one, rows=rows))
    return SolvedDrive(tuple(found), tuple(refused))


def fit_lanes(
    prepared: PreparedDrive, segments: Sequence[SolvedSegment], refused: Sequence[Refused]
) -> LanesOfDrive:
    """Find the lane of each segment.

    Args:
        prepared: The drive.
        segments: Segments with their poses.
        refused: Those that could not be tracked.

    Raises:
        TrackingLostError: If no segment can be mapped; says why the longest one cannot.
        CalibrationError: The same, where the longest one shows a lane of another width.
    """
    drive, settings, held_out = prepared.drive, prepared.settings, prepared.held_out
    mapped, left_out = [], list(refused)
    for segment in segments:
        rows, lane_cm = segment.rows, prepared.known_lane_cm
        try:
            one = find_lane(segment, lane_cm, held_out[rows], settings.trace, settings.fit)
            check_lane(one, drive)
        except (TrackingLostError, CalibrationError) as error:
            left_out.append(Refused(rows, error))
        else:
            mapped.append(one)
    if not mapped:
        raise max(left_out, key=lambda one: len(one.rows)).reason
    return LanesOfDrive(tuple(mapped), tuple(one.note(drive) for one in left_out))
