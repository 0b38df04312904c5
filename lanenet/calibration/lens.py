"""A lens as a vector of numbers, with the derivatives that the solver needs.

The vector is fx, fy, cx, cy, then D in OpenCV's order. Projections equal those of
:class:`lanenet.geometry.camera.Camera` (checked in ``tests/unit/calibration/test_lens_and_pose.py``), except
that nothing is cut off at the largest angle, since a solver needs a smooth function. A pose is a rotation
vector and a translation; :func:`pose_of_plane` finds one directly from rays in any direction.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float

from lanenet.geometry.camera import (
    NOMINAL_WHEELBASE_CM,
    Camera,
    CameraModel,
    Mounting,
    fisheye_radius,
    fisheye_slope,
)

#: Numbers in D.
N_DISTORTION: dict[CameraModel, int] = {"fisheye": 4, "pinhole": 5}
N_INTRINSIC = 4
#: Mounting of a lens that has none yet; that of a usual 1:10 car, as in the synthetic drives.
NOMINAL_HEIGHT_CM = 20.0
#: Closer to the axis than this, the azimuth of a ray is rounding error.
_NEAR_AXIS = 1e-9
_NO_MOVE = np.zeros(3)
#: A homography has eight numbers, a point gives two.
_MIN_POINTS = 4


def camera_of_lens(
    model: CameraModel,
    lens: Float[np.ndarray, "p"],
    size_px: tuple[int, int],
    mounting: Mounting | None = None,
    wheelbase_cm: float = NOMINAL_WHEELBASE_CM,
) -> Camera:
    """Return the camera of a lens vector; without a mounting a nominal, level one at 20 cm.

    Args:
        model: Lens model.
        lens: fx, fy, cx, cy, D.
        size_px: Width and height of the image.
        mounting: Pose above the road.
        wheelbase_cm: Distance between the car's axles.
    """
    fx, fy, cx, cy = (float(value) for value in lens[:N_INTRINSIC])
    return Camera(
        model=model,
        width=size_px[0],
        height=size_px[1],
        K=np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]),
        D=np.array(lens[N_INTRINSIC:], dtype=np.float64),
        mounting=Mounting(NOMINAL_HEIGHT_CM) if mounting is None else mounting,
        wheelbase_cm=wheelbase_cm,
    )


def project_points(
    model: CameraModel, lens: Float[np.ndarray, "p"], points: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2 3"], Float[np.ndarray, "n 2 p"]]:
    """Project points of the camera frame, with derivatives.

    Args:
        model: Lens model.
        lens: fx, fy, cx, cy, D.
        points: Positions, frame camera, any unit.

    Returns:
        Pixels, [px]; their derivatives by the points; their derivatives by the lens.

    Source:
        Kannala and Brandt 2006, eq. 6 with four terms (fisheye), as in OpenCV, whose own function ends at 90
        degrees; derivatives: own derivation, checked against differences. Brown-Conrady (pinhole): OpenCV.
    """
    if model == "pinhole":
        # A point at or behind the lens has no image; a least depth keeps the solver's function finite.
        ahead = points.clip([-np.inf, -np.inf, 1e-3], np.inf)
        fx, fy, cx, cy = lens[:N_INTRINSIC]
        matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        found, by_all = cv2.projectPoints(ahead, _NO_MOVE, _NO_MOVE, matrix, lens[N_INTRINSIC:])
        # OpenCV's columns: rotation, translation (as the points), fx, fy, cx, cy, D.
        columns = np.asarray(by_all).reshape(len(points), 2, -1)
        return np.asarray(found).reshape(-1, 2), columns[:, :, 3:6], columns[:, :, 6 : 6 + len(lens)]
    x, y, z = points.T
    r = np.maximum(np.hypot(x, y), _NEAR_AXIS)
    theta = np.arctan2(r, z)
    t2 = theta * theta
    powers = theta[:, None] * np.stack([t2, t2**2, t2**3, t2**4], axis=1)
    D, focal = lens[N_INTRINSIC:], lens[:2]
    radius, slope = fisheye_radius(theta, D), fisheye_slope(theta, D)
    length2 = r * r + z * z
    azimuth = np.stack([x, y], axis=1) / r[:, None]
    scale = radius / r
    d_theta = np.stack([x * z / (r * length2), y * z / (r * length2), -r / length2], axis=1)
    d_r = np.stack([azimuth[:, 0], azimuth[:, 1], np.zeros_like(r)], axis=1)
    d_scale = (slope[:, None] * d_theta - scale[:, None] * d_r) / r[:, None]
    d_points = np.stack([x, y], axis=1)[:, :, None] * d_scale[:, None, :]
    d_points[:, 0, 0] += scale
    d_points[:, 1, 1] += scale
    flat = azimuth * radius[:, None]
    by_lens = np.zeros((len(points), 2, len(lens)))
    by_lens[:, [0, 1], [0, 1]] = flat
    by_lens[:, [0, 1], [2, 3]] = 1.0
    by_lens[:, :, N_INTRINSIC:] = azimuth[:, :, None] * powers[:, None, :] * focal[:, None]
    return flat * focal + lens[2:4], d_points * focal[:, None], by_lens


def rotation_from_vector(vector_rad: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation about ``vector_rad`` by its length, [rad]."""
    return np.asarray(cv2.Rodrigues(vector_rad)[0])


