"""The contents of a map's report: figures for programs, sentences for people, and the map's edge points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Int

from datagen.lanes.find import MappedSegment
from datagen.quality.measure import MapQuality
from datagen.quality.residuals import coverage
from datagen.quality.verdict import MapEvidence
from datagen.slam.commands import BREAK_PERIODS, commands_of, fit_steering
from datagen.slam.loops.pose_graph import revisit_residuals
from lanenet.data.maps.folder import DriveMap
from lanenet.data.maps.line import LaneLine
from lanenet.data.maps.mapped_drive import NOT_MAPPED, MappedDrive
from lanenet.errors import counted
from lanenet.geometry.frames import map_from_car, map_from_car_directions


@dataclass(frozen=True)
class Report:
    """The result of a command: sentences for people (lines), figures for programs."""

    lines: tuple[str, ...]
    figures: dict[str, Any]


def map_edges(
    parts: list[MappedSegment], numbers: Int[np.ndarray, "f"], factor: float
) -> dict[str, np.ndarray]:
    """Return the columns of all edge points with their directions, frame map, as float32.

    Args:
        parts: Segments.
        numbers: Frame number of each position in the drive.
        factor: Converts the segments' lengths to centimetres.
    """
    parts_of: list[tuple[np.ndarray, ...]] = []
    for i, part in enumerate(parts):
        solved, scans = part.solved, part.solved.scans
        for k, pose in enumerate(solved.poses):
            at = scans.frame(k)
            # The segment's own wheelbase scales with its lengths; the map's camera has the car's.
            xy = factor * map_from_car(scans.points_cm[at], pose, solved.camera.wheelbase_cm)
            normal = map_from_car_directions(scans.normals[at], pose[2])
            numbered = np.full(len(xy), numbers[part.rows[k]]), np.full(len(xy), i)
            parts_of.append((*numbered, *np.concatenate([xy, normal], axis=1, dtype=np.float32).T))
    columns = (np.concatenate(column) for column in zip(*parts_of, strict=True))
    return dict(zip(("frame", "segment", "x_cm", "y_cm", "normal_x", "normal_y"), columns, strict=True))


def segment_figures(parts: list[MappedSegment], factor: float) -> list[dict[str, Any]]:
    """Collect the figures of each segment; the arguments are those of :func:`map_edges`."""
    segments = []
    for part in parts:
        solved = part.solved
        missed = np.abs(revisit_residuals(solved.poses, solved.revisits)[:, 1])
        segments.append(
            {
                "path_cm": factor * float(solved.path_cm[-1]),
                "revisits": len(solved.revisits),
                "closure_across_cm": factor * float(np.median(missed)) if len(missed) else None,
                "steering": None if solved.steering is None else vars(solved.steering),
                "closed": part.lines[0].period_cm is not None,
                "hanging": solved.hanging,
            }
        )
    return segments


def steering_answer(mapped: MappedDrive) -> float | None:
    """Correlate the path's curvature with the steering command, at the delay where that is strongest.

    Returns:
        Below 0 where the car turns right when it is steered left; None if nothing was commanded, or if the
        command does not explain the path.
    """
    drive_map = mapped.drive_map
    commands = commands_of(mapped.drive, drive_map.camera.wheelbase_cm).only(mapped.rows)
    if commands.turn is None:
        return None
    periods, turn = np.where(mapped.starts, BREAK_PERIODS, commands.periods), commands.turn
    found = []
    for sign in (1.0, -1.0):
        steered = replace(commands, periods=periods, turn=sign * turn)
        fit = fit_steering(drive_map.poses, steered, drive_map.camera.mounting.height_cm)
        found += [] if fit is None else [sign * fit.correlation]
    return max(found, key=abs, default=None)


def map_evidence(
    drive_map: DriveMap, figures: dict[str, Any], quality: MapQuality, free_cm: float | None
) -> MapEvidence:
    """Collect the evidence for the verdict.

    Args:
        drive_map: The map.
        figures: Figures of the map.
        quality: What its frames show of it.
        free_cm: Lane width found without the given one, if it fits better; else None.
    """
    meta, height_cm = drive_map.meta, drive_map.camera.mounting.height_cm
    told_cm = figures["given"]["lane_width_cm"]
    calibration = figures.get("calibration", {})
    segments, frames = figures["segments_mapped"], np.bincount(drive_map.segment)
    revisits = sum(segment["revisits"] for segment in segments)
    across_cm = sum((segment["closure_across_cm"] or 0.0) * segment["revisits"] for segment in segments)
    # A given camera that the drive has refined counts as known: its lens was not searched for.
    known = not calibration.get("candidates")
    largest, steps_cm = int(np.argmax(frames)), np.diff(drive_map.poses, axis=0)
    loose = segments[largest].get("hanging", 0)  # reports of earlier versions do not know
    # As many times round as a circle is longer than the diagonal of the square around it.
    extent_cm = float(np.hypot(*np.ptp(drive_map.poses[drive_map.segment == largest, :2], axis=0)))
    rounds = segments[largest]["path_cm"] / max(extent_cm * np.pi / 2.0**0.5, 1.0)
    why_open = (
        ("none of its parts has most of the frames", 2 * frames[largest] <= frames.sum()),
        ("places do not tell how long a lap is", calibration.get("alike", False)),
        ("nothing certainly closes the lap", not segments[largest]["closed"]),
        (f"{counted(loose, 'frame')} joined at one end, or not at all", loose > 0.01 * frames[largest]),
    )
    return MapEvidence(
        labels=quality.labels,
        coverage=coverage(np.concatenate(quality.held_out[:2])),
        wrong=tuple(one.text(drive_map) for one in quality.wrong),
        wrong_share=quality.wrong_share,
        revisits=revisits,
        laps=max(meta.laps, int(np.ptp(drive_map.poses[:, 2]) / (2.0 * np.pi)), int(rounds)),
        open_for=next((why for why, is_so in why_open if is_so), ""),
        closure_across_heights=across_cm / revisits / height_cm if revisits else None,
        sigma=figures.get("camera_sigma", {}) if known else calibration["sigma"],
        missed=0.0 if known else calibration.get("missed", 0.0),
        # Reports of earlier versions do not know.
        turn_open=not known and bool(revisits) and not calibration.get("closed", True),
        strain=0.0 if known else calibration.get("strain", 0.0),
        given_lane_cm=meta.lane_width_cm,
        bend_lane_cm=figures["lane_width"]["bend_cm"],
        open_lane_cm=figures["lane_width"]["open_cm"],
        found_lane_cm=None if meta.scale_from == "lane width" else free_cm or meta.mapped_lane_cm,
        height_cm=height_cm,
        tape_cm=meta.tape_cm,
        # The map of a known camera has another lane width than the given one only then.
        outer_lane_cm=None if meta.lane_width_cm == told_cm or meta.scale_from != "camera" else told_cm,
        given_height_cm=figures["given"]["camera_height_cm"],
        given_tape_cm=figures["given"]["tape_width_cm"],
        ahead_cm=drive_map.camera.mounting.ahead_of_front_axle_cm,
        tape_range_cm=tape_range_cm([line for lines in drive_map.lines.values() for line in lines]),
        steering=figures["steering_correlation"],
        elsewhere=int(frames.sum() - frames.max()) + quality.status.count(NOT_MAPPED),
        speed_cm_s=float(np.median(np.hypot(*steps_cm[:, :2].T)) / np.median(np.diff(drive_map.t_s))),
        pauses=figures.get("pauses", 0),
    )


def tape_range_cm(lines: Sequence[LaneLine]) -> tuple[float, float] | None:
    """Percentiles 5 and 95 of the tape's width along the line on which it varies most; None if unknown."""
    ranges = []
    for line in lines:
        known = line.supported(line.sigma_s_cm)
        if len(line.marking_at_cm) and known.any():
            ranges.append(np.percentile(line.marking_at_cm[known], [5.0, 95.0]).tolist())
    return max(map(tuple, ranges), key=lambda ends: ends[1] / ends[0], default=None)


def map_notes(drive_map: DriveMap, segments: list[dict[str, Any]], frames: int, free: bool) -> list[str]:
    """Say in sentences what was mapped.

    Args:
        drive_map: The map.
        segments: Their figures.
        frames: Number of frames of the drive.
        free: Whether a lane of another width fits the road better than the mapped one.
    """
    meta = drive_map.meta
    revisits = sum(segment["revisits"] for segment in segments)
    metres = 0.01 * sum(segment["path_cm"] for segment in segments)
    return [
        f"{len(drive_map.frames)} of {frames} frames mapped, {metres:.1f} m of road, {revisits} revisits"
        + ("" if revisits else ": no loop was certainly closed"),
        f"{'distance of the mapped lines' if free else 'lane'} {meta.mapped_lane_cm:.1f} cm, {meta.markings} "
        f"marking {meta.tape_cm:.1f} cm, scale from the {meta.scale_from}",
    ]
