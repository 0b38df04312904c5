"""Drive -> map -> labels: the stages in their order, each writing what the next one reads."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from pydantic import Field

from datagen.labels.project import lines_of_frame
from datagen.labels.quality import frame_residual_cm, label_report
from datagen.lanes.fit import FitSettings, LaneLine, fit_lines
from datagen.lanes.path import edges_along_path, path_of_poses
from datagen.lanes.trace import TracedLane, TraceSettings, trace_lane
from datagen.map_folder import FORMAT, DriveMap, MapMeta, read_map, write_map
from datagen.pictures import draw_contact_sheet, draw_map
from datagen.slam.calibrate import (
    GuessSettings,
    coarse_camera,
    heading_error_per_lap,
    mapping_range,
    next_yaw,
    with_known_scale,
)
from datagen.slam.filter import FilterSettings, Trajectory
from datagen.slam.mapper import MotionSettings, SteeringFit, commands_of, track
from datagen.slam.places import (
    Revisit,
    RevisitSettings,
    match_places,
    path_lengths,
    propose_revisits,
    thumbnails,
)
from datagen.slam.posegraph import close_loops
from datagen.slam.scans import Scans, scan_drive
from lanenet.config import Settings, dump_settings
from lanenet.data.camera_file import read_camera
from lanenet.data.drive import Drive, open_drive
from lanenet.data.files import atomic_file, atomic_folder, write_json, write_text
from lanenet.data.label_set import LabelMeta, LabelSet, write_labels
from lanenet.errors import CalibrationError, DriveFormatError, TrackingLostError
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.camera import Camera
from lanenet.geometry.frames import map_from_car, map_from_car_directions
from lanenet.perception.birdseye import PerceptionSettings, RoadEdgeExtractor

Progress = Callable[[int, int], None]

_MIN_SEGMENT = 60  # frames
_YAW_ROUNDS = 3
_YAW_GOOD_ENOUGH_RAD = 0.02  # of heading per lap
_MIN_MATCH = 0.15


class MapSettings(Settings):
    """Everything that mapping a drive can be told; the defaults are meant to fit every drive."""

    seed: int = Field(default=0, ge=0)
    perception: PerceptionSettings = PerceptionSettings()
    guess: GuessSettings = GuessSettings()
    filter: FilterSettings = FilterSettings()
    motion: MotionSettings = MotionSettings()
    revisits: RevisitSettings = RevisitSettings()
    trace: TraceSettings = TraceSettings()
    fit: FitSettings = FitSettings()


@dataclass(frozen=True)
class Report:
    """What a stage found, for people (lines) and for machines (figures)."""

    lines: tuple[str, ...]
    figures: dict[str, Any]


@dataclass(frozen=True)
class _Solved:
    """A tracked and closed segment."""

    scans: Scans
    trajectory: Trajectory
    poses: Float[np.ndarray, "n 3"]
    steering: SteeringFit | None
    revisits: list[Revisit]
    residuals: Float[np.ndarray, "r 3"]
    heading_drift_rad: float | None


def map_drive(
    drive_path: Path,
    lane_width_cm: float,
    camera_path: Path | None,
    settings: MapSettings,
    out: Path,
    progress: Progress | None = None,
) -> Report:
    """Map a drive: poses, edges, lane lines, pictures.

    Args:
        drive_path: Drive folder, Donkeycar tub or video.
        lane_width_cm: Distance between the middles of the two lines of the driven lane. It sets the scale
            where the camera is not known.
        camera_path: Camera file; None takes the drive's own, or calibrates from the drive.
        settings: Settings of all stages.
        out: Map folder to write.
        progress: Called with (done, total).

    Raises:
        TrackingLostError: If the drive is too short or shows no lane.
        CalibrationError: If the camera does not fit the images.
    """
    rng = np.random.default_rng(settings.seed)
    drive = open_drive(drive_path)
    segments = split_segments(drive)
    known = read_camera(camera_path) if camera_path is not None else drive.camera
    notes: list[str] = list(drive.problems)
    figures: dict[str, Any] = {"drive": str(drive_path), "frames": len(drive), "segments": len(segments)}
    if known is not None:
        _check_size(known, drive, camera_path)
        camera, how = known, "given"
    else:
        longest = drive.subset(max(segments, key=lambda s: s.stop - s.start))
        camera, candidates = coarse_camera(longest, settings.perception, settings.guess, rng, progress)
        how = (
            "from the drive: focal length and pitch by match score, yaw by closing laps, scale by lane width"
        )
        figures["calibration"] = {"candidates": [vars(c) for c in candidates]}
        if settings.guess.refine_yaw:
            camera = _refine_yaw(longest, camera, settings, rng, progress)
    parts = [
        (segment, _solve(drive.subset(segment), camera, settings, rng, progress)) for segment in segments
    ]
    traced = [
        _trace(solved, camera, lane_width_cm if known is not None else None, settings) for _, solved in parts
    ]
    lane_cm = float(np.median([lane.lane_cm for _, lane, _ in traced]))
    factor = 1.0
    if known is None:
        factor = lane_width_cm / lane_cm
        camera = with_known_scale(camera, factor, settings.guess)
    drive_map = _assemble(drive, drive_path, lane_width_cm, camera, parts, traced, factor, known is None)
    figures |= _map_figures(drive_map, parts, traced, factor)
    notes += _map_notes(drive_map, figures, known is not None)
    with atomic_folder(out, "map") as folder:
        write_map(folder, drive_map, _map_edges(parts, camera, factor), figures, how)
        write_text(folder / "settings.yaml", dump_settings(settings))
        draw_map(
            folder / "map.png",
            drive_map,
            [(s.scans, s.poses * [factor, factor, 1.0], factor) for _, s in parts],
        )
        frames = np.linspace(0, len(drive_map.frames) - 1, 24).astype(int)
        index = {int(f): i for i, f in enumerate(drive.frames)}
        draw_contact_sheet(
            folder / "frames.png",
            [
                (
                    drive.image(index[int(drive_map.frames[k])]),
                    _frame_lines(drive_map, k),
                    int(drive_map.frames[k]),
                )
                for k in frames
            ],
            camera,
        )
    return Report(tuple(notes), figures)


def split_segments(drive: Drive) -> list[slice]:
    """Cut a drive where the recording is interrupted; stretches too short to map are left out.

    Raises:
        TrackingLostError: If no stretch is long enough.
    """
    starts = [0, *(int(k) for k in np.flatnonzero(drive.breaks) if k > 0), len(drive)]
    segments = [slice(a, b) for a, b in pairwise(starts) if b - a >= _MIN_SEGMENT]
    if not segments:
        raise TrackingLostError(
            f"{drive.path}: {len(drive)} frames, longest uninterrupted stretch "
            f"{max(b - a for a, b in pairwise(starts))}; mapping needs {_MIN_SEGMENT}"
        )
    return segments


def _check_size(camera: Camera, drive: Drive, camera_path: Path | None) -> None:
    if (camera.width, camera.height) != (drive.width, drive.height):
        raise CalibrationError(
            f"{camera_path or drive.path}: the camera is for {camera.width}x{camera.height} px, "
            f"the images of {drive.path} have {drive.width}x{drive.height}"
        )


def _solve(
    drive: Drive, camera: Camera, settings: MapSettings, rng: np.random.Generator, progress: Progress | None
) -> _Solved:
    """Track one segment and close its loops."""
    height = camera.mounting.height_cm
    perception = settings.perception.model_copy(
        update={"range": mapping_range(height, settings.perception.range)}
    )
    scans = scan_drive(drive, RoadEdgeExtractor(camera, perception))
    if len(scans.points_cm) < 20 * len(scans):
        raise TrackingLostError(
            f"{drive.path}: {len(scans.points_cm) / max(len(scans), 1):.0f} edge points per frame on the "
            "road; mapping needs 20"
        )
    commands = commands_of(drive, camera.wheelbase_cm)
    trajectory, steering = track(scans, commands, camera, settings.filter, settings.motion, rng, progress)
    pairs = propose_revisits(thumbnails(drive), trajectory.poses, height, settings.revisits)
    found = [
        match_places(scans, trajectory.poses, pair, height, camera.wheelbase_cm, settings.revisits, rng)
        for pair in pairs
    ]
    revisits = [revisit for revisit in found if revisit is not None]
    if len(revisits) < settings.revisits.min_revisits:
        revisits = []
    poses, residuals = close_loops(trajectory.poses, revisits, height)
    drift = heading_error_per_lap(trajectory.poses, revisits) if revisits else None
    return _Solved(scans, trajectory, poses, steering, revisits, residuals, drift)


def _refine_yaw(
    drive: Drive, camera: Camera, settings: MapSettings, rng: np.random.Generator, progress: Progress | None
) -> Camera:
    """Turn the camera until laps close in heading; without a revisit it stays as it is."""
    tried: list[tuple[float, float]] = []
    best = camera
    for _ in range(_YAW_ROUNDS):
        solved = _solve(drive, camera, settings, rng, progress)
        if solved.heading_drift_rad is None:
            return camera
        tried.append((camera.mounting.yaw_rad, solved.heading_drift_rad))
        if abs(solved.heading_drift_rad) <= min(abs(error) for _, error in tried):
            best = camera
        if abs(solved.heading_drift_rad) < _YAW_GOOD_ENOUGH_RAD:
            break
        camera = camera.with_mounting(yaw_rad=next_yaw(tried))
    return best


def _trace(
    solved: _Solved, camera: Camera, lane_width_cm: float | None, settings: MapSettings
) -> tuple[Float[np.ndarray, "n"], TracedLane, list[LaneLine]]:
    """Find a segment's lane lines, in the scale of the camera."""
    height = camera.mounting.height_cm
    path = path_of_poses(solved.poses, 0.12 * height, 5.0 * height)
    edges = edges_along_path(path, solved.scans, solved.poses, camera.wheelbase_cm, 3.5 * height)
    lane = trace_lane(path, edges, height, lane_width_cm, settings.trace)
    return path.s_frames_cm, lane, fit_lines(path, lane, height, settings.fit)


