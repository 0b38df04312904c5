"""What ``lanenet calibrate`` shows of its results: tables, and pictures beside the camera file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lanenet.cli import console

if TYPE_CHECKING:
    from datagen.calibrate_drive import CalibratedDrive
    from lanenet.calibration.chessboard_camera import ChessboardCalibration
    from lanenet.calibration.ground import GroundCalibration

#: The bird's-eye picture's left, near, right and far edge, [cm].
_AREA_CM = (-60.0, 0.0, 60.0, 120.0)
#: Scale of several such pictures beside each other; a line of the grid every 10 cm.
_SMALL_PX_PER_CM = 4.0


def lens_pictures(out: Path, result: ChessboardCalibration) -> list[Path]:
    """Write the largest view without distortion, and its board from above; returns their paths."""
    from lanenet.calibration.chessboard import read_picture
    from lanenet.calibration.chessboard_camera import reprojected
    from lanenet.calibration.pictures import plane_picture, points_picture, undistorted_picture

    sizes = [float(np.prod(np.ptp(view.corners_px, axis=0))) for view in result.views]
    index = int(np.argmax(sizes))
    view = result.views[index]
    frame = read_picture(Path(view.name))
    marked = points_picture(frame, view.corners_px, reprojected(result, index))
    (x0, y0), (x1, y1) = view.points_cm.min(axis=0), view.points_cm.max(axis=0)
    margin = 0.4 * max(x1 - x0, y1 - y0)
    area = (x0 - margin, y0 - margin, x1 + margin, y1 + margin)
    return [
        _write_picture(out, "undistorted", undistorted_picture(marked, result.camera)),
        _write_picture(out, "board", plane_picture(frame, result.camera, result.fit.poses[index], area)),
    ]


def ground_pictures(
    out: Path, frame: np.ndarray, result: GroundCalibration, pixels_px: np.ndarray
) -> list[Path]:
    """Write the photo of the ground without distortion, and from above; returns their paths."""
    from lanenet.calibration.lens import pose_from_mounting
    from lanenet.calibration.pictures import plane_picture, points_picture, undistorted_picture

    marked = points_picture(frame, pixels_px, pixels_px - result.residuals_px)
    pose = pose_from_mounting(result.camera.mounting)
    return [
        _write_picture(out, "undistorted", undistorted_picture(marked, result.camera)),
        _write_picture(out, "birdseye", plane_picture(frame, result.camera, pose, _AREA_CM)),
    ]


def drive_pictures(out: Path, result: CalibratedDrive) -> list[Path]:
    """Write frames of a straight stretch without distortion, and from above; returns their paths."""
    from lanenet.calibration.lens import pose_from_mounting
    from lanenet.calibration.pictures import plane_picture, undistorted_picture

    pose = pose_from_mounting(result.camera.mounting)
    frames = [result.drive.image(k) for k in result.shown]
    flat = [undistorted_picture(frame, result.camera) for frame in frames]
    above = [plane_picture(frame, result.camera, pose, _AREA_CM, _SMALL_PX_PER_CM) for frame in frames]
    return [
        _write_picture(out, "undistorted", np.concatenate(flat, axis=1)),
        _write_picture(out, "birdseye", np.concatenate(above, axis=1)),
    ]


def _write_picture(out: Path, what: str, picture: np.ndarray) -> Path:
    import cv2

    from lanenet.data.files import atomic_file

    path = out.with_name(f"{out.stem}-{what}.png")
    with atomic_file(path) as temporary:
        cv2.imwrite(str(temporary), picture)
    return path


def show_lens(result: ChessboardCalibration, pictures: int) -> None:
    """Print a lens with its spreads, and how far each picture's corners lie off."""
    from lanenet.calibration.chessboard_camera import view_errors_px

    rows = [[Path(name).name, f"{rms:.3f}"] for name, rms in view_errors_px(result).items()]
    console.show_table("corners, measured minus projected", ("picture", "RMS px"), rows)
    K, s, D = result.camera.K, result.fit.lens_sigma, result.camera.D
    console.show_lines(
        [
            f"{result.camera.model} lens, {len(result.views)} of {pictures} pictures used, "
            f"RMS {result.fit.rms_px:.3f} px",
            f"focal lengths   {K[0, 0]:.2f} +- {s[0]:.2f}   {K[1, 1]:.2f} +- {s[1]:.2f} px",
            f"principal point {K[0, 2]:.2f} +- {s[2]:.2f}   {K[1, 2]:.2f} +- {s[3]:.2f} px",
            "distortion      " + "  ".join(f"{d:.4f} +- {e:.4f}" for d, e in zip(D, s[4:], strict=True)),
        ]
    )


