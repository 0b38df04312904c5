"""Where a camera sits on the car: its mounting from points of the ground whose pixels are known."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Bool, Float

from lanenet.calibration.chessboard import Board, BoardView
from lanenet.calibration.lens import N_DISTORTION, project_points
from lanenet.calibration.pose import mounting_from_pose, moved_points, pose_of_plane
from lanenet.errors import CalibrationError
from lanenet.geometry.camera import Camera, Mounting

MIN_POINTS = 4
_ROBUST_SCALE_PX = 1.0
#: A point is left out beyond this multiple of the others' spread, and beyond the floor.
_OUTLIER_RATIO, _OUTLIER_FLOOR_PX = 5.0, 2.0
_SUBSET, _MAX_STARTS = 4, 60
#: A lens lower than this would lie on the road: the points are in metres.
_LEAST_HEIGHT_CM = 1.0
_MAX_RMS_SHARE, _MAX_HEIGHT_SIGMA = 0.02, 0.15
#: Narrower than this share of their length, points are a line.
_MIN_FLATNESS = 0.02


@dataclass(frozen=True)
class GroundCalibration:
    """A camera with the mounting that was found.

    Attributes:
        camera: The camera with its new mounting.
        residuals_px: Measured minus projected, per point, those left out included.
        used: Which points were used.
        sigma: Standard deviation of each number of the mounting, in its own unit.
    """

    camera: Camera
    residuals_px: Float[np.ndarray, "n 2"]
    used: Bool[np.ndarray, "n"]
    sigma: dict[str, float]

    @property
    def rms_px(self) -> float:
        """Root mean square distance of the used points."""
        return float(np.sqrt(np.mean(np.sum(self.residuals_px[self.used] ** 2, axis=1))))

    @property
    def residuals(self) -> dict[str, float]:
        """Figures of the fit for the camera file; each name ends in its unit."""
        figures = {
            f"{name.rpartition('_')[0]}_sigma_{name.rpartition('_')[2]}": v for name, v in self.sigma.items()
        }
        return {"ground_rms_px": self.rms_px, "ground_points_count": float(self.used.sum()), **figures}


def calibrate_ground(
    camera: Camera, points_car_cm: Float[np.ndarray, "n 2"], pixels_px: Float[np.ndarray, "n 2"]
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
            what the lens sees, are mirrored, or contradict each other.

    Source:
        Direct start as in Zhang 2000 on rays (from all points, and from subsets against false ones), then
        robust reprojection error.
    """
    _check_points(camera, points_car_cm, pixels_px)
    rays = camera.unproject(pixels_px)
    unseen = np.flatnonzero(~np.isfinite(rays).all(axis=1))
    if unseen.size:
        u, v = pixels_px[unseen[0]]
        raise CalibrationError(f"point {unseen[0] + 1}: the lens sees nothing at pixel {u:.1f}, {v:.1f}")
    everything = np.ones(len(points_car_cm), bool)
    candidates = [
        _fitted(camera, start, points_car_cm, pixels_px, everything) for start in _starts(points_car_cm, rays)
    ]
    if not candidates:
        raise CalibrationError("these points do not determine a mounting: spread them over the ground")
    pose = min(candidates, key=lambda candidate: candidate[1])[0]
    used = everything
    for _ in range(3):
        distance = np.linalg.norm(_residuals(camera, pose, points_car_cm, pixels_px), axis=1)
        spread = 1.4826 * float(np.median(distance[used]))
        now = distance <= max(_OUTLIER_RATIO * spread, _OUTLIER_FLOOR_PX)
        if (now == used).all() or now.sum() < MIN_POINTS:
            break
        used = now
        pose, _ = _fitted(camera, pose, points_car_cm, pixels_px, used)
    result = replace(camera, mounting=mounting_from_pose(pose))
    residuals = _residuals(camera, pose, points_car_cm, pixels_px)
    sigma = _sigma(result, points_car_cm[used], residuals[used])
    answer = GroundCalibration(result, residuals, used, sigma)
    _check_answer(answer)
    return answer


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
        CalibrationError: If the board is cut off, or turned so far that its sides cannot be told apart.
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


def _check_points(
    camera: Camera, points_cm: Float[np.ndarray, "n 2"], pixels_px: Float[np.ndarray, "n 2"]
) -> None:
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
            f"{camera.width}x{camera.height} px"
        )
    for values, what in ((points_cm, "points"), (pixels_px, "pixels")):
        size = np.linalg.svd(values - values.mean(axis=0), compute_uv=False)
        if size[1] < _MIN_FLATNESS * size[0] or size[0] == 0.0:
            raise CalibrationError(f"the {what} lie on one line, expected them spread over the ground")


