"""What a wrongly known mounting of the camera does to points of the road, compiled."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def misplace(x, y, camera_x, camera_y, camera_z, height, pitch, roll):
    """Answer where a point of the road seems to lie when the camera's mounting is known wrongly.

    See :func:`lanenet.learn.augment.misplaced`.
    """
    # The ray in the level frame of the car, as the wrong mounting turns it: first pitch, then roll.
    dx, dy, dz = x - camera_x, y - camera_y, -camera_z
    c, s = np.cos(pitch), np.sin(pitch)
    dy, dz = c * dy + s * dz, c * dz - s * dy
    c, s = np.cos(roll), np.sin(roll)
    dx, dz = c * dx + s * dz, c * dz - s * dx
    if not dz < 0.0:
        return np.nan, np.nan
    way = -height * camera_z / dz
    return camera_x + dx * way, camera_y + dy * way


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def misplace_points(points_cm, camera_cm, height, pitch, roll, out):
    """Do :func:`misplace` for many points of one camera."""
    right, ahead, up = camera_cm
    for k in range(len(points_cm)):
        x, y = points_cm[k]
        out[k, 0], out[k, 1] = misplace(x, y, right, ahead, up, height, pitch, roll)
