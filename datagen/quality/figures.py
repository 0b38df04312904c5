"""The contents of a map's report: figures for programs, sentences for people, and the map's edge points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Int

from datagen.lanes.find import MappedSegment
from datagen.quality.verdict import LabelEvidence, MapEvidence
from datagen.slam.commands import commands_of, delayed
from datagen.slam.loops.pose_graph import revisit_residuals
from lanenet.data.maps.folder import DriveMap
from lanenet.data.maps.line import LaneLine
from lanenet.data.maps.mapped_drive import MappedDrive
from lanenet.geometry.frames import map_from_car, map_from_car_directions

#: Delays of the steering that are tried, in frames, and correlation with the path's curvature below which the
#: steering's sign is not known, also in sigmas of chance. Chosen: half a second at 20 frames a second; the
#: recorded drives reach 0.6 to 0.98.
_LAGS, _LEAST_CORRELATION, _CHANCE_SIGMAS = range(11), 0.5, 4.0


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
    points, normals, frames, segments = [], [], [], []
    for i, part in enumerate(parts):
        solved = part.solved
        for k in range(len(solved.poses)):
            points_of = solved.scans.frame(k)
            pose = solved.poses[k]
            # The segment's own wheelbase scales with its lengths; the map's camera has the car's.
            seen = map_from_car(solved.scans.points_cm[points_of], pose, solved.camera.wheelbase_cm)
            points.append(factor * seen)
            normals.append(map_from_car_directions(solved.scans.normals[points_of], pose[2]))
            frames.append(np.full(points_of.stop - points_of.start, numbers[part.rows[k]]))
            segments.append(np.full(points_of.stop - points_of.start, i))
    xy, normal = np.concatenate(points).astype(np.float32), np.concatenate(normals).astype(np.float32)
    return {
        "frame": np.concatenate(frames),
        "segment": np.concatenate(segments),
        "x_cm": xy[:, 0],
        "y_cm": xy[:, 1],
        "normal_x": normal[:, 0],
        "normal_y": normal[:, 1],
    }


def segment_figures(
    parts: list[MappedSegment], numbers: Int[np.ndarray, "f"], factor: float
) -> list[dict[str, Any]]:
    """Collect the figures of each segment; the arguments are those of :func:`map_edges`."""
    segments = []
    for part in parts:
        solved, lane = part.solved, part.lane
        residual = np.abs(revisit_residuals(solved.poses, solved.revisits)) * [factor, factor, 1.0]
        closure = np.median(residual, axis=0).tolist() if len(residual) else [None] * 3
        segments.append(
            {
                "first_frame": int(numbers[part.rows[0]]),
                "frames": len(solved.poses),
                "path_cm": factor * float(solved.path_cm[-1]),
                "median_match": float(np.nanmedian(solved.trajectory.match)),
                "revisits": len(solved.revisits),
                "closure_residual_median": dict(
                    zip(("along_cm", "across_cm", "heading_rad"), closure, strict=True)
                ),
                "heading_drift_rad_per_m": None
                if solved.drift_rad_per_cm is None
                else 100.0 * solved.drift_rad_per_cm / factor,
                "reprojection_robust_sd_px": solved.bundle.robust_sd_px,
                "steering": None if solved.steering is None else vars(solved.steering),
                "lane_cm": factor * lane.lane_cm,
                "tape_cm": factor * lane.tape_cm,
                "line_residual_cm": {
                    line.side: factor * line.residual_cm for line in part.lines if line.rank == 0
                },
                "lines": sorted(line.index for line in part.lines),
                "closed": part.lines[0].period_cm is not None,
            }
        )
    return segments


def scaled_figures(value: Any, factor: float, power: int = 0) -> Any:
    """Multiply the lengths in figures by a factor: those under names in ``_cm``.

    What stands under ``_per_m`` is divided by it. The steering's ``_per_cm`` stays: it is in the scale of the
    camera that was solved with.

    Args:
        value: Figures, as a report has them.
        factor: Of the lengths.
        power: Of the factor, for numbers without a name of their own.
    """
    if isinstance(value, dict):
        return {name: scaled_figures(one, factor, power or _power(name)) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [scaled_figures(one, factor, power) for one in value]
    return value if value is None or not power else value * factor**power


def _power(name: str) -> int:
    if name.endswith("_per_m"):
        return -1
    return int(name.endswith("_cm") and not name.endswith("_per_cm"))


def map_figures(drive_map: DriveMap, segments: list[dict[str, Any]]) -> dict[str, Any]:
    """Collect a map's figures; ``segments`` are those of :func:`segment_figures`."""
    camera = drive_map.camera
    m = camera.mounting
    return {
        "camera": {
            "focal_px": float(camera.K[0, 0]),
            "height_cm": m.height_cm,
            "pitch_down_deg": float(np.rad2deg(m.pitch_down_rad)),
            "yaw_deg": float(np.rad2deg(m.yaw_rad)),
        },
        "laps": drive_map.meta.laps,
        "segments_mapped": segments,
    }