def _assemble(
    drive: Drive,
    drive_path: Path,
    lane_width_cm: float,
    camera: Camera,
    parts: list[tuple[slice, _Solved]],
    traced: list[tuple[Float[np.ndarray, "n"], TracedLane, list[LaneLine]]],
    factor: float,
    scale_from_lane: bool,
) -> DriveMap:
    poses = np.concatenate([solved.poses for _, solved in parts]) * [factor, factor, 1.0]
    s_cm = np.concatenate([s for s, _, _ in traced]) * factor
    laps = np.concatenate([count_laps(path_lengths(solved.poses), solved.revisits) for _, solved in parts])
    meta = MapMeta(
        format=FORMAT,
        drive=str(drive_path),
        lane_width_cm=lane_width_cm,
        mapped_lane_cm=factor * float(np.median([lane.lane_cm for _, lane, _ in traced])),
        tape_cm=factor * float(np.median([lane.tape_cm for _, lane, _ in traced])),
        scale_from="lane width" if scale_from_lane else "camera",
        laps=int(laps.max()) if any(solved.revisits for _, solved in parts) else 0,
    )
    return DriveMap(
        meta=meta,
        camera=camera,
        frames=np.concatenate([drive.frames[segment] for segment, _ in parts]),
        t_s=np.concatenate([drive.t_s[segment] for segment, _ in parts]),
        poses=poses,
        lap=laps,
        segment=np.concatenate([np.full(len(solved.poses), i) for i, (_, solved) in enumerate(parts)]),
        s_cm=s_cm,
        match=np.concatenate([solved.trajectory.match for _, solved in parts]),
        lines={i: [line.scaled(factor) for line in lines] for i, (_, _, lines) in enumerate(traced)},
    )


