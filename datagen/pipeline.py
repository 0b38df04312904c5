"""Drive -> map: the stages in their order. Labels follow in :mod:`datagen.labels.label_map`."""

from __future__ import annotations

from dataclasses import asdict, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from datagen.labels.label_map import label_map
from datagen.lanes.find import map_stretches
from datagen.lanes.mapped import MappedSegment
from datagen.lanes.scale import fitted_width_cm
from datagen.quality.agreement import contradicted_lines
from datagen.quality.figures import (
    Report,
    free_lane_cm,
    map_edges,
    map_evidence,
    map_figures,
    map_notes,
)
from datagen.quality.mappable import check_edges, check_lines_seen, check_moving
from datagen.quality.measure import held_out_frames, measure_map, quality_figures
from datagen.quality.page import PAGE_NAME, report_page
from datagen.quality.pictures import draw_contact_sheet, draw_map
from datagen.quality.verdict import judge
from datagen.settings import MapSettings, with_wheelbase
from datagen.slam.camera.coarse import with_known_scale
from datagen.slam.camera.self_calibration import DRIVE_INSTEAD, find_camera
from datagen.slam.kept_images import keep_images
from datagen.slam.odometry.scans import Progress
from datagen.slam.odometry.stillness import following_frames
from datagen.slam.segment import SolvedSegment
from lanenet.config import dump_settings
from lanenet.data.camera_file import read_camera
from lanenet.data.drives import Drive, open_drive
from lanenet.data.files import atomic_folder, check_replaceable, clear_unfinished, write_text
from lanenet.data.maps.folder import FORMAT, SETTINGS_NAME, DriveMap, MapMeta, kept_map, write_map
from lanenet.data.maps.mapped_drive import MappedDrive, points_text
from lanenet.data.trajectory import write_tum
from lanenet.errors import CalibrationError, DriveFormatError, TrackingLostError
from lanenet.geometry.camera import Camera
from lanenet.perception.edges.static import find_static, spread_frames

__all__ = ["MapSettings", "Report", "label_map", "map_drive"]

_MIN_SEGMENT = 60  # frames
_SHOWN = 24  # frames on the contact sheet