def vector_from_rotation(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3"]:
    """Return the rotation vector, [rad], of length up to pi; inverse of :func:`rotation_from_vector`."""
    return np.asarray(cv2.Rodrigues(rotation)[0]).ravel()


def moved_points(
    pose: Float[np.ndarray, "6"], points: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 6"]]:
    """Move points of a plane, a board or the ground, by its pose (rotation vector, translation).

    Args:
        pose: Of the plane, [rad], [cm], frame camera.
        points: Points of the plane, whose z is 0.

    Returns:
        The points in the camera frame, and their derivatives by the pose.
    """
    rotation, by_vector = cv2.Rodrigues(pose[:3])
    derivatives = np.empty((len(points), 3, 6))
    # OpenCV's derivative has a row per component of the vector and a column per entry of the matrix.
    derivatives[:, :, :3] = np.einsum("kij,nj->nik", np.asarray(by_vector).reshape(3, 3, 3)[..., :2], points)
    derivatives[:, :, 3:] = np.eye(3)
    return points @ rotation[:, :2].T + pose[3:], derivatives


def standard_deviations(
    jacobian: Float[np.ndarray, "r p"], residuals: Float[np.ndarray, "r"]
) -> Float[np.ndarray, "p"]:
    """Return each fitted parameter's sigma, from the spread of the residuals; infinite where undetermined."""
    # Residuals below a twentieth of a pixel come from luck or a rendered board.
    freedom = max(jacobian.shape[0] - jacobian.shape[1], 1)
    spread = max(float(np.sqrt(np.sum(residuals**2) / freedom)), 0.05)
    scale = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-12)
    # The triangle has the Jacobian's singular values and right-hand vectors, at a fraction of the cost.
    _, singular, rows = np.linalg.svd(np.linalg.qr(jacobian / scale, mode="r"), full_matrices=False)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where(singular > 1e-12 * singular[0], 1.0 / singular, np.inf)
        variance = np.nansum((rows * inverse[:, None]) ** 2, axis=0)
    return np.asarray(spread * np.sqrt(variance) / scale)


def pose_of_plane(
    points: Float[np.ndarray, "n 2"], rays: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "6"] | None:
    """Find the pose of a plane from the rays to its points.

    The homography from plane to rays is linear in ``ray x (H point) = 0``, which holds for rays at and past
    90 degrees from the axis as well; its columns are two axes of the plane and its origin.

    Args:
        points: Points of the plane z = 0.
        rays: Their unit rays, frame camera; rows with NaN are left out.

    Returns:
        Rotation vector and translation that take the plane's frame into the camera's. None if the points do
        not determine it.

    Source:
        Zhang 2000, section 3.1, with rays for pixels.
    """
    known = np.isfinite(rays).all(axis=1)
    points, rays = points[known], rays[known]
    if len(points) < _MIN_POINTS:
        return None
    centre = points.mean(axis=0)
    size = float(np.sqrt(np.mean(np.sum((points - centre) ** 2, axis=1))))
    if size <= 0.0:
        return None
    flat = np.concatenate([(points - centre) / size, np.ones((len(points), 1))], axis=1)
    # A ray's cross product with each axis, as columns: times a vector, the cross product with that.
    crosses = np.cross(rays[:, None], np.eye(3)).transpose(0, 2, 1)
    system = np.einsum("nij,nk->nijk", crosses, flat).reshape(-1, 9)
    _, singular, rows = np.linalg.svd(system, full_matrices=False)
    if len(singular) < 9 or singular[7] < 1e-9 * singular[0]:
        return None
    homography = rows[-1].reshape(3, 3)
    if np.sum(rays * (flat @ homography.T)) < 0.0:
        homography = -homography
    lengths = np.linalg.norm(homography[:, :2], axis=0)
    scale = float(np.sqrt(np.prod(lengths)))
    if scale < 1e-12:
        return None
    axes = homography[:, :2] / scale
    left, _, right = np.linalg.svd(np.column_stack([axes, np.cross(axes[:, 0], axes[:, 1])]))
    rotation = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    # In units of ``size``, from the centre of the points.
    translation = size * homography[:, 2] / scale - rotation[:, :2] @ centre
    return np.concatenate([vector_from_rotation(rotation), translation])


def mounting_from_pose(pose: Float[np.ndarray, "6"]) -> Mounting:
    """Return the mounting whose car frame has this pose in the camera frame, [cm]."""
    rotation = rotation_from_vector(pose[:3])
    right_cm, ahead_cm, height_cm = -rotation.T @ pose[3:]
    axis = rotation[2]
    return Mounting(
        height_cm=float(height_cm),
        pitch_down_rad=float(np.arcsin(np.clip(-axis[2], -1.0, 1.0))),
        roll_rad=float(np.arctan2(-rotation[0, 2], -rotation[1, 2])),
        yaw_rad=float(np.arctan2(-axis[0], axis[1])),
        ahead_of_front_axle_cm=float(ahead_cm),
        right_of_centre_cm=float(right_cm),
    )


def pose_from_mounting(mounting: Mounting) -> Float[np.ndarray, "6"]:
    """Return the pose of the car frame in the camera frame, [rad], [cm]."""
    rotation = mounting.camera_from_car
    return np.concatenate([vector_from_rotation(rotation), -rotation @ mounting.position_car_cm])
