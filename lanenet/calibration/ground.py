"""Where a camera sits on the car: its mounting from points of the ground whose pixels are known."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Bool, Float

from lanenet.calibration.ground_fit import fitted_pose, pixel_residuals, residual_weights
from lanenet.calibration.ground_points import MIN_POINTS, check_points
from lanenet.calibration.pose import mounting_from_pose
from lanenet.errors import CalibrationError
from lanenet.geometry.camera import Camera, Mounting

#: A lens lower than this would lie on the road: the points are in metres.
_LEAST_HEIGHT_CM = 1.0
_MAX_RMS_SHARE, _MAX_HEIGHT_SIGMA = 0.02, 0.15
#: Beyond this yaw a camera does not look ahead, unless it looks straight down, where yaw means nothing.
_MAX_YAW_RAD, _DOWN_RAD = float(np.deg2rad(90.0)), float(np.deg2rad(80.0))
#: An explanation of mirrored points is believed if it fits like the best one and leaves the camera upright,
#: looking ahead, within this much.
_ALIKE_RATIO, _ALIKE_PX, _MAX_TURN_RAD = 2.0, 0.2, float(np.deg2rad(60.0))


@dataclass(frozen=True)
class GroundCalibration:
    """A camera with the mounting that was found.

    Attributes:
        camera: The camera with its new mounting.
        points_car_cm: The points, frame car.
        residuals_px: Measured minus projected, per point, those left out included.
        used: Which points were used.
        sigma: Standard deviation of each number of the mounting, in its own unit.
    """

    camera: Camera
    points_car_cm: Float[np.ndarray, "n 2"]
    residuals_px: Float[np.ndarray, "n 2"]
    used: Bool[np.ndarray, "n"]
    sigma: dict[str, float]

    @property
    def rms_px(self) -> float:
        """Root mean square distance of the used points."""
        return float(np.sqrt(np.mean(np.sum(self.residuals_px[self.used] ** 2, axis=1))))

    @property
    def behind(self) -> Bool[np.ndarray, "n"]:
        """Points that the lens cannot see from where it is: behind it, or past its field of view."""
        return ~np.isfinite(self.camera.project_ground(self.points_car_cm)).all(axis=1)

    @property
    def residuals(self) -> dict[str, float]:
        """Figures of the fit for the camera file; each name ends in its unit."""
        figures = {
            f"{name.rpartition('_')[0]}_sigma_{name.rpartition('_')[2]}": v for name, v in self.sigma.items()
        }
        return {"ground_rms_px": self.rms_px, "ground_points_count": float(self.used.sum()), **figures}


def calibrate_ground(
    camera: Camera, points_car_cm: Float[np.ndarray, "n 2"], pixels_px: Float[np.ndarray, "m 2"]
) -> GroundCalibration:
    """Find height, pitch, roll, yaw and offset of a camera with a known lens.

    Args:
        camera: The camera; its mounting is replaced.
        points_car_cm: Points of the ground, frame car (x to the right, y ahead).
        pixels_px: Where the image shows them.

    Returns:
        The mounting with its uncertainty; points that contradict the others are left out.

    Raises:
        CalibrationError: If there are fewer than four points, they lie on one line, outside the image or past
            what the lens sees, behind the camera, or contradict each other; if their axes are mirrored or
            swapped, and which.
    """
    check_points(camera, points_car_cm, pixels_px)
    rays = camera.unproject(pixels_px)
    unseen = np.flatnonzero(~np.isfinite(rays).all(axis=1))
    if unseen.size:
        u, v = pixels_px[unseen[0]]
        raise CalibrationError(f"point {unseen[0] + 1}: the lens sees nothing at pixel {u:.1f}, {v:.1f}")
    found = fitted_pose(camera, points_car_cm, pixels_px)
    if found is None:
        raise CalibrationError("these points do not determine a mounting: spread them over the ground")
    pose, used = found
    result = replace(camera, mounting=mounting_from_pose(pose))
    if result.mounting.height_cm <= 0.0:
        raise CalibrationError(_mirror_text(camera, points_car_cm, pixels_px))
    residuals = pixel_residuals(camera, pose, points_car_cm, pixels_px)
    # Past the angle where a lens folds back, its formula still gives a pixel, that of another point.
    used = used & np.isfinite(result.project_ground(points_car_cm)).all(axis=1)
    if used.sum() < MIN_POINTS:
        raise CalibrationError(
            f"{used.sum()} of {len(used)} points lie in the camera's sight, expected at least {MIN_POINTS}; "
            "the others are behind it or past its field of view"
        )
    weights = residual_weights(camera, pose, points_car_cm)
    sigma = _sigma(result, points_car_cm[used], residuals[used], weights[used])
    answer = GroundCalibration(result, points_car_cm, residuals, used, sigma)
    _check_answer(answer)
    return answer


def _mirror_text(
    camera: Camera, points_cm: Float[np.ndarray, "n 2"], pixels_px: Float[np.ndarray, "n 2"]
) -> str:
    """Say which axis is mirrored: the one without which an upright camera looks ahead."""
    top = camera.height - 1.0
    readings = {
        "x_cm counts to the left, expected to the right": (points_cm * [-1.0, 1.0], pixels_px),
        "y_cm counts backwards, expected ahead": (points_cm * [1.0, -1.0], pixels_px),
        "the columns x_cm and y_cm are swapped": (points_cm[:, ::-1], pixels_px),
        "the columns u_px and v_px are swapped": (points_cm, pixels_px[:, ::-1]),
        "v_px counts upwards, expected downwards from the top": (
            points_cm,
            pixels_px * [1.0, -1.0] + [0.0, top],
        ),
    }
    found: list[tuple[float, float, str]] = []
    for text, (points, pixels) in readings.items():
        inside = (pixels >= -1.0).all() and (pixels <= [camera.width, camera.height]).all()
        if not inside or not np.isfinite(camera.unproject(pixels)).all():
            continue
        answer = fitted_pose(camera, points, pixels)
        mounting = None if answer is None else mounting_from_pose(answer[0])
        if answer is None or mounting is None or mounting.height_cm <= 0.0:
            continue
        errors = np.linalg.norm(pixel_residuals(camera, answer[0], points, pixels), axis=1)
        found.append((float(np.median(errors)), abs(mounting.yaw_rad) + abs(mounting.roll_rad), text))
    least = min((error for error, _, _ in found), default=0.0)
    alike = [(turn, text) for error, turn, text in found if error <= _ALIKE_RATIO * least + _ALIKE_PX]
    turn, text = min(alike, default=(np.inf, ""))
    if turn > _MAX_TURN_RAD:
        text = "expected x_cm to the right and y_cm ahead of the car, u_px to the right and v_px downwards"
    return f"the points are mirrored, they fit only a camera below the ground: {text}"


def _sigma(
    camera: Camera,
    points_cm: Float[np.ndarray, "n 2"],
    residuals_px: Float[np.ndarray, "n 2"],
    weights: Float[np.ndarray, "n 2 2"],
) -> dict[str, float]:
    """Standard deviation of each number of the mounting, from the spread of the weighted residuals."""
    names = [field.name for field in fields(Mounting)]
    columns = []
    for name in names:
        value, step = getattr(camera.mounting, name), 1e-4
        ends = [camera.with_mounting(**{name: value + s}).project_ground(points_cm) for s in (step, -step)]
        columns.append(np.einsum("nij,nj->ni", weights, ends[0] - ends[1]).ravel() / (2.0 * step))
    jacobian = np.stack(columns, axis=1)
    if not np.isfinite(jacobian).all():
        return dict.fromkeys(names, float("inf"))
    freedom = max(jacobian.shape[0] - jacobian.shape[1], 1)
    weighted = np.einsum("nij,nj->ni", weights, residuals_px)
    spread = max(float(np.sqrt(np.sum(weighted**2) / freedom)), 0.05)
    sizes = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-12)
    _, singular, rows = np.linalg.svd(jacobian / sizes, full_matrices=False)
    variance = np.sum((rows / np.maximum(singular, 1e-12)[:, None]) ** 2, axis=0)
    return dict(zip(names, (spread * np.sqrt(variance) / sizes).tolist(), strict=True))


def _check_answer(answer: GroundCalibration) -> None:
    camera, mounting = answer.camera, answer.camera.mounting
    if mounting.height_cm < _LEAST_HEIGHT_CM:
        raise CalibrationError(
            f"the camera would be {mounting.height_cm:.2g} cm above the ground; are the points in "
            "centimetres?"
        )
    limit = _MAX_RMS_SHARE * camera.width
    if 2 * answer.used.sum() < len(answer.used) + 1 or not answer.rms_px <= limit:
        raise CalibrationError(
            f"the points contradict each other or the lens: {answer.used.sum()} of {len(answer.used)} used, "
            f"{answer.rms_px:.4g} px off (RMS); expected more than half, and at most {limit:.1f} px"
        )
    if abs(mounting.yaw_rad) > _MAX_YAW_RAD and mounting.pitch_down_rad < _DOWN_RAD:
        side, turn = "left" if mounting.yaw_rad > 0.0 else "right", abs(np.rad2deg(mounting.yaw_rad))
        raise CalibrationError(
            f"the camera would look backwards, {turn:.0f} degrees to the {side}: the points lie behind "
            "the car; expected x_cm to the right and y_cm ahead of it (do both have the wrong sign?)"
        )
    height_sigma = answer.sigma["height_cm"] / mounting.height_cm
    if not height_sigma < _MAX_HEIGHT_SIGMA:
        raise CalibrationError(
            f"the points leave the height open to {100.0 * height_sigma:.0f} % (found "
            f"{mounting.height_cm:.1f} cm); spread them further over the ground, also sideways"
        )
