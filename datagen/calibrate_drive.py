"""A camera with its uncertainties from one drive: ``lanenet calibrate drive``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from datagen.lanes.scale import LaneScale, measure_lane
from datagen.prepare import check_lens, check_moving, hide_bumper, keep_images, readable_frames
from datagen.segments import fit_height, segments_of
from datagen.settings import MapSettings
from datagen.slam.camera.coarse import with_known_scale
from datagen.slam.camera.self_calibration import (
    DRIVE_INSTEAD,
    MIN_FRAMES,
    FoundCamera,
    check_observable,
    find_camera,
)
from datagen.slam.odometry.stillness import following_frames
from datagen.slam.segment import SegmentSolver, StageProgress
from lanenet.data.camera_file import read_camera
from lanenet.data.drives import Drive, open_drive
from lanenet.errors import CalibrationError, TrackingLostError
from lanenet.geometry.camera import Camera
from lanenet.geometry.poses import path_lengths

#: Relative difference from the given lane width, where the scale comes from elsewhere, that is worth a note.
#: Chosen: more than the sigma of a measured lane width on a good drive.
_OTHER_LANE = 0.05
#: Frames in the pictures, and distance ahead to which they show the road, in camera heights. Chosen: a person
#: sees there whether the lines run straight and parallel.
_SHOWN, _SEEN_HEIGHTS = 3, 6.0


@dataclass(frozen=True)
class CalibratedDrive:
    """A camera found from a drive.

    Attributes:
        camera: The camera, [cm].
        sigma: Standard deviations; each name ends in its unit. A height that was given has none.
        notes: What was assumed or left out, a sentence each.
        method: How the camera was found.
        frames: Number of frames that were used.
        revisits: Number of loop closures.
        robust_sd_px: Robust standard deviation of the residuals between frames.
        lane_cm: Width of the driven lane with this camera; None where none was found.
        shown: Frames for pictures, in which the car drives straight ahead.
        drive: The drive, without frames in which the car stands.
    """

    camera: Camera
    sigma: dict[str, float]
    notes: tuple[str, ...]
    method: str
    frames: int
    revisits: int
    robust_sd_px: float
    lane_cm: float | None
    shown: tuple[int, ...]
    drive: Drive

    @property
    def residuals(self) -> dict[str, float]:
        """Figures for the camera file; each name ends in its unit."""
        figures = {}
        for name, value in self.sigma.items():
            what, _, unit = name.rpartition("_")
            figures[f"{what}_sigma_{unit}" if what else f"{name}_sigma"] = value
        counts = {"frames_count": float(self.frames), "revisits_count": float(self.revisits)}
        return {"reprojection_robust_sd_px": self.robust_sd_px, **counts, **figures}


def starting_camera(
    drive_path: Path, camera_path: Path | None, refine: bool
) -> tuple[Camera | None, list[str]]:
    """Choose the camera with which a calibration starts.

    Args:
        drive_path: The drive, which may have a camera of its own.
        camera_path: A camera file; None takes the drive's own.
        refine: Refine the camera instead of looking for one.

    Returns:
        The camera to refine, or None to look for one; and notes.

    Raises:
        CalibrationError: If a camera is given but not to be refined, or there is none to refine.
    """
    if camera_path is not None:
        if not refine:
            raise CalibrationError(
                f"{camera_path}: a known camera is used as it is; add --refine to adjust it to the drive, or "
                "leave out --camera to find one"
            )
        return read_camera(camera_path), []
    own = open_drive(drive_path).camera
    if refine and own is None:
        raise CalibrationError(f"{drive_path}: the drive has no camera to refine; give one with --camera")
    if refine or own is None:
        return own, []
    return None, [f"the drive has a camera of its own, which is not used (focal length {own.K[0, 0]:.1f} px)"]


def calibrate_drive(
    drive_path: Path,
    lane_width_cm: float | None,
    camera_height_cm: float | None,
    start: Camera | None,
    settings: MapSettings,
    progress: StageProgress | None = None,
    *,
    accept_open_loop: bool = False,
) -> CalibratedDrive:
    """Find or refine the camera of a drive.

    Images show everything but the scale. It comes from the camera's height where that is given, else from the
    lane width, else from the height of the camera to refine.

    Args:
        drive_path: Drive folder, Donkeycar tub or video.
        lane_width_cm: Between the middles of the two lines of the driven lane.
        camera_height_cm: Height of the lens above the road. Together with the lane width it also determines
            the focal length where no loop is closed.
        start: Camera to refine; None looks for one.
        settings: Settings of all mapping stages; ``guess`` is what the search tries.
        progress: Called with (stage, done, total).
        accept_open_loop: Accept a guessed focal length where no loop was closed.

    Returns:
        The camera with its uncertainties.

    Raises:
        CalibrationError: If the drive does not determine the camera, or nothing gives the scale; says what to
            drive or to give instead.
        DriveFormatError: If the drive cannot be read.
    """
    if lane_width_cm is None and camera_height_cm is None and start is None:
        raise CalibrationError(
            "images do not show the scale: expected the lane's width or the camera's height, found neither"
        )
    recorded, unreadable = readable_frames(keep_images(open_drive(drive_path)))
    if start is None:
        check_lens(recorded)
    drive, notes = _moving_part(recorded, start)
    notes += unreadable
    settings, hidden = hide_bumper(drive, settings)
    notes += hidden
    if start is not None:
        guess = settings.guess.model_copy(update={"wheelbase_cm": start.wheelbase_cm})
        settings = settings.model_copy(update={"guess": guess})
    rng = np.random.default_rng(settings.seed)
    solver = SegmentSolver(settings, rng, progress)
    try:
        found = find_camera(drive, start, solver)
    except TrackingLostError as error:
        raise CalibrationError(f"{error}. {DRIVE_INSTEAD.capitalize()}") from error
    if start is None and lane_width_cm is not None and camera_height_cm is not None:
        found, more = fit_height(found, drive, lane_width_cm / camera_height_cm, settings, solver)
        notes += more
    notes += check_observable(found, str(drive_path), accept_open_loop)
    lane = _lane_of(
        found, settings, drive_path, needed=lane_width_cm is not None and camera_height_cm is None
    )
    factor, height_sigma, scale_from = _scale(found.camera, lane, lane_width_cm, camera_height_cm)
    shown = straight_frames(found.solved.poses, _SEEN_HEIGHTS * found.camera.mounting.height_cm, _SHOWN)
    camera = with_known_scale(found.camera, factor, settings.guess.wheelbase_cm)
    lane_cm = None if lane is None else factor * lane.width_cm
    if lane_width_cm and lane_cm and abs(lane_cm / lane_width_cm - 1.0) > _OTHER_LANE:
        notes.append(
            f"the lane measures {lane_cm:.1f} cm with the scale from {scale_from}; given were "
            f"{lane_width_cm:.1f} cm"
        )
    return CalibratedDrive(
        camera=camera,
        sigma=_sigma_with_units(found.sigma, camera, height_sigma),
        notes=tuple(notes),
        method=f"{found.how}; {len(drive)} frames of {drive.name}; scale from {scale_from}",
        frames=len(drive),
        revisits=len(found.solved.revisits),
        robust_sd_px=found.solved.bundle.robust_sd_px,
        lane_cm=lane_cm,
        shown=tuple(found.solved.rows[list(shown)].tolist()),
        drive=drive,
    )


def _moving_part(recorded: Drive, start: Camera | None) -> tuple[Drive, list[str]]:
    """Frames in which the car drives forward, and notes on what was left out."""
    notes = list(recorded.problems)
    if start is not None and (start.width, start.height) != (recorded.width, recorded.height):
        raise CalibrationError(
            f"{recorded.path}: images of {recorded.width}x{recorded.height} px, but the camera to refine is "
            f"for {start.width}x{start.height} px"
        )
    _check_count(recorded, len(recorded), "frames")
    try:
        check_moving(recorded)
        moving, found = following_frames(recorded)
        notes += found
        _check_count(recorded, len(moving), f"of {len(recorded)} frames show a car that moves")
    except TrackingLostError as error:
        raise CalibrationError(f"{error}. {DRIVE_INSTEAD.capitalize()}") from error
    return moving, notes


def _check_count(drive: Drive, count: int, what: str) -> None:
    if count < MIN_FRAMES:
        raise CalibrationError(f"{drive.path}: {count} {what}, expected {MIN_FRAMES}: {DRIVE_INSTEAD}")


def _lane_of(found: FoundCamera, settings: MapSettings, where: Path, needed: bool) -> LaneScale | None:
    try:
        return measure_lane(segments_of(found.solved)[0], found.sigma, settings.trace, settings.fit)
    except TrackingLostError as error:
        if needed:
            raise CalibrationError(
                f"{where}: {error}. Drive between two lines, or give the camera's height (--camera-height)"
            ) from error
        return None


def _scale(
    camera: Camera, lane: LaneScale | None, lane_width_cm: float | None, camera_height_cm: float | None
) -> tuple[float, float | None, str]:
    """Factor to centimetres, relative sigma of the height (None where it was given), and source of both."""
    if camera_height_cm is not None:
        factor = camera_height_cm / camera.mounting.height_cm
        return factor, None, f"the camera's height, {camera_height_cm:g} cm"
    if lane_width_cm is not None and lane is not None:
        return lane_width_cm / lane.width_cm, lane.sigma, f"the lane's width, {lane_width_cm:g} cm"
    return 1.0, None, f"the given camera's height, {camera.mounting.height_cm:g} cm"


def _sigma_with_units(
    sigma: dict[str, float], camera: Camera, height_sigma: float | None
) -> dict[str, float]:
    m = camera.mounting
    lever_heights = (m.ahead_of_front_axle_cm + camera.wheelbase_cm) / m.height_cm
    ahead = np.hypot(sigma["lever"], lever_heights * (height_sigma or 0.0)) * m.height_cm
    with_units = {
        "focal_px": float(camera.K[0, 0]) * sigma["focal"],
        "cx_px": sigma["cx"],
        "cy_px": sigma["cy"],
        "k1": sigma["k1"],
        "pitch_down_rad": sigma["pitch"],
        "roll_rad": sigma["roll"],
        "yaw_rad": sigma["yaw"],
        "ahead_of_front_axle_cm": float(ahead),
    }
    return with_units if height_sigma is None else {**with_units, "height_cm": height_sigma * m.height_cm}


def straight_frames(poses: Float[np.ndarray, "n 3"], ahead_cm: float, count: int) -> tuple[int, ...]:
    """Pick the frame with the straightest path ahead in each of several equal parts of a drive.

    Args:
        poses: Poses, heading unwrapped.
        ahead_cm: Distance over which the path should be straight.
        count: Number of parts.
    """
    n = len(poses)
    path = path_lengths(poses)
    last = np.minimum(np.searchsorted(path, path + ahead_cm), n - 1)
    turn = np.array([np.ptp(poses[k : last[k] + 1, 2]) for k in range(n)])
    # Near the end, less than the whole distance is known.
    turn[path + ahead_cm > path[-1]] += 2.0 * np.pi
    parts = np.array_split(np.arange(n), count)
    return tuple(int(part[np.argmin(turn[part])]) for part in parts if len(part))
