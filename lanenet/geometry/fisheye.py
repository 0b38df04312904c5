"""The fisheye lens of Kannala and Brandt (2006, eq. 6), with the four terms of OpenCV's ``fisheye``."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

_NEWTON_STEPS = 30
#: Newton's method squares its error: after a step as short as this there is nothing left to gain.
_LAST_STEP_RAD = 1e-12


def fisheye_radius(angle_rad: Float[np.ndarray, "*n"], D: Float[np.ndarray, "_"]) -> Float[np.ndarray, "*n"]:
    """Return how far from the optical axis a ray meets the image, in focal lengths.

    Args:
        angle_rad: Angle between ray and optical axis, [rad].
        D: Coefficients k1 to k4.
    """
    t2 = angle_rad * angle_rad
    return angle_rad * (1.0 + t2 * (D[0] + t2 * (D[1] + t2 * (D[2] + t2 * D[3]))))


def fisheye_slope(angle_rad: Float[np.ndarray, "*n"], D: Float[np.ndarray, "_"]) -> Float[np.ndarray, "*n"]:
    """Return the derivative of :func:`fisheye_radius` by the angle."""
    t2 = angle_rad * angle_rad
    return 1.0 + t2 * (3.0 * D[0] + t2 * (5.0 * D[1] + t2 * (7.0 * D[2] + t2 * 9.0 * D[3])))


def invert_fisheye(
    radius: Float[np.ndarray, "*n"], D: Float[np.ndarray, "_"], max_angle_rad: float
) -> Float[np.ndarray, "*n"]:
    """Return the angle from the optical axis, [rad], that has a radius; NaN where none up to the largest has.

    The radius grows up to there, so that Newton's method, kept in a bracket, converges.
    """
    low = np.zeros_like(radius)
    high = np.full_like(radius, max_angle_rad)
    angle_rad = np.clip(radius, 0.0, max_angle_rad)
    seen = radius <= fisheye_radius(np.array([max_angle_rad]), D)
    for _ in range(_NEWTON_STEPS):
        error = fisheye_radius(angle_rad, D) - radius
        low = np.where(error < 0.0, angle_rad, low)
        high = np.where(error > 0.0, angle_rad, high)
        slope = fisheye_slope(angle_rad, D)
        with np.errstate(divide="ignore", invalid="ignore"):
            step = angle_rad - error / slope
        inside = (step >= low) & (step <= high)
        before, angle_rad = angle_rad, np.where(inside, step, 0.5 * (low + high))
        if np.max(np.abs(angle_rad - before), where=seen, initial=0.0) <= _LAST_STEP_RAD:
            break
    return np.where(seen, angle_rad, np.nan)
