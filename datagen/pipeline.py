"""Drive -> map: the stages in their order. Labels follow in :mod:`datagen.labels.label_map`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from datagen.assemble import AssembledMap, assemble
from datagen.check import CheckedMap, check_map
from datagen.labels.label_map import label_map
from datagen.prepare import MapRequest, PreparedDrive, check_edges, prepare
from datagen.quality.figures import Report, map_edges
from datagen.quality.page import PAGE_NAME, report_page
from datagen.quality.pictures import draw_contact_sheet, draw_map
from datagen.segments import fit_lanes, solve_segments
from datagen.settings import MapSettings
from datagen.slam.camera.self_calibration import DRIVE_INSTEAD, find_camera
from datagen.slam.join import join_segments
from datagen.slam.odometry.scans import Progress
from datagen.slam.segment import SegmentSolver, SolvedSegment
from lanenet.config import dump_settings
from lanenet.data.files import atomic_folder, check_replaceable, clear_unfinished, write_text
from lanenet.data.maps.folder import SETTINGS_NAME, kept_map, write_map
from lanenet.data.trajectory import write_tum
from lanenet.errors import CalibrationError, TrackingLostError
from lanenet.geometry.camera import Camera

__all__ = ["MapRequest", "MapSettings", "Report", "label_map", "map_drive"]

_SHOWN = 24  # frames on the contact sheet: six rows of four


def map_drive(
    request: MapRequest,
    settings: MapSettings,
    out: Path,
    progress: Progress | None = None,
    pictures: bool = True,
) -> Report:
    """Map a drive: poses, edges, lane lines, pictures.

    Args:
        request: The drive and what is known about it.
        settings: Settings of all stages.
        out: Map folder to write.
        progress: Called with (done, total).
        pictures: Draw the map, its frames and the report's page; on a short drive a third of the time.

    Raises:
        TrackingLostError: If the drive is too short or shows no lane.
        CalibrationError: If the camera does not fit the images, or the lane on the road has another width
            than camera and lane width say.
        LanenetError: If ``out`` is a file, or a folder that holds anything but an older map.
    """
    # Before the work, and also where it fails later.
    clear_unfinished(out)
    check_replaceable(out, "map")
    try:
        return _map_drive(request, settings, out, progress, pictures)
    except CalibrationError as error:
        raise CalibrationError(f"{error}{kept_map(out)}") from error
    except TrackingLostError as error:
        where = "" if str(request.drive_path) in str(error) else f"{request.drive_path}: "
        raise TrackingLostError(f"{where}{error}; {DRIVE_INSTEAD}{kept_map(out)}") from error


def _map_drive(
    request: MapRequest, settings: MapSettings, out: Path, progress: Progress | None, pictures: bool
) -> Report:
    prepared = prepare(request, settings)
    drive, settings = prepared.drive, prepared.settings
    solver = SegmentSolver(settings, np.random.default_rng(settings.seed), progress)
    camera = _find_camera(prepared, request.refine_camera, solver)
    # Track, close loops, adjust: SegmentSolver.solve, segment by segment.
    solved = solve_segments(drive, prepared.segments, camera.camera, solver, camera.solved)
    joined = join_segments(solved.segments, drive, settings, solver.rng)
    lane_width_cm = None if prepared.camera is None else request.lane_width_cm
    lanes = fit_lanes(joined.segments, solved.refused, drive, lane_width_cm, prepared.held_out, settings)
    assembled = assemble(request, prepared, camera.camera, lanes.segments)
    checked = check_map(assembled, prepared, camera.figures)
    notes = [*prepared.notes, *camera.notes, *joined.notes, *lanes.notes, *checked.notes]
    figures = {
        "drive": str(request.drive_path),
        "frames": len(drive),
        "segments": len(prepared.segments),
        **camera.figures,
        **checked.figures,
        "notes": notes,
    }
    _write(out, assembled, checked, camera.how, figures, settings, pictures)
    verdict = checked.verdict
    return Report((f"verdict: {verdict.grade}", *verdict.reasons, *notes, *verdict.remarks), figures)


@dataclass(frozen=True)
class _CameraOfDrive:
    """The camera to map with.

    Attributes:
        camera: In centimetres where it was known, else of nominal height.
        how: How it was found, for the files.
        solved: Segments that were solved on the way, by their place among the segments.
        figures: For the report.
        notes: A sentence each.
    """

    camera: Camera
    how: str
    solved: dict[int, SolvedSegment] = field(default_factory=dict)
    figures: dict[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


def _find_camera(prepared: PreparedDrive, refine: bool, solver: SegmentSolver) -> _CameraOfDrive:
    """Take the known camera, or find or refine it on the longest segment."""
    if prepared.camera is not None and not refine:
        return _CameraOfDrive(prepared.camera, "given")
    longest = prepared.drive.subset(prepared.segments[prepared.longest])
    check_edges(longest, prepared.settings.perception.edges)
    found = find_camera(longest, prepared.camera, solver, solver.progress)
    solved, figures = {prepared.longest: found.solved}, {"calibration": found.figures}
    return _CameraOfDrive(found.camera, found.how, solved, figures, (found.note,))


def _write(
    out: Path,
    assembled: AssembledMap,
    checked: CheckedMap,
    how_camera: str,
    figures: dict[str, Any],
    settings: MapSettings,
    pictures: bool,
) -> None:
    mapped = checked.mapped
    drive_map, factor = mapped.drive_map, assembled.factor
    edges = map_edges(assembled.segments, mapped.drive.frames, drive_map.camera, factor)
    with atomic_folder(out, "map") as folder:
        write_map(folder, drive_map, edges, figures, how_camera)
        write_text(folder / SETTINGS_NAME, dump_settings(settings))
        opened = assembled.open_poses
        write_tum(folder / "open_loop.tum", drive_map.t_s, opened)
        if pictures:
            draw_map(folder / "map.png", drive_map, assembled.scaled_scans, mapped.starts)
            shown = np.linspace(0, len(drive_map.frames) - 1, _SHOWN).astype(int)
            draw_contact_sheet(folder / "frames.png", mapped, shown)
            png = (folder / "map.png").read_bytes()
            quality, verdict = checked.quality, checked.verdict
            page = report_page(mapped, quality, verdict, figures, opened, png, settings.verdict)
            write_text(folder / PAGE_NAME, page)
