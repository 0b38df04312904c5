"""Drive -> map: the stages in their order. Labels follow in :mod:`datagen.labels.label_map`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from datagen.assemble import AssembledMap, assemble
from datagen.check import CheckedMap, check_map
from datagen.compile_ahead import compile_ahead
from datagen.labels.label_map import label_map
from datagen.made import Output, fingerprint, key_of
from datagen.prepare import MapRequest, PreparedDrive, prepare
from datagen.quality.figures import Report
from datagen.quality.page import report_page
from datagen.quality.pictures import draw_contact_sheet, draw_map
from datagen.quality.verdict import verdict_lines
from datagen.quality.without_map import hints_without_map
from datagen.refusal import Attempt, remedy_of, report_refusal
from datagen.rescale import Solved, rescaled
from datagen.segments import camera_of_drive, fit_lanes, solve_drive
from datagen.settings import MapSettings
from datagen.slam.segment import SegmentSolver, StageProgress
from lanenet.config import dump_settings
from lanenet.data.camera_file import read_camera
from lanenet.data.files import atomic_folder, check_replaceable, write_text
from lanenet.data.maps.folder import SETTINGS_NAME, check_map_files, kept_map, read_map_meta, write_map
from lanenet.data.tables import write_tum
from lanenet.errors import CalibrationError, DriveFormatError, LanenetError, TrackingLostError
from lanenet.outputs import lock_output
from lanenet.page import PAGE_NAME

__all__ = ["MapRequest", "MapSettings", "Report", "label_map", "map_drive", "map_key", "write_checked"]

_SHOWN = 24  # frames on the contact sheet: six rows of four


def map_drive(
    request: MapRequest,
    settings: MapSettings,
    out: Path,
    progress: StageProgress | None = None,
    pictures: bool = True,
    earlier: Sequence[Path] = (),
) -> Report:
    """Map a drive: poses, edges, lane lines, pictures.

    A finished map of the same drive with the same settings, but for the lane width, is only rescaled, see
    :mod:`datagen.rescale`.

    Args:
        request: The drive and what is known about it.
        settings: Settings of all stages.
        out: Map folder to write.
        progress: Called with (stage, done, total).
        pictures: Draw the map, its frames and the report's page; on a short drive a third of the time. A
            drive that is refused gets a page as well, see :mod:`datagen.refusal`.
        earlier: Maps that may be such a map, beside the one in ``out``.

    Raises:
        TrackingLostError: If the drive is too short or shows no lane.
        CalibrationError: If the camera does not fit the images, or the lane on the road has another width
            than camera and lane width say.
        LanenetError: If ``out`` is a file, or a folder that holds anything but an older map, or if another
            run is writing it.
    """
    # Before the work: another run may be writing there.
    with lock_output(out):
        check_replaceable(out, "map")
        if request.camera_path is not None:
            read_camera(request.camera_path)  # says nothing of the drive, so it has no report
        attempt = Attempt(request, settings)
        try:
            like = next((one for one in (out, *earlier) if _differs_in_scale(one, request, settings)), None)
            return _map_drive(attempt, map_key(request, settings), out, progress, pictures, like)
        except (CalibrationError, DriveFormatError) as error:
            page = _refused(attempt, error, out) if pictures else ""
            hints = _hints(attempt, out) if page else ()
            raise type(error)(f"{error}{kept_map(out)}{page}", hints=hints) from error
        except TrackingLostError as error:
            where = "" if str(request.drive_path) in str(error) else f"{request.drive_path}: "
            page = _refused(attempt, error, out) if pictures else ""
            hints = _hints(attempt, out) if page else ()
            message = f"{where}{error}; {remedy_of(error)}{kept_map(out)}{page}"
            raise TrackingLostError(message, hints=hints) from error


def map_key(request: MapRequest, settings: MapSettings) -> str:
    """Return the hash of all that a map is made from, by which a finished one is known again.

    Raises:
        DriveFormatError: If there is no such drive.
    """
    camera = request.camera_path
    files = [request.drive_path, *([] if camera is None or not camera.exists() else [camera])]
    known = {**vars(request), "drive_path": None, "camera_path": None}
    return key_of(known, [str(path.resolve()) for path in files], settings, *map(fingerprint, files))


def _refused(attempt: Attempt, error: LanenetError, out: Path) -> str:
    """Write the report of a refusal, and say where it is, if there is anything: the end of a sentence."""
    try:
        return f"; see {report_refusal(attempt, error, out)}"
    except DriveFormatError:  # there is nothing to show
        return ""
    except LanenetError as failed:  # what was refused is worse
        return f"; its report could not be written ({failed})"


def _hints(attempt: Attempt, out: Path) -> list[str]:
    return hints_without_map(attempt.request.drive_path, out, None)


def _map_drive(
    attempt: Attempt,
    key: str,
    out: Path,
    progress: StageProgress | None,
    pictures: bool,
    like: Path | None,
) -> Report:
    request = attempt.request
    prepared = attempt.prepared = prepare(request, attempt.settings)
    solver = SegmentSolver(prepared.settings, np.random.default_rng(prepared.settings.seed), progress)
    found = None if like is None else rescaled(like, prepared)
    if found is None:
        found = _solve(attempt, prepared, solver)
    config = () if attempt.settings == MapSettings() else ("--config", "CONFIG")
    assembled = found.assembled.asked_for_by((*request.options, *config))
    solver.tell("lines and checks", 1, 2)
    checked = check_map(prepared, assembled, found.figures)
    solver.tell("lines and checks", 2, 2)
    said = [found.said] if found.said else []
    notes = [*said, *prepared.notes, *found.notes, *checked.notes]
    figures = {
        "drive": str(request.drive_path),
        "frames": len(prepared.drive),
        **found.figures,
        **checked.figures,
        "notes": notes,
        "found_notes": list(found.notes),
        "rescaled": found.said,
    }
    with atomic_folder(out, "map", check_map_files) as folder:
        write_checked(folder, out, prepared, assembled, checked, figures, found.how_calibrated, pictures)
        Output(folder / "map.yaml", key).mark()
    verdict = checked.verdict
    first = f"verdict: {verdict.grade}: {verdict.sentence}"
    return Report(
        (first, *said, *verdict_lines(verdict.reasons, verdict.remarks), *notes[len(said) :]), figures
    )


def _solve(attempt: Attempt, prepared: PreparedDrive, solver: SegmentSolver) -> Solved:
    """Map a drive from its images."""
    compile_ahead()
    camera = attempt.camera = camera_of_drive(prepared, solver)
    # Track, close loops, adjust: SegmentSolver.solve.
    solved = attempt.solved = solve_drive(prepared, camera, solver)
    solver.tell("lines and checks", 0, 2)
    lanes = fit_lanes(prepared, solved.segments, solved.refused, camera.doubt)
    assembled = assemble(prepared, camera.camera, camera.sigma, lanes.segments)
    figures = {"segments": len(solved.segments), **camera.figures}
    return Solved(assembled, figures, camera.how, (*camera.notes, *lanes.notes))


def _differs_in_scale(folder: Path, request: MapRequest, settings: MapSettings) -> bool:
    """Tell whether a folder holds a finished map that differs from the wanted one in its lane width alone.

    With the camera's height the lane width determines the focal length as well, and a known camera sets the
    scale by itself: such maps are made anew.
    """
    try:
        meta = read_map_meta(folder)
    except LanenetError:  # none, or a damaged one
        return False
    if meta.scale_from == "camera" or request.camera_height_cm is not None:
        return False
    earlier = replace(request, lane_width_cm=meta.lane_width_cm)
    if earlier == request or Path(meta.drive) != request.drive_path.resolve():
        return False
    return Output(folder / "map.yaml", map_key(earlier, settings)).done


def write_checked(
    folder: Path,
    out: Path,
    prepared: PreparedDrive,
    assembled: AssembledMap,
    checked: CheckedMap,
    figures: dict[str, Any],
    how_calibrated: str,
    pictures: bool,
) -> None:
    """Write a map that was checked into an existing folder.

    Args:
        folder: The folder.
        out: Where it will be.
        prepared: The drive.
        assembled: Its map.
        checked: The same with its verdict.
        figures: For the report.
        how_calibrated: How the camera was found.
        pictures: Draw the map, its frames and the report's page.
    """
    drive_map, settings = checked.mapped.drive_map, prepared.settings
    write_map(folder, drive_map, assembled.edges, figures, how_calibrated)
    write_text(folder / SETTINGS_NAME, dump_settings(settings))
    write_tum(folder / "open_loop.tum", drive_map.t_s, assembled.open_poses)
    if pictures:
        _draw(folder, out, assembled, checked, figures)


def _draw(
    folder: Path,
    out: Path,
    assembled: AssembledMap,
    checked: CheckedMap,
    figures: dict[str, Any],
) -> None:
    """Draw the map, some of its frames, and the page of the report."""
    mapped = checked.mapped
    drive_map = mapped.drive_map
    image = draw_map(folder / "map.png", drive_map, assembled.near_points, mapped.starts)
    shown = np.linspace(0, len(drive_map.frames) - 1, _SHOWN).astype(int)
    draw_contact_sheet(folder / "frames.png", mapped, shown)
    page = report_page(mapped, checked.quality, checked.verdict, figures, image, out)
    write_text(folder / PAGE_NAME, page)