def show_mounting(result: GroundCalibration, points_cm: np.ndarray, pixels_px: np.ndarray) -> None:
    """Print a mounting with its spreads, and the points that do not agree with it."""
    mounting, sigma = result.camera.mounting, result.sigma
    lines = [f"{int(result.used.sum())} of {len(result.used)} points used, RMS {result.rms_px:.2f} px"]
    for name in sigma:
        value, spread = getattr(mounting, name), sigma[name]
        label, _, unit = name.rpartition("_")
        if unit == "rad":
            value, spread, unit = np.rad2deg(value), np.rad2deg(spread), "degrees"
        lines.append(f"{label.replace('_', ' '):20s}{value:8.2f} +- {spread:.2f} {unit}")
    road_cm = result.camera.intersect_ground(pixels_px[result.used])
    worst = float(np.nanmax(np.linalg.norm(road_cm - points_cm[result.used], axis=1)))
    console.show_lines([*lines, f"{'worst point':20s}{worst:8.2f} cm off on the ground"])
    console.show_problems(
        [
            f"left out point {k + 1}: "
            + (
                "behind the camera or out of its sight"
                if result.behind[k]
                else f"{np.linalg.norm(result.residuals_px[k]):.1f} px off"
            )
            for k in np.flatnonzero(~result.used)
        ]
    )


def show_drive(result: CalibratedDrive) -> None:
    """Print a camera found from a drive with its spreads, in the units that people use."""
    camera, m, sigma = result.camera, result.camera.mounting, result.sigma
    K, turn = camera.K, float(np.rad2deg(1.0))
    numbers = (
        ("focal length", K[0, 0], sigma["focal_px"], "px", 1),
        ("principal point, u", K[0, 2], sigma["cx_px"], "px", 1),
        ("principal point, v", K[1, 2], sigma["cy_px"], "px", 1),
        ("distortion k1", camera.D[0], sigma["k1"], "", 4),
        ("pitch, down", turn * m.pitch_down_rad, turn * sigma["pitch_down_rad"], "degrees", 2),
        ("roll", turn * m.roll_rad, turn * sigma["roll_rad"], "degrees", 2),
        ("yaw, to the left", turn * m.yaw_rad, turn * sigma["yaw_rad"], "degrees", 2),
        ("height", m.height_cm, sigma.get("height_cm"), "cm", 1),
        ("ahead of front axle", m.ahead_of_front_axle_cm, sigma["ahead_of_front_axle_cm"], "cm", 1),
    )
    rows = [
        [name, f"{value:.{digits}f}", "given" if spread is None else f"{spread:.{digits}f}", unit]
        for name, value, spread, unit, digits in numbers
    ]
    console.show_table(f"{camera.model} camera from {result.drive.name}", ("number", "found", "+-", ""), rows)
    lane = "no lane found" if result.lane_cm is None else f"lane {result.lane_cm:.1f} cm"
    console.show_lines(
        [
            f"{result.frames} frames, {result.revisits} places seen twice, edges agree to "
            f"{result.robust_sd_px:.2f} px (robust sd), {lane}"
        ]
    )
