"""All segments of a drive, solved and given lanes; one that cannot be mapped does not spoil the others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Int

from datagen.lanes.find import find_lane
from datagen.lanes.mapped import MappedSegment, check_lane
from datagen.settings import MapSettings
from datagen.slam.join import frames_text
from datagen.slam.segment import SegmentSolver, SolvedSegment
from lanenet.data.drives import Drive
from lanenet.errors import CalibrationError, TrackingLostError
from lanenet.geometry.camera import Camera


@dataclass(frozen=True)
class Refused:
    """A segment that cannot be mapped.

    Attributes:
        rows: Its frames, as positions in the drive.
        reason: Why.
    """

    rows: Int[np.ndarray, "n"]
    reason: TrackingLostError | CalibrationError


@dataclass(frozen=True)
class SolvedDrive:
    """Segments of a drive with their poses, in its order, and those that could not be tracked."""

    segments: tuple[SolvedSegment, ...]
    refused: tuple[Refused, ...]


@dataclass(frozen=True)
class MappedDriveSegments:
    """Segments of a drive with their lanes, in its order.

    Attributes:
        segments: At least one.
        notes: Which segments were left out, and why, a sentence each.
    """

    segments: tuple[MappedSegment, ...]
    notes: tuple[str, ...]


def solve_segments(
    drive: Drive,
    segments: Sequence[slice],
    camera: Camera,
    solver: SegmentSolver,
    solved: Mapping[int, SolvedSegment],
) -> SolvedDrive:
    """Track each segment, close its loops and adjust it.

    Args:
        drive: The drive.
        segments: Its segments, as positions in it.
        camera: Camera of all of them.
        solver: Solves them.
        solved: Segments that are solved already, by their place in ``segments``.
    """
    found, refused = [], []
    for i, segment in enumerate(segments):
        rows = np.arange(segment.start, segment.stop)
        try:
            one = solved.get(i) or solver.solve(drive.subset(segment), camera)
        except (TrackingLostError, CalibrationError) as error:
            refused.append(Refused(rows, error))
        else:
            found.append(replace(one, rows=rows))
    return SolvedDrive(tuple(found), tuple(refused))


def fit_lanes(
    segments: Sequence[SolvedSegment],
    refused: Sequence[Refused],
    drive: Drive,
    lane_width_cm: float | None,
    held_out: Bool[np.ndarray, "n"],
    settings: MapSettings,
) -> MappedDriveSegments:
    """Find the lane of each segment.

    Args:
        segments: Segments with their poses.
        refused: Those that could not be tracked.
        drive: The drive.
        lane_width_cm: Width of the driven lane in the scale of the camera; None where that is not known.
        held_out: Frames whose edge points are held out from the lines.
        settings: Settings of all stages.

    Raises:
        TrackingLostError: If no segment can be mapped; says why the longest one cannot.
        CalibrationError: The same, where the longest one shows a lane of another width.
    """
    mapped, left_out = [], list(refused)
    for segment in segments:
        try:
            one = find_lane(segment, lane_width_cm, held_out[segment.rows], settings.trace, settings.fit)
            check_lane([one], drive)
        except (TrackingLostError, CalibrationError) as error:
            left_out.append(Refused(segment.rows, error))
        else:
            mapped.append(one)
    if not mapped:
        raise max(left_out, key=lambda one: len(one.rows)).reason
    notes = (
        f"{frames_text(drive, one.rows)} left out: {str(one.reason).removeprefix(f'{drive.path}: ')}"
        for one in left_out
    )
    return MappedDriveSegments(tuple(mapped), tuple(notes))