def count_laps(path_cm: Float[np.ndarray, "n"], revisits: list[Revisit]) -> np.ndarray:
    """Number the laps from 0; a lap is as long as the path between one visit of a place and the next."""
    if not revisits:
        return np.zeros(len(path_cm), dtype=np.int64)
    gaps = np.sort([path_cm[r.later] - path_cm[r.earlier] for r in revisits])
    # Later visits may skip laps: the shortest gaps are those of one lap.
    lap_cm = float(np.median(gaps[gaps < 1.4 * np.percentile(gaps, 10)]))
    return (path_cm // lap_cm).astype(np.int64)


def _map_edges(parts: list[tuple[slice, _Solved]], camera: Camera, factor: float) -> dict[str, np.ndarray]:
    """Every edge point with its direction, frame map, float32."""
    points, normals, frames, segments = [], [], [], []
    for i, (segment, solved) in enumerate(parts):
        for k in range(len(solved.poses)):
            rows = solved.scans.frame(k)
            pose = solved.poses[k] * [factor, factor, 1.0]
            points.append(map_from_car(factor * solved.scans.points_cm[rows], pose, camera.wheelbase_cm))
            normals.append(map_from_car_directions(solved.scans.normals[rows], pose[2]))
            frames.append(np.full(rows.stop - rows.start, segment.start + k))
            segments.append(np.full(rows.stop - rows.start, i))
    xy, normal = np.concatenate(points).astype(np.float32), np.concatenate(normals).astype(np.float32)
    return {
        "frame_index": np.concatenate(frames),
        "segment": np.concatenate(segments),
        "x_cm": xy[:, 0],
        "y_cm": xy[:, 1],
        "normal_x": normal[:, 0],
        "normal_y": normal[:, 1],
    }


def _map_figures(
    drive_map: DriveMap,
    parts: list[tuple[slice, _Solved]],
    traced: list[tuple[Float[np.ndarray, "n"], TracedLane, list[LaneLine]]],
    factor: float,
) -> dict[str, Any]:
    camera = drive_map.camera
    segments = []
    for (segment, solved), (_, lane, lines) in zip(parts, traced, strict=True):
        residual = np.abs(solved.residuals)
        segments.append(
            {
                "first_frame": segment.start,
                "frames": len(solved.poses),
                "path_cm": factor * float(path_lengths(solved.poses)[-1]),
                "median_match": float(np.nanmedian(solved.trajectory.match)),
                "revisits": len(solved.revisits),
                "closure_residual_median": {
                    "along_cm": factor * float(np.median(residual[:, 0])) if len(residual) else None,
                    "across_cm": factor * float(np.median(residual[:, 1])) if len(residual) else None,
                    "heading_rad": float(np.median(residual[:, 2])) if len(residual) else None,
                },
                "heading_drift_per_lap_rad": solved.heading_drift_rad,
                "steering": None if solved.steering is None else vars(solved.steering),
                "lane_cm": factor * lane.lane_cm,
                "tape_cm": factor * lane.tape_cm,
                "line_residual_cm": {line.side: factor * line.residual_cm for line in lines},
            }
        )
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


def _map_notes(drive_map: DriveMap, figures: dict[str, Any], camera_known: bool) -> list[str]:
    meta = drive_map.meta
    revisits = sum(segment["revisits"] for segment in figures["segments_mapped"])
    path = sum(segment["path_cm"] for segment in figures["segments_mapped"])
    notes = [
        f"{len(drive_map.frames)} of {figures['frames']} frames mapped, {path / 100.0:.1f} m of road, "
        f"{revisits} revisits" + ("" if revisits else ": no place was seen twice, nothing to close"),
        f"lane {meta.mapped_lane_cm:.1f} cm, marking {meta.tape_cm:.1f} cm, scale from the {meta.scale_from}",
    ]
    if camera_known and abs(meta.mapped_lane_cm / meta.lane_width_cm - 1.0) > 0.08:
        notes.append(
            f"the lane measures {meta.mapped_lane_cm:.1f} cm with this camera, "
            f"{meta.lane_width_cm:.1f} cm was given"
        )
    return notes


def _frame_lines(drive_map: DriveMap, k: int):  # type: ignore[no-untyped-def]
    lines = drive_map.lines[int(drive_map.segment[k])]
    return lines_of_frame(lines, drive_map.poses[k], float(drive_map.s_cm[k]), drive_map.camera.wheelbase_cm)


def label_map(
    map_folder: Path,
    out: Path,
    progress: Progress | None = None,
    *,
    drive_path: Path | None = None,
    perception: PerceptionSettings | None = None,
    window: BirdseyeWindow | None = None,
) -> Report:
    """Project a map's lines into each frame and write the label set, its report and a contact sheet.

    A frame gets no labels where its pose is uncertain (few edges match the map) or the driver has deleted
    it; a point is masked where the map does not support the line, or where it lies beside the window.

    Args:
        map_folder: Folder that :func:`map_drive` wrote.
        out: Parquet file.
        progress: Called with (done, total).
        drive_path: Where the drive is now, if it has moved since it was mapped.
        perception: How the network's edge points are found; the defaults are those of the car.
        window: The network's window.
    """
    drive_map = read_map(map_folder)
    source = drive_path if drive_path is not None else Path(drive_map.meta.drive)
    if not source.exists():
        raise DriveFormatError(f"{source}: the drive of {map_folder} is not there")
    drive = open_drive(source)
    _check_size(drive_map.camera, drive, map_folder / "camera.yaml")
    perception = PerceptionSettings() if perception is None else perception
    window = BirdseyeWindow() if window is None else window
    extractor = RoadEdgeExtractor(drive_map.camera, perception)
    index = {int(frame): i for i, frame in enumerate(drive.frames)}
    rows: list[int] = []
    edges, lines, points, residuals = [], [], [], []
    skipped = {"deleted": 0, "pose uncertain": 0, "no line in the window": 0}
    for k, frame in enumerate(drive_map.frames):
        if progress is not None:
            progress(k + 1, len(drive_map.frames))
        i = index.get(int(frame))
        if i is None:
            raise DriveFormatError(f"{source}: frame {int(frame)} of {map_folder} is not in it")
        if drive.deleted[i]:
            skipped["deleted"] += 1
            continue
        # The first frame of a segment has no map to match yet, so that its match is NaN.
        if drive_map.match[k] < _MIN_MATCH:
            skipped["pose uncertain"] += 1
            continue
        seen = _frame_lines(drive_map, k)
        visible = window.labelled(seen.points_cm)
        if not np.isfinite(visible).any():
            skipped["no line in the window"] += 1
            continue
        road = extractor.extract(drive.image(i))
        rows.append(k)
        edges.append(np.concatenate([road.points_cm, road.normals], axis=1).astype(np.float32))
        lines.append((seen.left_cm, seen.right_cm))
        points.append(visible)
        residuals.append(
            frame_residual_cm(road.points_cm, (seen.left_cm, seen.right_cm), drive_map.meta.tape_cm)
        )
    if not rows:
        raise TrackingLostError(f"{map_folder}: no frame can be labelled ({skipped})")
    residual = np.array(residuals)
    labels = LabelSet(
        meta=LabelMeta(
            window=window,
            camera_hash=drive_map.camera.hash,
            wheelbase_cm=drive_map.camera.wheelbase_cm,
            lane_width_cm=drive_map.meta.lane_width_cm,
            source="map",
            perception=perception,
            marking_cm=drive_map.meta.tape_cm,
        ),
        drive=[drive.name] * len(rows),
        file=[""] * len(rows),
        frame=drive_map.frames[rows],
        t_s=drive_map.t_s[rows],
        lap=drive_map.lap[rows],
        poses=drive_map.poses[rows],
        points_cm=np.array(points),
        edges=edges,
        lines=lines,
        quality=np.exp(-np.nan_to_num(residual, nan=2.0)),
    )
    report = label_report(labels, residual, len(drive_map.frames), skipped)
    write_labels(out, labels)
    write_json(out.with_suffix(".json"), report)
    order = np.argsort(np.nan_to_num(residual, nan=9.0))
    picks = np.concatenate([order[:8], order[len(order) // 2 - 4 : len(order) // 2 + 4], order[-8:]])
    with atomic_file(out.with_suffix(".png")) as temporary:
        draw_contact_sheet(
            temporary,
            [
                (
                    drive.image(index[int(labels.frame[j])]),
                    _frame_lines(drive_map, rows[j]),
                    int(labels.frame[j]),
                )
                for j in picks
            ],
            drive_map.camera,
        )
    share = report["labelled_share"]
    lines_out = [
        f"{len(rows)} of {len(drive_map.frames)} frames labelled ({100 * share:.0f} %)",
        *(f"{count} frames left out: {reason}" for reason, count in skipped.items() if count),
        f"markings lie {report['residual_cm']['median']:.2f} cm (median), "
        f"{report['residual_cm']['p95']:.2f} cm (p95) from the projected lines",
    ]
    return Report(tuple(lines_out), report)
