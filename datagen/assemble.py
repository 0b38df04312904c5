"""Segments with their lanes -> one map in centimetres, with its frames in the order of the drive."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from datagen.lanes.find import MappedSegment
from datagen.lanes.scale import LaneWidth, ahead_sigma, fitted_width
from datagen.prepare import PreparedDrive
from datagen.quality.figures import map_edges, segment_figures
from datagen.slam.camera.coarse import with_known_scale
from datagen.slam.odometry.scans import distances_seen
from lanenet.data.maps.folder import FORMAT, DriveMap, MapMeta
from lanenet.data.maps.label_errors import LabelErrors
from lanenet.geometry.camera import Camera
from lanenet.geometry.frames import car_from_map

#: Edge points up to this distance are drawn, in camera heights. Chosen: further ones scatter.
_DRAWN_HEIGHTS = 3.0


@dataclass(frozen=True)
class AssembledMap:
    """A map, with what is written beside it, in centimetres.

    Attributes:
        drive_map: The map.
        rows: Its frames, as positions in the drive.
        lane: Width of the driven lane.
        edges: Columns of all edge points, see :func:`datagen.quality.figures.map_edges`.
        open_poses: Poses before loops were closed.
        segments: Figures of each segment, see :func:`datagen.quality.figures.segment_figures`.
        free_lane_cm: Median of the segments' freely found lane widths that fit better; None if none does.
        factor: What turned the lengths of the camera that was solved with into centimetres.
    """

    drive_map: DriveMap
    rows: Int[np.ndarray, "n"]
    lane: LaneWidth
    edges: dict[str, np.ndarray]
    open_poses: Float[np.ndarray, "n 3"]
    segments: list[dict[str, Any]]
    free_lane_cm: float | None = None
    factor: float = 1.0

    @property
    def near_points(self) -> list[Float[np.ndarray, "_ 2"]]:
        """Edge points of each frame near enough to be drawn, frame map; those of the first segment first."""
        m, camera = self.drive_map, self.drive_map.camera
        in_order = np.argsort(m.segment, kind="stable")
        counts = np.bincount(np.searchsorted(m.frames, self.edges["frame"]), minlength=len(m.frames))[
            in_order
        ]
        points = np.column_stack([self.edges["x_cm"], self.edges["y_cm"]]).astype(np.float64)
        near, reach_cm = [], _DRAWN_HEIGHTS * camera.mounting.height_cm
        for k, seen in zip(in_order, np.split(points, np.cumsum(counts)[:-1]), strict=True):
            seen_car = car_from_map(seen, m.poses[k], camera.wheelbase_cm)
            near.append(seen[distances_seen(seen_car, camera.mounting.lead_cm) < reach_cm])
        return near

    def asked_for_by(self, options: tuple[str, ...]) -> AssembledMap:
        """Return the map with the options of ``lanenet map`` that asked for it, but for the lane width."""
        meta = self.drive_map.meta.model_copy(update={"options": options})
        return replace(self, drive_map=replace(self.drive_map, meta=meta))

    def scaled(self, factor: float, sigma: dict[str, float]) -> AssembledMap:
        """Return the map with every length multiplied by a factor, as if the lane were so much wider.

        The wheelbase is the car's own and stays; the distance of the camera from the rear axle is scaled.

        Args:
            factor: Of all lengths.
            sigma: Standard deviation of each number of the camera.
        """
        m = self.drive_map
        camera = with_known_scale(m.camera, factor, m.camera.wheelbase_cm)
        lengths = {
            name: factor * getattr(m.meta, name) for name in ("lane_width_cm", "mapped_lane_cm", "tape_cm")
        }
        scaled = replace(
            m,
            meta=m.meta.model_copy(update={**lengths, "ahead_sigma_cm": ahead_sigma(camera, sigma)}),
            camera=camera,
            poses=m.poses * _pose_scale(factor),
            s_cm=m.s_cm * factor,
            lines={number: [line.scaled(factor) for line in lines] for number, lines in m.lines.items()},
        )
        return replace(
            self,
            drive_map=scaled,
            lane=self.lane.scaled(factor),
            edges=self.edges | {name: np.float32(factor) * self.edges[name] for name in ("x_cm", "y_cm")},
            open_poses=self.open_poses * _pose_scale(factor),
            segments=scaled_figures(self.segments, factor),
            free_lane_cm=None if self.free_lane_cm is None else factor * self.free_lane_cm,
            factor=factor * self.factor,
        )


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
        lane_width_cm=lane.width_cm if longest.is_one_of_several else request.lane_width_cm,
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
        errors=LabelErrors.none(len(rows)),
        marks=tuple(prepared.marks[row] for row in rows.tolist()) if prepared.marks else None,
    )
    return AssembledMap(
        drive_map,
        rows,
        lane.scaled(factor),
        map_edges(segments, drive.frames, factor),
        _in_order(segments, [s.solved.open_poses for s in segments]) * _pose_scale(factor),
        segment_figures(segments, factor),
        _free_lane_cm(segments),
        factor,
    )


def scaled_figures(segments: list[dict[str, Any]], factor: float) -> list[dict[str, Any]]:
    """Multiply the lengths in segments' figures by a factor: those under names in ``_cm``."""
    return [
        {name: factor * x if name.endswith("_cm") and x is not None else x for name, x in one.items()}
        for one in segments
    ]


def _free_lane_cm(parts: list[MappedSegment]) -> float | None:
    """Median of the segments' freely found lane widths; None if they have none."""
    free = [part.free_lane_cm for part in parts if part.free_lane_cm is not None]
    return float(np.median(free)) if free else None


def _pose_scale(factor: float) -> Float[np.ndarray, "3"]:
    return np.array([factor, factor, 1.0])


def _in_order(segments: list[MappedSegment], values: list[np.ndarray]) -> np.ndarray:
    """Values per frame of each segment, in the order of the drive: a segment may lie within another one."""
    return np.concatenate(values)[np.argsort(np.concatenate([s.rows for s in segments]))]
