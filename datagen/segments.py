"""Stages over a drive: its camera and poses, then the lanes of each of its segments.

A segment is what hangs together of a drive: it has a map frame of its own. One that cannot be mapped does not
spoil the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from datagen.lanes.find import MappedSegment, check_lane, find_lane
from datagen.lanes.scale import fitted_width, measure_lane
from datagen.prepare import LEAST_FRAMES, PreparedDrive, check_edges
from datagen.settings import MapSettings
from datagen.slam.camera.coarse import nudged
from datagen.slam.camera.self_calibration import MAX_STRAIN, FoundCamera, find_camera, honest_sigma
from datagen.slam.loops.parts import LEAST_TIED, connected
from datagen.slam.segment import SegmentSolver, SolvedSegment
from datagen.slam.view import LEAST_POINTS
from lanenet.data.camera_file import MAP_CAMERA_NAME, read_sigma
from lanenet.data.drives import Drive
from lanenet.data.maps.folder import sigma_in_report
from lanenet.data.segments import equal_runs
from lanenet.errors import CalibrationError, MapFormatError, TrackingLostError, counted
from lanenet.geometry.camera import Camera
from lanenet.reading import parsing, read_json

#: Sigmas of a height and a lane width that were measured with a ruler, relative. Chosen: half a centimetre of
#: a height of 17 cm, half a centimetre of a lane.
_HEIGHT_SIGMA, _WIDTH_SIGMA = 0.03, 0.012
#: Change of the logarithm of the lane's width in camera heights with that of the focal length: a longer lens
#: sees narrower lanes. Measured at the first step, on simulated drives -0.6 to -0.9; bounds of what is
#: measured later, for two lenses that are nearly alike say little.
_WIDTH_BY_FOCAL, _WIDTH_BY_FOCAL_BOUNDS = -0.75, (-1.5, -0.4)
#: Relative error of the focal length that an error of the first lens coefficient brings, which is a guess
#: until a loop is closed. Measured on simulated drives, lenses of 61 and 73 px: 5 % for 0.03; with the right
#: coefficient the focal length was within 0.7 %.
_FOCAL_BY_K1 = 1.7
#: Times that a drive is solved again with another focal length, and relative change below which it is not.
#: Chosen: the slope is off by a third at most, so that two steps leave a tenth of the error.
_HEIGHT_ROUNDS, _SAME_FOCAL = 3, 0.01
#: Runs of frames that a note names. Chosen: a line of the terminal.
_NAMED_RUNS = 5


@dataclass(frozen=True)
class CameraOfDrive:
    """The camera to map with.

    Attributes:
        camera: In centimetres where it was known, else of nominal height.
        how: How it was found, for the files.
        solved: The drive, where it was solved on the way.
        figures: For the report.
        notes: A sentence each.
        doubt: Why a camera that was found is unlikely to be right; "" where nothing speaks against it.
        sigma: Standard deviation of each of its numbers, see
            :attr:`datagen.slam.camera.self_calibration.FoundCamera.sigma`; none where it was measured.
    """

    camera: Camera
    how: str = "given"
    solved: SolvedSegment | None = None
    figures: dict[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    doubt: str = ""
    sigma: dict[str, float] = field(default_factory=dict)


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
    """Take the known camera, or find it in the drive; refine it there if that was asked for.

    Raises:
        TrackingLostError: If the drive shows too few edges of the road.
    """
    if prepared.camera is not None and not prepared.request.refine_camera:
        own = prepared.drive.path / MAP_CAMERA_NAME
        sigma = sigma_of_earlier(prepared.request.camera_path or (own if own.is_file() else None))
        return CameraOfDrive(prepared.camera, figures={"camera_sigma": sigma} if sigma else {}, sigma=sigma)
    drive = prepared.drive
    check_edges(drive, prepared.settings.perception.edges)
    found = find_camera(drive, prepared.camera, solver)
    notes: tuple[str, ...] = ()
    width_cm, height_cm = prepared.request.lane_width_cm, prepared.request.camera_height_cm
    if height_cm is not None:
        found, notes = fit_height(found, drive, width_cm / height_cm, prepared.settings, solver)
    figures = {"calibration": found.figures}
    doubt = ""
    if found.strain > MAX_STRAIN[1]:
        camera = found.camera
        doubt = (
            "the camera cannot be found from this drive: the one that fits best is unlike ordinary ones "
            f"(principal point, roll or odometry {found.strain:.1f} standard deviations off: principal "
            f"point at {camera.K[0, 2]:.0f}, {camera.K[1, 2]:.0f} px of {camera.width}x{camera.height}, "
            f"rolled by {np.rad2deg(camera.mounting.roll_rad):.0f} degrees)"
        )
    elif found.candidates and not found.candidates[0].is_clear:
        doubt = (
            f"the camera cannot be found from this drive: with none of the {len(found.candidates)} cameras "
            "that were tried do the edges of an image clearly meet those of the next one"
        )
    notes = (found.note, *notes)
    return CameraOfDrive(found.camera, found.how, found.solved, figures, notes, doubt, found.sigma)


def sigma_of_earlier(camera_path: Path | None) -> dict[str, float]:
    """Return the sigmas of a camera that was found from earlier drives; none for other cameras.

    Args:
        camera_path: The camera file, or the folder of a map, whose report has them if its camera file has
            none, as in earlier versions.

    Raises:
        MapFormatError: If the map's report cannot be read.
        CalibrationError: If the camera file cannot be read.
    """
    if camera_path is None:
        return {}
    path = camera_path / MAP_CAMERA_NAME if camera_path.is_dir() else camera_path
    report_path = path.with_name("report.json")
    if (found := read_sigma(path)) or not path.with_name("map.yaml").is_file():
        return found
    report = read_json(report_path, MapFormatError)
    with parsing(f"{report_path}: sigmas of the camera", MapFormatError):
        return {str(name): float(value) for name, value in sigma_in_report(report).items()}


def fit_height(
    found: FoundCamera, drive: Drive, lane_heights: float, settings: MapSettings, solver: SegmentSolver
) -> tuple[FoundCamera, tuple[str, ...]]:
    """Find the focal length with which the lane has the width that it has, in camera heights.

    The images alone leave the focal length open until a loop is closed, and this one number determines it.
    Where a loop was closed, it is a prior beside what the loop says.

    Args:
        found: The camera that the images show.
        drive: The drive.
        lane_heights: Lane width over camera height.
        settings: How lanes are found.
        solver: Solves the drive.

    Returns:
        The camera, and a note if the lane that it needs was not found.
    """
    points: list[tuple[float, float]] = []
    slope = _WIDTH_BY_FOCAL
    while True:
        try:
            lane = measure_lane(segments_of(found.solved)[0], {}, settings.trace, settings.fit)
        except TrackingLostError as error:
            return found, (f"the camera's height was not used: {error}",)
        camera = found.camera
        points.append((np.log(camera.K[0, 0]), np.log(lane.width_cm / camera.mounting.height_cm)))
        if len(points) > 1:
            (focal_0, width_0), (focal_1, width_1) = points[-2:]
            slope = float(np.clip((width_1 - width_0) / (focal_1 - focal_0), *_WIDTH_BY_FOCAL_BOUNDS))
        change = float(np.log(lane_heights) - points[-1][1]) / slope
        by_width = float(np.linalg.norm([_HEIGHT_SIGMA, _WIDTH_SIGMA, lane.sigma])) / abs(slope)
        focal_sigma = float(np.hypot(by_width, _FOCAL_BY_K1 * found.sigma["k1"]))
        rounds = 1 if found.closed else _HEIGHT_ROUNDS
        if abs(change) < _SAME_FOCAL or len(points) > rounds:
            break
        found = _with_focal(found, drive, change, focal_sigma, solver)
    if found.closed:
        sigma = {**found.sigma, "focal": min(focal_sigma, found.sigma["focal"])}
    else:
        # Pitch and focal length are found together: the horizon stays where it is in the image.
        by_focal = 0.5 * float(np.sin(2.0 * camera.mounting.pitch_down_rad)) * focal_sigma
        pitch_sigma = float(np.hypot(found.sigma["pitch"], by_focal))
        sigma = {**found.sigma, "focal": focal_sigma, "pitch": pitch_sigma}
    return replace(found, sigma=sigma, height_given=True), ()


def _with_focal(
    found: FoundCamera, drive: Drive, change: float, focal_sigma: float, solver: SegmentSolver
) -> FoundCamera:
    """Solve a drive again with another focal length, and the horizon where it is in the images.

    Args:
        found: The camera before.
        drive: The drive.
        change: Of the focal length, a logarithm.
        focal_sigma: How closely it is known, relative.
        solver: Solves the drive.
    """
    pitch = float(np.arctan(np.tan(found.camera.mounting.pitch_down_rad) * np.exp(-change)))
    camera = nudged(found.camera, "focal", change).with_mounting(pitch_down_rad=pitch)
    bundle = solver.settings.bundle.model_copy(update={"focal": focal_sigma})
    solver = replace(solver, settings=solver.settings.model_copy(update={"bundle": bundle}))
    solved = solver.solve(drive, camera, find_camera=True, prior_camera=camera)
    sigma = honest_sigma(solved, found.strain, bundle, camera.width)
    return replace(found, solved=solved, sigma=sigma)


def segments_of(solved: SolvedSegment) -> list[SolvedSegment]:
    """Return what hangs together of a solved drive, the longest first."""
    group = connected(solved.part, solved.revisits)
    by_size = np.argsort(-np.bincount(group), kind="stable")
    return [solved.only(np.flatnonzero(group == number)) for number in by_size]


def solve_drive(prepared: PreparedDrive, camera: CameraOfDrive, solver: SegmentSolver) -> SolvedDrive:
    """Track the drive, close its loops and adjust it; what hangs together of it becomes a segment.

    Raises:
        TrackingLostError: If the road shows too few edges, or no segment is long enough.
    """
    drive = prepared.drive
    found = segments_of(camera.solved or solver.solve(drive, camera.camera))
    tied = np.concatenate([one.rows for one in found])
    untied = np.setdiff1d(np.arange(len(drive)), tied)
    if len(found[0].rows) < LEAST_FRAMES:
        more = f", and {counted(len(untied), 'frame')} that nothing ties to others" if len(untied) else ""
        raise TrackingLostError(
            f"{drive.path}: {len(tied)} frames in {counted(len(found), 'part')} that show no place of each "
            f"other, the longest of {len(found[0].rows)} frames{more}; mapping needs {LEAST_FRAMES}"
        )
    kept = sorted((one for one in found if len(one.rows) >= LEAST_FRAMES), key=lambda one: int(one.rows[0]))
    short = [one.rows for one in found if len(one.rows) < LEAST_FRAMES]
    refused = []
    if short:
        rows, parts = np.sort(np.concatenate(short)), f" in {len(short)} parts" if len(short) > 1 else ""
        reason = f"{counted(len(rows), 'frame')}{parts} that show no place of others"
        refused.append(Refused(rows, TrackingLostError(reason)))
    if len(untied):
        reason = (
            f"nothing ties them to others: between two breaks, less than {LEAST_TIED} frames show "
            f"{LEAST_POINTS} edge points on the road"
        )
        refused.append(Refused(untied, TrackingLostError(reason)))
    return SolvedDrive(tuple(kept), tuple(refused))


def fit_lanes(
    prepared: PreparedDrive,
    segments: Sequence[SolvedSegment],
    refused: Sequence[Refused],
    doubt: str = "",
) -> LanesOfDrive:
    """Find the lane of each segment, the longest first.

    The markings of the others are of its kind, and unless it is known, the lane has its width.

    Args:
        prepared: The drive.
        segments: Segments with their poses.
        refused: Those that could not be tracked.
        doubt: See :class:`CameraOfDrive`.

    Raises:
        TrackingLostError: If no segment can be mapped; says why the longest one cannot.
        CalibrationError: The same, where the longest one shows a lane of another width, or where the camera
            is in doubt.
    """
    drive, settings, held_out = prepared.drive, prepared.settings, prepared.held_out
    mapped: list[MappedSegment] = []
    failed: list[Refused] = []
    lane_cm, dark = prepared.known_lane_cm, None
    # A narrower one would make a camera or tape of the given lane that the verdict calls impossible.
    told_cm, sizes = prepared.request.lane_width_cm, settings.verdict
    least = told_cm / sizes.height_cm[1], told_cm / sizes.tape_cm[1]
    for segment in sorted(segments, key=lambda one: -len(one.rows)):
        rows = segment.rows
        try:
            one = find_lane(segment, lane_cm, held_out[rows], settings.trace, settings.fit, dark, least)
            check_lane(one, drive)
        except (TrackingLostError, CalibrationError) as error:
            failed.append(Refused(rows, error))
        else:
            mapped.append(one)
            # A road keeps its width and its markings; the longest segment shows them best.
            dark = one.dark
            if lane_cm is None or one.is_one_of_several:
                lane_cm = fitted_width(one.lines, one.lane, one.s_frames_cm).width_cm
    if not mapped:
        reason = failed[0].reason  # of the longest
        if doubt:
            why = str(reason).removeprefix(f"{drive.path}: ")
            raise CalibrationError(
                f"{drive.path}: {doubt}, and with it {why}; print a board and a floor sheet (lanenet "
                "calibrate print), photograph them (lanenet calibrate chessboard, then lanenet calibrate "
                "ground), and give the camera with --camera"
            ) from reason
        raise reason
    mapped.sort(key=lambda one: int(one.rows[0]))
    return LanesOfDrive(tuple(mapped), tuple(one.note(drive) for one in [*refused, *failed]))


def frames_text(drive: Drive, rows: Int[np.ndarray, "n"]) -> str:
    """Name rows of a drive by the numbers of the first and the last frame of each of the first few runs."""
    runs = [drive.frames[rows[run]] for run in equal_runs(rows - np.arange(len(rows)))]
    named = [str(run[0]) if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs[:_NAMED_RUNS]]
    more = f" and {counted(len(runs) - _NAMED_RUNS, 'further run')}" if len(runs) > _NAMED_RUNS else ""
    return f"{'frame' if len(rows) == 1 else 'frames'} {', '.join(named)}{more}"
