"""Where a flat pattern lies before the lens: from rays at once, for rays in any direction."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float

from lanenet.geometry.camera import Mounting

_MIN_POINTS = 4


def rotation_from_vector(vector_rad: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation about ``vector_rad`` by its length, [rad]."""
    return np.asarray(cv2.Rodrigues(vector_rad)[0])


def vector_from_rotation(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3"]:
    """Return the rotation vector, [rad], of length up to pi; inverse of :func:`rotation_from_vector`."""
    return np.asarray(cv2.Rodrigues(rotation)[0]).ravel()


def moved_points(
    pose: Float[np.ndarray, "6"], points: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 6"]]:
    """Move points by a pose (rotation vector, translation), with the derivatives by the pose."""
    rotation, by_vector = cv2.Rodrigues(pose[:3])
    derivatives = np.empty((len(points), 3, 6))
    # OpenCV's derivative has a row per component of the vector and a column per entry of the matrix.
    derivatives[:, :, :3] = np.einsum("kij,nj->nik", np.asarray(by_vector).reshape(3, 3, 3), points)
    derivatives[:, :, 3:] = np.eye(3)
    return points @ rotation.T + pose[3:], derivatives


def plane_points(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    """Return points of a board or of the ground with their z, which is 0."""
    return np.concatenate([points, np.zeros((len(points), 1))], axis=1)


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
    crosses = np.zeros((len(rays), 3, 3))
    x, y, z = rays.T
    crosses[:, 0, 1], crosses[:, 0, 2] = -z, y
    crosses[:, 1, 0], crosses[:, 1, 2] = z, -x
    crosses[:, 2, 0], crosses[:, 2, 1] = -y, x
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
