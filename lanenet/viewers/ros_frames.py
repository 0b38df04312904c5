"""This project's frames in those of ROS: metres, x ahead, y to the left, z up (REP 103, REP 105).

==================  ==========================================================================
frame               definition
==================  ==========================================================================
``map``             as here, in metres
``base_link``       on the ground under the rear axle's middle, x ahead, y to the left, z up
``camera_optical``  the lens: z along the optical axis, x right, y down
==================  ==========================================================================
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from lanenet.geometry.camera import Camera

MAP, BASE, CAMERA = "map", "base_link", "camera_optical"
_M_PER_CM = 0.01
#: Axes of ``base_link``, as rows, in the car frame: ahead, left, up.
_BASE_FROM_CAR = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def base_from_car_m(points_car_cm: Float[np.ndarray, "n 2"], wheelbase_cm: float) -> Float[np.ndarray, "n 3"]:
    """Move points of the road from the car frame, [cm], to ``base_link``, [m]."""
    ahead = points_car_cm[:, 1] + wheelbase_cm
    return _M_PER_CM * np.stack([ahead, -points_car_cm[:, 0], np.zeros(len(ahead))], axis=1)


def map_m(points_map_cm: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    """Return points of the map in metres."""
    return _M_PER_CM * np.column_stack([points_map_cm, np.zeros(len(points_map_cm))])


def pose_m(pose: Float[np.ndarray, "3"]) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "4"]]:
    """Return position, [m], and orientation (x, y, z, w) of ``base_link`` in the map."""
    half = 0.5 * float(pose[2])
    return map_m(pose[None, :2])[0], np.array([0.0, 0.0, np.sin(half), np.cos(half)])


def camera_in_base_m(camera: Camera) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "4"]]:
    """Return position, [m], and orientation (x, y, z, w) of ``camera_optical`` in ``base_link``."""
    right, ahead, up = camera.mounting.at_cm
    position = _M_PER_CM * np.array([ahead + camera.wheelbase_cm, -right, up])
    return position, quaternion(_BASE_FROM_CAR @ camera.mounting.camera_from_car.T)


def quaternion(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "4"]:
    """Return the unit quaternion (x, y, z, w), w >= 0, of a rotation matrix.

    Source:
        Bar-Itzhack 2000, "New method for extracting the quaternion from a rotation matrix": the eigenvector
        of the largest eigenvalue.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation
    matrix = np.array(
        [
            [xx - yy - zz, yx + xy, zx + xz, zy - yz],
            [yx + xy, yy - xx - zz, zy + yz, xz - zx],
            [zx + xz, zy + yz, zz - xx - yy, yx - xy],
            [zy - yz, xz - zx, yx - xy, xx + yy + zz],
        ]
    )
    found = np.linalg.eigh(matrix)[1][:, -1]
    return np.asarray(found if found[3] >= 0.0 else -found)
