"""Where a camera sits on the car: its mounting from points of the ground whose pixels are known.

The points come from a file or from a board on the floor. Both their pixels and their places have errors, and
some points may be wrong altogether.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Bool, Float

from lanenet.calibration.chessboard import Board, BoardView
from lanenet.calibration.lens import (
    N_DISTORTION,
    mounting_from_pose,
    moved_points,
    pose_of_plane,
    project_points,
    rotation_from_vector,
    standard_deviations,
)
from lanenet.errors import CalibrationError
from lanenet.geometry.camera import Camera, Mounting

#: A pose has six numbers, a point gives two; the fourth shows whether they agree.
MIN_POINTS = 4
#: Least width of the points as a share of their length; narrower, they are a line. Chosen: 2 cm on a metre.
_MIN_FLATNESS = 0.02
#: Error of a clicked pixel, [px], and of a point laid out on the ground, as a share of the points' extent
#: (2.5 mm on 80 cm of floor). Near the car a pixel is worth a millimetre: without the second one, near points
#: would decide by how well they were laid out.
_PIXEL_SIGMA_PX, _GROUND_SIGMA_SHARE = 0.5, 0.003
#: Scale of the Cauchy loss; chosen: twice the error of a clicked pixel.
_ROBUST_SCALE_PX = 1.0
#: Fits with weights from the pose before; chosen: the weights change little after the first.
_WEIGHTINGS = 2
#: A point is left out beyond this multiple of the others' spread, and beyond the floor (weighted pixels).
#: Chosen: 5 sigma, and four times the error of a clicked pixel.
_OUTLIER_RATIO, _OUTLIER_FLOOR_PX = 5.0, 2.0
#: Points of a subset, the fewest that give a pose, and most subsets: of ten points with two false ones, 60
#: subsets of four hold one without a false point with a probability above 0.999999.
_SUBSET, _MAX_STARTS = 4, 60
#: A lens lower than this would lie on the road: the points are in metres.
_LEAST_HEIGHT_CM = 1.0
#: Largest believable RMS as a share of the image's width, and largest sigma of the height as a share of it.
#: Chosen: ten times the error of careful clicks at 320 px, and 3 cm at 20 cm.
_MAX_RMS_SHARE, _MAX_HEIGHT_SIGMA = 0.02, 0.15
#: Beyond this yaw a camera does not look ahead, unless it looks straight down, where yaw means nothing.
_MAX_YAW_RAD, _DOWN_RAD = float(np.deg2rad(90.0)), float(np.deg2rad(80.0))
#: Mirrored or swapped axes are named if points read that way fit about as well as the best reading (ratio and
#: pixels) and leave the camera upright and looking ahead within this angle. Chosen.
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
        columns.append(_weighted(ends[0] - ends[1], weights).ravel() / (2.0 * step))
    jacobian = np.stack(columns, axis=1)
    if not np.isfinite(jacobian).all():
        return dict.fromkeys(names, float("inf"))
    sigma = standard_deviations(jacobian, _weighted(residuals_px, weights).ravel())
    return dict(zip(names, sigma.tolist(), strict=True))


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


def points_of_floor_board(
    view: BoardView, board: Board, near_left_cm: tuple[float, float]
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
    """Turn a board that lies on the floor, its edges along the car's axes, into ground points.

    Args:
        view: The board as the camera saw it, upright: what is ahead is higher in the image.
        board: The board.
        near_left_cm: Its inner corner nearest to the car on the left, frame car.

    Returns:
        Ground points, [cm], frame car, and their pixels.

    Raises:
        CalibrationError: If the board is cut off, or turned so far that its sides cannot be distinguished.
    """
    if not view.complete:
        raise CalibrationError(f"{view.name}: the board on the floor is cut off, expected all its corners")
    grid = view.corners_px.reshape(board.rows, board.columns, 2)
    along = (grid[:, -1] - grid[:, 0]).mean(axis=0)
    if abs(along[0]) < abs(along[1]):
        grid = grid.transpose(1, 0, 2)
    if (grid[:, -1] - grid[:, 0]).mean(axis=0)[0] < 0.0:
        grid = grid[:, ::-1]
    if (grid[-1] - grid[0]).mean(axis=0)[1] > 0.0:
        grid = grid[::-1]
    right, ahead = (grid[:, -1] - grid[:, 0]).mean(axis=0), (grid[-1] - grid[0]).mean(axis=0)
    if abs(right[0]) < 1.5 * abs(right[1]) or abs(ahead[1]) < 0.5 * abs(ahead[0]):
        raise CalibrationError(
            f"{view.name}: the board is turned, expected its edges along and across the car"
        )
    y, x = np.mgrid[: grid.shape[0], : grid.shape[1]]
    steps = np.stack([x.ravel(), y.ravel()], axis=1) * board.square_cm
    return np.array(near_left_cm) + steps, grid.reshape(-1, 2).copy()


def check_points(
    camera: Camera, points_cm: Float[np.ndarray, "n 2"], pixels_px: Float[np.ndarray, "m 2"]
) -> None:
    """Refuse points from which no mounting can follow.

    Args:
        camera: The camera with its lens.
        points_cm: Points of the ground, frame car.
        pixels_px: Where the image shows them.

    Raises:
        CalibrationError: If there are too few, one is not finite or outside the image, or they lie on a line.
    """
    if len(points_cm) != len(pixels_px):
        raise CalibrationError(f"{len(points_cm)} ground points but {len(pixels_px)} pixels")
    if len(points_cm) < MIN_POINTS:
        raise CalibrationError(f"{len(points_cm)} ground point(s), expected at least {MIN_POINTS}, better 10")
    both = np.concatenate([points_cm, pixels_px], axis=1)
    bad = np.flatnonzero(~np.isfinite(both).all(axis=1))
    if bad.size:
        raise CalibrationError(f"point {bad[0] + 1}: not finite")
    outside = (pixels_px < -1.0).any(axis=1) | (pixels_px > [camera.width, camera.height]).any(axis=1)
    if outside.any():
        k = int(np.flatnonzero(outside)[0])
        raise CalibrationError(
            f"point {k + 1}: pixel {pixels_px[k, 0]:.1f}, {pixels_px[k, 1]:.1f} is outside the image of "
            f"{camera.width}x{camera.height} px{_swap_hint(camera, points_cm, pixels_px)}"
        )
    for values, what in ((points_cm, "points"), (pixels_px, "pixels")):
        size = np.linalg.svd(values - values.mean(axis=0), compute_uv=False)
        if size[1] < _MIN_FLATNESS * size[0] or size[0] == 0.0:
            raise CalibrationError(f"the {what} lie on one line, expected them spread over the ground")


def _swap_hint(
    camera: Camera, points_cm: Float[np.ndarray, "n 2"], pixels_px: Float[np.ndarray, "n 2"]
) -> str:
    size = [camera.width, camera.height]
    if ((pixels_px[:, ::-1] >= -1.0) & (pixels_px[:, ::-1] <= size)).all():
        return "; are the columns u_px and v_px swapped?"
    if ((points_cm >= -1.0) & (points_cm <= size)).all():
        return "; do the columns x_cm, y_cm hold the pixels, and u_px, v_px the centimetres?"
    return ""


def fitted_pose(
    camera: Camera, points_cm: Float[np.ndarray, "n 2"], pixels_px: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, "6"], Bool[np.ndarray, "n"]] | None:
    """Find the pose of the ground in the camera frame.

    Args:
        camera: The camera with its lens.
        points_cm: Points of the ground.
        pixels_px: Where the image shows them; the lens sees all of these pixels.

    Returns:
        Rotation vector and translation, [rad], [cm], and which points agree with them. None if the points do
        not determine a pose.

    Source:
        Direct start as in Zhang 2000 on rays (from all points, and from subsets against false ones), then
        robust reprojection error, each residual weighted by the covariance that the errors of its pixel and
        of its place on the ground give it (own derivation).
    """
    rays = camera.unproject(pixels_px)
    used = np.ones(len(points_cm), bool)
    plain = np.broadcast_to(np.eye(2), (len(points_cm), 2, 2))
    candidates = [
        _refined(camera, start, points_cm, pixels_px, plain, used) for start in _starts(points_cm, rays)
    ]
    if not candidates:
        return None
    pose = min(candidates, key=lambda candidate: candidate[1])[0]
    for _ in range(_WEIGHTINGS):
        weights = residual_weights(camera, pose, points_cm)
        pose, _ = _refined(camera, pose, points_cm, pixels_px, weights, used)
    for _ in range(3):
        weights = residual_weights(camera, pose, points_cm)
        distance = np.linalg.norm(
            _weighted(pixel_residuals(camera, pose, points_cm, pixels_px), weights), axis=1
        )
        spread = 1.4826 * float(np.median(distance[used]))
        now = distance <= max(_OUTLIER_RATIO * spread, _OUTLIER_FLOOR_PX)
        if (now == used).all() or now.sum() < MIN_POINTS:
            break
        used = now
        pose, _ = _refined(camera, pose, points_cm, pixels_px, weights, used)
    return pose, used


def pixel_residuals(
    camera: Camera,
    pose: Float[np.ndarray, "6"],
    points_cm: Float[np.ndarray, "n 2"],
    pixels_px: Float[np.ndarray, "n 2"],
) -> Float[np.ndarray, "n 2"]:
    """Return measured minus projected pixels."""
    return pixels_px - project_points(camera.model, _lens(camera), moved_points(pose, points_cm)[0])[0]


def residual_weights(
    camera: Camera, pose: Float[np.ndarray, "6"], points_cm: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 2 2"]:
    """Return the matrices that turn residuals into ones of equal spread, that of a clicked pixel."""
    moved = moved_points(pose, points_cm)[0]
    by_ground = project_points(camera.model, _lens(camera), moved)[1] @ rotation_from_vector(pose[:3])[:, :2]
    ground_sigma_cm = _GROUND_SIGMA_SHARE * float(np.linalg.norm(np.ptp(points_cm, axis=0)))
    # Close to the lens the derivative has no bound; a finite weight is enough.
    by_error = np.clip(by_ground * (ground_sigma_cm / _PIXEL_SIGMA_PX), -1e6, 1e6)
    return np.linalg.inv(np.linalg.cholesky(np.eye(2) + by_error @ by_error.transpose(0, 2, 1)))


def _starts(
    points_cm: Float[np.ndarray, "n 2"], rays: Float[np.ndarray, "n 3"]
) -> list[Float[np.ndarray, "6"]]:
    """Direct solutions from all points and from evenly chosen subsets."""
    n = len(points_cm)
    subsets: list[Sequence[int]] = [range(n)]
    if n > _SUBSET:
        # A fixed seed: the same points give the same camera.
        rng = np.random.default_rng(0)
        all_subsets = list(itertools.combinations(range(n), _SUBSET)) if n <= 8 else []
        drawn = all_subsets or [tuple(rng.choice(n, _SUBSET, replace=False)) for _ in range(_MAX_STARTS)]
        subsets += drawn[:_MAX_STARTS]
    scored: list[tuple[float, Float[np.ndarray, "6"]]] = []
    for chosen in subsets:
        pose = pose_of_plane(points_cm[list(chosen)], rays[list(chosen)])
        if pose is None:
            continue
        moved = moved_points(pose, points_cm)[0]
        directions = moved / np.maximum(np.linalg.norm(moved, axis=1, keepdims=True), 1e-12)
        angles = np.linalg.norm(np.cross(directions, rays), axis=1) + (
            np.sum(directions * rays, axis=1) < 0.0
        )
        scored.append((float(np.sum(np.minimum(angles, 0.1))), pose))
    scored.sort(key=lambda item: item[0])
    return [pose for _, pose in scored[:4]]


def _refined(
    camera: Camera,
    start: Float[np.ndarray, "6"],
    points_cm: Float[np.ndarray, "n 2"],
    pixels_px: Float[np.ndarray, "n 2"],
    weights: Float[np.ndarray, "n 2 2"],
    used: Bool[np.ndarray, "n"],
) -> tuple[Float[np.ndarray, "6"], float]:
    from scipy.optimize import least_squares

    lens = _lens(camera)

    def jacobian(pose: Float[np.ndarray, "6"]) -> Float[np.ndarray, "m 6"]:
        points, by_pose = moved_points(pose, points_cm[used])
        return (weights[used] @ project_points(camera.model, lens, points)[1] @ by_pose).reshape(-1, 6)

    def residuals(pose: Float[np.ndarray, "6"]) -> Float[np.ndarray, "m"]:
        errors = pixel_residuals(camera, pose, points_cm[used], pixels_px[used])
        return -_weighted(errors, weights[used]).ravel()

    result = least_squares(
        residuals,
        start,
        jacobian,
        x_scale="jac",
        loss="cauchy",
        f_scale=_ROBUST_SCALE_PX,
        max_nfev=200,
    )
    return np.asarray(result.x), float(result.cost)


def _weighted(
    residuals_px: Float[np.ndarray, "n 2"], weights: Float[np.ndarray, "n 2 2"]
) -> Float[np.ndarray, "n 2"]:
    return np.einsum("nij,nj->ni", weights, residuals_px)


def _lens(camera: Camera) -> Float[np.ndarray, "p"]:
    if camera.K[0, 1] != 0.0:
        raise CalibrationError(f"camera: a skew of {camera.K[0, 1]:g} px, expected none")
    D = np.concatenate([camera.D, np.zeros(5)])[: N_DISTORTION[camera.model]]
    return np.concatenate([[camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]], D])
