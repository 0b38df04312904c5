"""The pose of a camera above points of the ground, whose pixels and places both have errors."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from lanenet.calibration.ground_points import MIN_POINTS
from lanenet.calibration.lens import N_DISTORTION, project_points
from lanenet.calibration.pose import moved_points, plane_points, pose_of_plane, rotation_from_vector
from lanenet.errors import CalibrationError
from lanenet.geometry.camera import Camera

#: How well a pixel is clicked, [px], and a point is laid out on the ground, as a share of the points' extent:
#: 2.5 mm on 80 cm of floor. Near the car a pixel is worth a millimetre, so that fitted in pixels alone the
#: near points would decide, by how well they were laid out.
_PIXEL_SIGMA_PX, _GROUND_SIGMA_SHARE = 0.5, 0.003
_ROBUST_SCALE_PX = 1.0
_WEIGHTINGS = 2
#: A point is left out beyond this multiple of the others' spread, and beyond the floor (weighted pixels).
_OUTLIER_RATIO, _OUTLIER_FLOOR_PX = 5.0, 2.0
_SUBSET, _MAX_STARTS = 4, 60


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
    return (
        pixels_px
        - project_points(camera.model, _lens(camera), moved_points(pose, plane_points(points_cm))[0])[0]
    )


def residual_weights(
    camera: Camera, pose: Float[np.ndarray, "6"], points_cm: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 2 2"]:
    """Return the matrices that turn residuals into ones of equal spread, that of a clicked pixel."""
    moved = moved_points(pose, plane_points(points_cm))[0]
    by_ground = project_points(camera.model, _lens(camera), moved)[1] @ rotation_from_vector(pose[:3])[:, :2]
    ground_sigma_cm = _GROUND_SIGMA_SHARE * float(np.linalg.norm(np.ptp(points_cm, axis=0)))
    # In front of the lens a point may move the image without limit; a finite weight is enough.
    by_error = np.clip(by_ground * (ground_sigma_cm / _PIXEL_SIGMA_PX), -1e6, 1e6)
    return np.linalg.inv(np.linalg.cholesky(np.eye(2) + by_error @ by_error.transpose(0, 2, 1)))


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
        moved = moved_points(pose, plane_points(points_cm))[0]
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

    lens, solid = _lens(camera), plane_points(points_cm[used])

    def jacobian(pose: Float[np.ndarray, "6"]) -> Float[np.ndarray, "m 6"]:
        points, by_pose = moved_points(pose, solid)
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