def free_lane_cm(parts: list[MappedSegment]) -> float | None:
    """Median of the segments' freely found lane widths; None if they have none."""
    free = [part.free_lane_cm for part in parts if part.free_lane_cm is not None]
    return float(np.median(free)) if free else None


@dataclass(frozen=True)
class SteeringAnswer:
    """How the curvature of a map's path answers to the steering command.

    Attributes:
        correlation: At that delay; below 0 where the car turns right when it is steered left.
        delay_frames: Delay at which the correlation is strongest.
    """

    correlation: float
    delay_frames: int


def steering_answer(mapped: MappedDrive) -> SteeringAnswer | None:
    """Correlate the path's curvature with the steering command, at the delay where that is strongest.

    Every statement of a report on the steering rests on this one.

    Returns:
        None if nothing was commanded, or if the command does not explain the path.
    """
    drive_map = mapped.drive_map
    turn = commands_of(mapped.drive, drive_map.camera.wheelbase_cm).turn
    if turn is None:
        return None
    delta = np.diff(drive_map.poses, axis=0)
    step = np.hypot(delta[:, 0], delta[:, 1])
    driven = (step > 0.3 * np.median(step)) & ~mapped.starts[1:]
    curvature = delta[driven, 2] / step[driven]
    found = [SteeringAnswer(0.0, 0)]
    for lag in _LAGS:
        command = delayed(turn, lag)[mapped.rows][1:][driven]
        if len(command) > 2 and min(np.std(command), np.std(curvature)) > 1e-9:
            found.append(SteeringAnswer(float(np.corrcoef(command, curvature)[0, 1]), lag))
    strongest = max(found, key=lambda one: abs(one.correlation))
    least = max(_LEAST_CORRELATION, _CHANCE_SIGMAS / np.sqrt(max(len(curvature), 1)))
    return strongest if abs(strongest.correlation) >= least else None