def _starts(
    points_cm: Float[np.ndarray, "n 2"], rays: Float[np.ndarray, "n 3"]
) -> list[Float[np.ndarray, "6"]]:
    """Direct solutions from all points and from evenly chosen subsets."""
    n = len(points_cm)
    subsets: list[Sequence[int]] = [range(n)]
    if n > _SUBSET:
        # A fixed sequence: the same points give the same camera.
        rng = np.random.default_rng(0)
        all_subsets = list(itertools.combinations(range(n), _SUBSET)) if n <= 8 else []
        drawn = all_subsets or [tuple(rng.choice(n, _SUBSET, replace=False)) for _ in range(_MAX_STARTS)]
        subsets += drawn[:_MAX_STARTS]
    scored: list[tuple[float, Float[np.ndarray, "6"]]] = []
    for chosen in subsets:
        pose = pose_of_plane(points_cm[list(chosen)], rays[list(chosen)])
        if pose is None:
            continue
        moved = moved_points(pose, _solid(points_cm))[0]
        directions = moved / np.maximum(np.linalg.norm(moved, axis=1, keepdims=True), 1e-12)
        angles = np.linalg.norm(np.cross(directions, rays), axis=1) + (
            np.sum(directions * rays, axis=1) < 0.0
        )
        scored.append((float(np.sum(np.minimum(angles, 0.1))), pose))
    scored.sort(key=lambda item: item[0])
    return [pose for _, pose in scored[:4]]


def _fitted(
    camera: Camera,
    start: Float[np.ndarray, "6"],
    points_cm: Float[np.ndarray, "n 2"],
    pixels_px: Float[np.ndarray, "n 2"],
    used: Bool[np.ndarray, "n"],
) -> tuple[Float[np.ndarray, "6"], float]:
    from scipy.optimize import least_squares

    lens, solid = _lens(camera), _solid(points_cm[used])

    def jacobian(pose: Float[np.ndarray, "6"]) -> Float[np.ndarray, "m 6"]:
        points, by_pose = moved_points(pose, solid)
        return (project_points(camera.model, lens, points)[1] @ by_pose).reshape(-1, 6)

    def residuals(pose: Float[np.ndarray, "6"]) -> Float[np.ndarray, "m"]:
        return -_residuals(camera, pose, points_cm[used], pixels_px[used]).ravel()

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


def _residuals(
    camera: Camera,
    pose: Float[np.ndarray, "6"],
    points_cm: Float[np.ndarray, "n 2"],
    pixels_px: Float[np.ndarray, "n 2"],
) -> Float[np.ndarray, "n 2"]:
    moved = moved_points(pose, _solid(points_cm))[0]
    return pixels_px - project_points(camera.model, _lens(camera), moved)[0]


def _sigma(
    camera: Camera, points_cm: Float[np.ndarray, "n 2"], residuals_px: Float[np.ndarray, "n 2"]
) -> dict[str, float]:
    names = [field.name for field in fields(Mounting)]
    columns = []
    for name in names:
        value, step = getattr(camera.mounting, name), 1e-4
        ends = [camera.with_mounting(**{name: value + s}).project_ground(points_cm) for s in (step, -step)]
        columns.append((ends[0] - ends[1]).ravel() / (2.0 * step))
    jacobian = np.stack(columns, axis=1)
    if not np.isfinite(jacobian).all():
        return dict.fromkeys(names, float("inf"))
    freedom = max(jacobian.shape[0] - jacobian.shape[1], 1)
    spread = max(float(np.sqrt(np.sum(residuals_px**2) / freedom)), 0.05)
    sizes = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-12)
    _, singular, rows = np.linalg.svd(jacobian / sizes, full_matrices=False)
    variance = np.sum((rows / np.maximum(singular, 1e-12)[:, None]) ** 2, axis=0)
    return dict(zip(names, (spread * np.sqrt(variance) / sizes).tolist(), strict=True))


def _check_answer(answer: GroundCalibration) -> None:
    camera, mounting = answer.camera, answer.camera.mounting
    if mounting.height_cm <= 0.0:
        raise CalibrationError(
            "the points are mirrored: they fit only a camera below the ground; expected x_cm to the right "
            "and y_cm ahead of the car"
        )
    if mounting.height_cm < _LEAST_HEIGHT_CM:
        raise CalibrationError(
            f"the camera would be {mounting.height_cm:.2g} cm above the ground; are the points in "
            "centimetres?"
        )
    limit = _MAX_RMS_SHARE * camera.width
    if 2 * answer.used.sum() < len(answer.used) + 1 or not answer.rms_px <= limit:
        raise CalibrationError(
            f"the points contradict each other or the lens: {answer.used.sum()} of {len(answer.used)} agree, "
            f"within {answer.rms_px:.1f} px (expected more than half, within {limit:.1f} px)"
        )
    height_sigma = answer.sigma["height_cm"] / mounting.height_cm
    if not height_sigma < _MAX_HEIGHT_SIGMA:
        raise CalibrationError(
            f"the points leave the height open to {100.0 * height_sigma:.0f} % (found "
            f"{mounting.height_cm:.1f} cm); spread them further over the ground, also sideways"
        )


def _solid(points_cm: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    return np.concatenate([points_cm, np.zeros((len(points_cm), 1))], axis=1)


def _lens(camera: Camera) -> Float[np.ndarray, "p"]:
    if camera.K[0, 1] != 0.0:
        raise CalibrationError(f"camera: a skew of {camera.K[0, 1]:g} px, expected none")
    D = np.concatenate([camera.D, np.zeros(5)])[: N_DISTORTION[camera.model]]
    return np.concatenate([[camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]], D])
