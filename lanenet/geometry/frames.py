"""The frames of reference and the signs, once for the whole project.

========  ==================================================================================
frame     definition
========  ==================================================================================
image     pixels, u to the right, v down, pixel centres at integers
camera    x right, y down, z along the optical axis, [cm]
car       origin on the ground under the centre of the front axle, **x right, y ahead**, z up, [cm]
map       right-handed on the ground, heading counter-clockwise from +x, [cm], [rad]
========  ==================================================================================

::

          y ahead                      map y
            ^                            ^    / heading
            |                            |   /
      ------+------> x right             |  o rear axle = pose
       front axle                        +--------> map x

A pose is the **rear-axle centre** in the map (REP 103, Ackermann model of Kozlowski et al., eq. 4-6).
Steering and yaw rate are **positive to the left**. Donkeycar's angle is -1 for full left.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def wrap_angle(angle_rad: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Wrap angles into (-pi, pi], [rad]."""
    wrapped = np.pi - np.mod(np.pi - np.asarray(angle_rad, dtype=np.float64), 2.0 * np.pi)
    # Rounding may reach the open end.
    return np.asarray(np.where(wrapped <= -np.pi, np.pi, wrapped))


def map_from_car(
    points_car_cm: Float[np.ndarray, "n 2"], pose: Float[np.ndarray, "3"], wheelbase_cm: float
) -> Float[np.ndarray, "n 2"]:
    """Move points from the car frame to the map.

    Args:
        points_car_cm: Ground points, [cm], frame car.
        pose: Rear-axle centre x, y and heading, [cm], [cm], [rad], frame map.
        wheelbase_cm: Distance between the axles, [cm].

    Returns:
        The same points, [cm], frame map.

    Source:
        Own derivation; round trip in ``tests/unit/geometry/test_frames.py``.
    """
    forward = points_car_cm[:, 1] + wheelbase_cm
    right = points_car_cm[:, 0]
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.stack([pose[0] + forward * c + right * s, pose[1] + forward * s - right * c], axis=1)


def car_from_map(
    points_map_cm: Float[np.ndarray, "*n 2"], pose: Float[np.ndarray, "*#n 3"], wheelbase_cm: float
) -> Float[np.ndarray, "*n 2"]:
    """Move points from the map to the car frame of one pose, or each of its own; see :func:`map_from_car`."""
    dx = points_map_cm[..., 0] - pose[..., 0]
    dy = points_map_cm[..., 1] - pose[..., 1]
    c, s = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    return np.stack([dx * s - dy * c, dx * c + dy * s - wheelbase_cm], axis=-1)


def map_from_car_directions(
    directions_car: Float[np.ndarray, "n 2"], heading_rad: float
) -> Float[np.ndarray, "n 2"]:
    """Rotate direction vectors from the car frame into the map (no translation)."""
    c, s = np.cos(heading_rad), np.sin(heading_rad)
    right, forward = directions_car[:, 0], directions_car[:, 1]
    return np.stack([forward * c + right * s, forward * s - right * c], axis=1)


def left_from_donkey(angle: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Turn Donkeycar's sign (-1 = left) into this project's (positive = left); the gain stays unknown."""
    return -np.asarray(angle)