def map_evidence(
    drive_map: DriveMap, figures: dict[str, Any], labels: LabelEvidence, free_cm: float | None
) -> MapEvidence:
    """Collect the evidence for the verdict.

    Args:
        drive_map: The map.
        figures: Figures of the map and of its quality.
        labels: What its labels hold.
        free_cm: See :func:`free_lane_cm`.
    """
    meta, height_cm = drive_map.meta, drive_map.camera.mounting.height_cm
    calibration = figures.get("calibration", {})
    across = [
        (segment["closure_residual_median"]["across_cm"], segment["revisits"])
        for segment in figures["segments_mapped"]
        if segment["revisits"]
    ]
    revisits = sum(count for _, count in across)
    # A given camera that the drive has refined counts as known: its lens was not searched for.
    known = not calibration.get("candidates")
    found_cm = meta.mapped_lane_cm if free_cm is None else free_cm
    return MapEvidence(
        labels=labels,
        coverage=figures["held_out"]["both_lines"]["coverage"],
        wrong=tuple(withheld_text(place) for place in figures["withheld"]["places"]),
        wrong_share=figures["withheld"]["share"],
        revisits=revisits,
        laps=max(meta.laps, int(np.ptp(drive_map.poses[:, 2]) / (2.0 * np.pi))),
        comes_round=all(segment["closed"] for segment in figures["segments_mapped"]),
        closure_across_heights=sum(cm * count for cm, count in across) / revisits / height_cm
        if revisits
        else None,
        camera_known=known,
        sigma={} if known else calibration["sigma"],
        # Reports of earlier versions do not know.
        strain=0.0 if known else calibration.get("strain", 0.0),
        given_lane_cm=meta.lane_width_cm,
        bend_lane_cm=figures["lane_width"]["bend_cm"],
        open_lane_cm=figures["lane_width"]["open_cm"],
        found_lane_cm=None if meta.scale_from == "lane width" else found_cm,
        height_cm=height_cm,
        tape_cm=meta.tape_cm,
        height_given=bool(calibration.get("height_given")),
        given_height_cm=figures["given"]["camera_height_cm"],
        given_tape_cm=figures["given"]["tape_width_cm"],
        ahead_cm=drive_map.camera.mounting.ahead_of_front_axle_cm,
        tape_range_cm=tape_range_cm([line for lines in drive_map.lines.values() for line in lines]),
        steering=figures["steering_correlation"],
        segments=len(figures["segments_mapped"]),
        pauses=figures.get("pauses", 0),
    )


def tape_range_cm(lines: Sequence[LaneLine]) -> tuple[float, float] | None:
    """Percentiles 5 and 95 of the tape's width along the line on which it varies most; None if unknown."""
    ranges = []
    for line in lines:
        known = line.supported(line.sigma_s_cm)
        if len(line.marking_at_cm) and known.any():
            low, high = np.percentile(line.marking_at_cm[known], [5.0, 95.0])
            ranges.append((float(low), float(high)))
    return max(ranges, key=lambda ends: ends[1] / ends[0], default=None)


def withheld_text(place: dict[str, Any]) -> str:
    """Say which section of a line is withheld; ``place`` as in the report's figures."""
    length_cm = place["to_cm"] - place["from_cm"]
    length = f"{0.01 * length_cm:.1f} m" if length_cm >= 100.0 else f"{length_cm:.0f} cm"
    return f"{length} of the {place['line']} near frame {place['frames'][0]}"


def map_notes(
    drive_map: DriveMap, figures: dict[str, Any], frames: int, camera_known: bool, free_cm: float | None
) -> list[str]:
    """Say in sentences what was mapped.

    Args:
        drive_map: The map.
        figures: Its figures.
        frames: Number of frames of the drive.
        camera_known: Whether the camera was given.
        free_cm: See :func:`free_lane_cm`; if there is one, the mapped lane is not the road's.
    """
    meta = drive_map.meta
    revisits = sum(segment["revisits"] for segment in figures["segments_mapped"])
    path = sum(segment["path_cm"] for segment in figures["segments_mapped"])
    lane = "lane" if free_cm is None else "distance of the mapped lines"
    notes = [
        f"{len(drive_map.frames)} of {frames} frames mapped, {path / 100.0:.1f} m of road, "
        f"{revisits} revisits" + ("" if revisits else ": no place was seen twice, so no loop was closed"),
        f"{lane} {meta.mapped_lane_cm:.1f} cm, {meta.markings} marking {meta.tape_cm:.1f} cm, "
        f"scale from the {meta.scale_from}",
    ]
    if camera_known and free_cm is None and abs(meta.mapped_lane_cm / meta.lane_width_cm - 1.0) > 0.08:
        notes.append(
            f"the lane measures {meta.mapped_lane_cm:.1f} cm with this camera, "
            f"{meta.lane_width_cm:.1f} cm was given"
        )
    return notes
