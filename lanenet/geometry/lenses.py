"""The fisheye lens of Kannala and Brandt (2006, eq. 6), with the four terms of OpenCV's ``fisheye``.

The pinhole lens with the distortion of Brown and Conrady, in OpenCV's order of coefficients.
"""

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


def _coefficients(D: Float[np.ndarray, "_"]) -> tuple[float, float, float, float, float]:
    k1, k2, p1, p2, k3 = (float(v) for v in np.concatenate([D, np.zeros(5)])[:5])
    return k1, k2, p1, p2, k3


def pinhole_radius(r: Float[np.ndarray, "*n"], D: Float[np.ndarray, "_"]) -> Float[np.ndarray, "*n"]:
    """Return what distortion, but for its tangential part, makes of a radius; both in focal lengths."""
    k1, k2, _, _, k3 = _coefficients(D)
    r2 = r * r
    return r * (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3)))


def distort_pinhole(xy: Float[np.ndarray, "n 2"], D: Float[np.ndarray, "_"]) -> Float[np.ndarray, "n 2"]:
    """Return where points of the image without distortion go, both in focal lengths.

    Args:
        xy: Points x, y, without distortion.
        D: Coefficients k1, k2, p1, p2, k3; those that are not there are zero.
    """
    k1, k2, p1, p2, k3 = _coefficients(D)
    x, y = xy[:, 0], xy[:, 1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ],
        axis=1,
    )


def invert_pinhole(target: Float[np.ndarray, "n 2"], D: Float[np.ndarray, "_"]) -> Float[np.ndarray, "n 2"]:
    """Return the points that :func:`distort_pinhole` sends to the target ones.

    By damped Newton steps with a numerical Jacobian; where they do not converge the answer is not one that
    projects back.
    """
    xy = target.copy()
    if not np.any(D):
        return xy
    eps = 1e-7
    for _ in range(_NEWTON_STEPS):
        base = distort_pinhole(xy, D)
        dx = (distort_pinhole(xy + [eps, 0.0], D) - base) / eps
        dy = (distort_pinhole(xy + [0.0, eps], D) - base) / eps
        error = base - target
        det = dx[:, 0] * dy[:, 1] - dx[:, 1] * dy[:, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            step = np.stack(
                [
                    (dy[:, 1] * error[:, 0] - dy[:, 0] * error[:, 1]) / det,
                    (dx[:, 0] * error[:, 1] - dx[:, 1] * error[:, 0]) / det,
                ],
                axis=1,
            )
        length = np.linalg.norm(step, axis=1, keepdims=True)
        step *= np.minimum(1.0, 0.5 / np.maximum(length, 1e-12))
        xy = xy - np.nan_to_num(step)
    return xy