def map_drive(
    drive_path: Path,
    lane_width_cm: float,
    camera_path: Path | None,
    settings: MapSettings,
    out: Path,
    progress: Progress | None = None,
    refine_camera: bool = False,
    wheelbase_cm: float | None = None,
    pictures: bool = True,
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
        refine_camera: Adjust a known camera together with the poses; its height stays and sets the scale.
        wheelbase_cm: Distance between the axles; None takes the camera's own, or a nominal one.
        pictures: Draw the map, its frames and the report's page, which takes a third of a short drive's time.

    Raises:
        TrackingLostError: If the drive is too short or shows no lane.
        CalibrationError: If the camera does not fit the images, or the lane on the road is another one than
            camera and lane width say.
        LanenetError: If ``out`` is a file, or a folder that holds anything but an older map.
    """
    # Before the work, and also where nothing comes of it.
    clear_unfinished(out)
    check_replaceable(out, "map")
    try:
        return _map_drive(
            drive_path,
            lane_width_cm,
            camera_path,
            settings,
            out,
            progress,
            refine_camera,
            wheelbase_cm,
            pictures,
        )
    except CalibrationError as error:
        raise CalibrationError(f"{error}{kept_map(out)}") from error
    except TrackingLostError as error:
        where = "" if str(drive_path) in str(error) else f"{drive_path}: "
        raise TrackingLostError(f"{where}{error}; {DRIVE_INSTEAD}{kept_map(out)}") from error


def _map_drive(
    drive_path: Path,
    lane_width_cm: float,
    camera_path: Path | None,
    settings: MapSettings,
    out: Path,
    progress: Progress | None,
    refine_camera: bool,
    wheelbase_cm: float | None,
    pictures: bool,
) -> Report:
    rng = np.random.default_rng(settings.seed)
    recorded = keep_images(open_drive(drive_path))
    check_moving(recorded)
    drive, seen = following_frames(recorded)
    notes = [*recorded.problems, *seen]
    segments = split_segments(drive)
    # What the driver deleted gets no labels, and where the car leaves the road it tells nothing of them.
    held_out = held_out_frames(len(drive), settings.held_out_every, settings.seed) & ~drive.deleted
    known = read_camera(camera_path) if camera_path is not None else drive.camera
    settings, known, nominal = with_wheelbase(settings, known, wheelbase_cm)
    notes += nominal
    settings = hide_bumper(drive, settings, notes)
    figures: dict[str, Any] = {"drive": str(drive_path), "frames": len(drive), "segments": len(segments)}
    if known is not None:
        _check_size(known, drive, camera_path)
    camera, how = known, "given"
    solved: dict[int, SolvedSegment] = {}
    if camera is None or refine_camera:
        k = max(range(len(segments)), key=lambda i: segments[i].stop - segments[i].start)
        longest = drive.subset(segments[k])
        check_edges(longest, settings.perception.edges)
        found = find_camera(longest, known, settings, rng, progress, search_progress=progress)
        solved[k], camera, how = found.solved, found.camera, found.how
        figures["calibration"] = found.figures
        notes.append(found.note)
    width = lane_width_cm if known is not None else None
    parts = map_stretches(drive, segments, camera, solved, width, held_out, settings, rng, notes, progress)
    factor = 1.0
    if known is None:
        factor = lane_width_cm / _mapped_lane_cm(parts)
        camera = with_known_scale(camera, factor, settings.guess)
    drive_map = _assemble(drive, drive_path, lane_width_cm, camera, parts, factor, known is None)
    rows_of_map = _rows_of_map(parts)
    drive_map = replace(drive_map, held_out=held_out[rows_of_map])
    figures |= map_figures(drive_map, parts, drive.frames, factor)
    free_cm = free_lane_cm(parts)
    notes += map_notes(drive_map, figures, known is not None, free_cm)
    mapped = MappedDrive(drive_map, drive, rows_of_map, settings.perception)
    drive_map = replace(drive_map, contradicted=contradicted_lines(mapped))
    mapped = replace(mapped, drive_map=drive_map)
    quality = measure_map(mapped)
    check_lines_seen(quality, drive, lane_width_cm, free_cm)
    figures |= quality_figures(quality, drive.width)
    frames = f"{100.0 * quality.labelled_share:.0f} % of the frames have labels"
    notes.append(f"{frames}; {points_text(quality.point_shares)}")
    evidence = map_evidence(drive_map, figures, drive.deleted[rows_of_map], free_cm)
    verdict = judge(evidence, settings.verdict)
    drive_map = replace(drive_map, meta=drive_map.meta.model_copy(update={"verdict": verdict.grade}))
    figures["verdict"] = asdict(verdict)
    figures["notes"] = notes
    with atomic_folder(out, "map") as folder:
        write_map(folder, drive_map, map_edges(parts, drive.frames, camera, factor), figures, how)
        write_text(folder / SETTINGS_NAME, dump_settings(settings))
        opened = _in_order(parts, [part.solved.open_poses for part in parts]) * [factor, factor, 1.0]
        write_tum(folder / "open_loop.tum", drive_map.t_s, opened)
        if pictures:
            scaled = [
                (part.solved.scans, part.solved.poses * [factor, factor, 1.0], factor) for part in parts
            ]
            draw_map(folder / "map.png", drive_map, scaled, mapped.starts)
            shown = np.linspace(0, len(drive_map.frames) - 1, _SHOWN).astype(int)
            draw_contact_sheet(folder / "frames.png", mapped, shown)
            png = (folder / "map.png").read_bytes()
            page = report_page(mapped, quality, verdict, figures, opened, png, settings.verdict)
            write_text(folder / PAGE_NAME, page)
    said = [f"verdict: {verdict.grade}", *verdict.reasons, *notes, *verdict.remarks]
    return Report(tuple(said), figures)


def hide_bumper(drive: Drive, settings: MapSettings, notes: list[str]) -> MapSettings:
    """Return the settings with the rows left out in which the car sees itself, and note it.

    The rows become part of the perception settings, so that labels, model and car leave out the same ones.
    Whole rows, not pixels: two drives of one car give masks that differ in a pixel here and there, and label
    sets whose edge points were found differently are not trained on together.
    """
    if not settings.find_bumper or settings.perception.range.bottom_rows:
        return settings
    try:
        static = find_static(drive.image(k) for k in spread_frames(len(drive)))
    except DriveFormatError:  # too few frames of a moving car to tell it from the road
        return settings
    if not static.rows:
        return settings
    if static.is_too_high:
        notes.append(
            f"something in the lowest {static.rows} rows never moves; set bottom_rows if it is the car"
        )
        return settings
    notes.append(f"the car sees itself in the lowest {static.rows} rows, which are left out")
    limits = settings.perception.range.model_copy(update={"bottom_rows": static.rows})
    perception = settings.perception.model_copy(update={"range": limits})
    return settings.model_copy(update={"perception": perception})


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


def _mapped_lane_cm(parts: list[MappedSegment]) -> float:
    return float(np.median([fitted_width_cm(part.lines, part.lane, part.s_frames_cm) for part in parts]))


def _assemble(
    drive: Drive,
    drive_path: Path,
    lane_width_cm: float,
    camera: Camera,
    parts: list[MappedSegment],
    factor: float,
    scale_from_lane: bool,
) -> DriveMap:
    """Join the segments, in centimetres, in the order of the drive."""
    meta = MapMeta(
        format=FORMAT,
        drive=str(drive_path),
        lane_width_cm=lane_width_cm,
        mapped_lane_cm=factor * _mapped_lane_cm(parts),
        tape_cm=factor * float(np.median([line.marking_cm for part in parts for line in part.lines[:2]])),
        scale_from="lane width" if scale_from_lane else "camera",
        laps=max(int(part.solved.laps.max()) for part in parts),
    )
    rows = _rows_of_map(parts)
    return DriveMap(
        meta=meta,
        camera=camera,
        frames=drive.frames[rows],
        t_s=drive.t_s[rows],
        poses=_in_order(parts, [part.solved.poses for part in parts]) * [factor, factor, 1.0],
        lap=_in_order(parts, [part.solved.laps for part in parts]),
        segment=_in_order(parts, [np.full(len(part.rows), i) for i, part in enumerate(parts)]),
        s_cm=_in_order(parts, [part.s_frames_cm for part in parts]) * factor,
        match=_in_order(parts, [part.solved.trajectory.match for part in parts]),
        lines={i: [line.scaled(factor) for line in part.lines] for i, part in enumerate(parts)},
        tilt_rad=_in_order(parts, [part.solved.bundle.tilt for part in parts]),
        held_out=np.zeros(len(rows), dtype=bool),
        contradicted=np.zeros((len(rows), 2), dtype=bool),
    )


def _rows_of_map(parts: list[MappedSegment]) -> Int[np.ndarray, "n"]:
    """Positions in the drive of all mapped frames."""
    return np.sort(np.concatenate([part.rows for part in parts]))


def _in_order(parts: list[MappedSegment], values: list[np.ndarray]) -> np.ndarray:
    """Values per frame of each segment, in the order of the drive: a segment may lie within another one."""
    return np.concatenate(values)[np.argsort(np.concatenate([part.rows for part in parts]))]
