"""Segments with their lanes -> one map in centimetres, with its frames in the order of the drive."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from datagen.lanes.find import MappedSegment
from datagen.lanes.scale import LaneWidth, ahead_sigma, fitted_width
from datagen.prepare import PreparedDrive
from datagen.slam.camera.coarse import with_known_scale
from datagen.slam.odometry.scans import distances_seen
from datagen.slam.segment import SolvedSegment
from lanenet.data.maps.folder import FORMAT, DriveMap, MapMeta
from lanenet.geometry.camera import Camera
from lanenet.geometry.frames import map_from_car

#: Edge points up to this distance are drawn, in camera heights. Chosen: further ones scatter.
_DRAWN_HEIGHTS = 3.0


@dataclass(frozen=True)
class AssembledMap:
    """A map, and the segments that it was assembled from.

    Attributes:
        drive_map: The map, [cm].
        segments: Its segments, in the scale of the camera that they were solved with.
        rows: Its frames, as positions in the drive.
        factor: Turns the segments' lengths into centimetres.
        lane: Width of the driven lane, [cm].
    """

    drive_map: DriveMap
    segments: list[MappedSegment]
    rows: Int[np.ndarray, "n"]
    factor: float
    lane: LaneWidth

    @property
    def open_poses(self) -> Float[np.ndarray, "n 3"]:
        """Poses before loops were closed, [cm]."""
        return _in_order(self.segments, [s.solved.open_poses for s in self.segments]) * _pose_scale(
            self.factor
        )

    @property
    def near_points(self) -> list[Float[np.ndarray, "_ 2"]]:
        """Edge points of each frame that are near enough to be drawn, [cm], frame map."""
        return [self.factor * points for s in self.segments for points in near_points(s.solved)]


def near_points(solved: SolvedSegment) -> list[Float[np.ndarray, "_ 2"]]:
    """Edge points of each frame that are near enough to be drawn, in the scale of the segment's camera."""
    mounting = solved.camera.mounting
    points, reach_cm = [], _DRAWN_HEIGHTS * mounting.height_cm
    for k in range(len(solved.poses)):
        seen = solved.scans.points_cm[solved.scans.frame(k)]
        seen = seen[distances_seen(seen, mounting.lead_cm) < reach_cm]
        points.append(map_from_car(seen, solved.poses[k], solved.camera.wheelbase_cm))
    return points


def assemble(
    prepared: PreparedDrive,
    camera: Camera,
    sigma: dict[str, float],
    mapped: Sequence[MappedSegment],
    lane: LaneWidth | None = None,
) -> AssembledMap:
    """Put the segments in one map, in centimetres; the lane width sets the scale of an unknown camera.

    Args:
        prepared: The drive, with the lane width that was given.
        camera: The camera, known or found.
        sigma: Standard deviation of each of its numbers, none for a known camera.
        mapped: Segments in its scale.
        lane: Width of the driven lane in that scale; None to take that of the longest segment.
    """
    request, segments = prepared.request, list(mapped)
    longest = max(segments, key=lambda s: len(s.rows))
    if lane is None:
        lane = fitted_width(longest.lines, longest.lane, longest.s_frames_cm)
    factor = 1.0
    if prepared.camera is None:
        factor = request.lane_width_cm / lane.width_cm
        camera = with_known_scale(camera, factor, prepared.settings.guess.wheelbase_cm)
    drive, rows = prepared.drive, np.sort(np.concatenate([s.rows for s in segments]))
    markings_cm = [line.marking_cm for s in segments for line in s.lines[:2]]
    meta = MapMeta(
        format=FORMAT,
        drive=str(request.drive_path),
        lane_width_cm=request.lane_width_cm,
        mapped_lane_cm=factor * lane.width_cm,
        tape_cm=factor * float(np.median(markings_cm)),
        scale_from="lane width" if prepared.camera is None else "camera",
        laps=max(int(s.laps.max()) for s in segments),
        markings="dark" if longest.dark else "light",
        ahead_sigma_cm=ahead_sigma(camera, sigma),
    )
    numbers = [np.full(len(s.rows), i) for i, s in enumerate(segments)]
    drive_map = DriveMap(
        meta=meta,
        camera=camera,
        frames=drive.frames[rows],
        t_s=drive.t_s[rows],
        poses=_in_order(segments, [s.solved.poses for s in segments]) * _pose_scale(factor),
        lap=_in_order(segments, [s.laps for s in segments]),
        segment=_in_order(segments, numbers),
        s_cm=_in_order(segments, [s.s_frames_cm for s in segments]) * factor,
        match=_in_order(segments, [s.solved.trajectory.match for s in segments]),
        lines={i: [line.scaled(factor) for line in s.lines] for i, s in enumerate(segments)},
        tilt_rad=_in_order(segments, [s.solved.bundle.tilt for s in segments]),
        held_out=prepared.held_out[rows],
        # Found by the check.
        contradicted=np.zeros((len(rows), 2), dtype=bool),
        marks=tuple(prepared.marks[row] for row in rows.tolist()) if prepared.marks else None,
    )
    return AssembledMap(drive_map, segments, rows, factor, lane.scaled(factor))


def _pose_scale(factor: float) -> Float[np.ndarray, "3"]:
    return np.array([factor, factor, 1.0])


def _in_order(segments: list[MappedSegment], values: list[np.ndarray]) -> np.ndarray:
    """Values per frame of each segment, in the order of the drive: a segment may lie within another one."""
    return np.concatenate(values)[np.argsort(np.concatenate([s.rows for s in segments]))]
