"""A camera over a flat road for the loops of the bundle adjustment: pixel to road, and back with all slopes.

Lengths are in camera heights. A camera is two vectors here: ``lens`` = fx, fy, cx, cy, D (five numbers) and
``mount`` = pitch, roll, yaw, camera ahead of the rear axle, camera left of the middle; the kernels take the
mount as a ``view`` (see :func:`set_view`).

numba's cache notices a change of the file that a function stands in, and not of one that it calls into: after
a change here delete ``datagen/slam/__pycache__``.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

#: Numbers of the camera that can be adjusted: focal length (relative), cx, cy, k1, pitch, roll, yaw, lever.
N_CAMERA = 8
#: Length of a view.
N_VIEW = 8
_NEWTON_STEPS = 8
_CONVERGED = 1e-13


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def set_view(mount, pitch_more, roll_more, view):
    """Fill a view: cosine and sine of pitch, roll and yaw in one frame, then lever and left."""
    pitch, roll = mount[0] + pitch_more, mount[1] + roll_more
    view[0], view[1] = np.cos(pitch), np.sin(pitch)
    view[2], view[3] = np.cos(roll), np.sin(roll)
    view[4], view[5] = np.cos(mount[2]), np.sin(mount[2])
    view[6], view[7] = mount[3], mount[4]


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def lift_pixel(fisheye, lens, view, u, v):
    """Road point (ahead of the rear axle, left) of a pixel; the ray must meet the road, or both are NaN."""
    mx, my = (u - lens[2]) / lens[0], (v - lens[3]) / lens[1]
    k1, k2, k3, k4, k5 = lens[4], lens[5], lens[6], lens[7], lens[8]
    if fisheye:
        radius = np.sqrt(mx * mx + my * my)
        theta = radius
        for _ in range(_NEWTON_STEPS):
            t2 = theta * theta
            error = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) - radius
            slope = 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)))
            step = error / max(slope, 0.1)
            theta -= step
            if abs(step) < _CONVERGED:
                break
        scale = np.sin(theta) / radius if radius > 1e-12 else 1.0
        x, y, z = mx * scale, my * scale, np.cos(theta)
    else:
        x, y = mx, my
        for _ in range(_NEWTON_STEPS):
            r2 = x * x + y * y
            radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k5))
            dx = 2.0 * k3 * x * y + k4 * (r2 + 2.0 * x * x)
            dy = k3 * (r2 + 2.0 * y * y) + 2.0 * k4 * x * y
            x, y = (mx - dx) / radial, (my - dy) / radial
        z = 1.0
    # Undo roll, then pitch; camera y down and z ahead become up and ahead; then yaw.
    x, y = view[2] * x - view[3] * y, view[3] * x + view[2] * y
    down, ahead = view[0] * y + view[1] * z, view[0] * z - view[1] * y
    if down <= 1e-6:
        return np.nan, np.nan
    ahead, right = ahead / down, x / down
    return view[6] + ahead * view[4] + right * view[5], view[7] + ahead * view[5] - right * view[4]


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def _distorted(fisheye, lens, x, y, z):
    """A point of the camera's frame in the image, before focal length and centre; NaN behind a pinhole.

    Returns:
        The two numbers; the slopes of the first by x, y and z; those of the second; both slopes by k1.
    """
    k1, k2, k3, k4, k5 = lens[4], lens[5], lens[6], lens[7], lens[8]
    if fisheye:
        r2 = x * x + y * y
        r, norm2 = np.sqrt(r2), r2 + z * z
        theta = np.arctan2(r, z)
        t2 = theta * theta
        slope = 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)))
        # Radius in the image per radius in the camera's frame, and how that changes; on the axis 1 / z.
        s, bend, by_k1 = 1.0 / z, 0.0, 0.0
        if r > 1e-9:
            s = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) / r
            bend = (slope * z / norm2 - s) / r2
            by_k1 = theta * t2 / r
        by_z = -slope / norm2
        cross = x * y * bend
        return (
            x * s, y * s,
            s + x * x * bend, cross, x * by_z,
            cross, s + y * y * bend, y * by_z,
            x * by_k1, y * by_k1,
        )  # fmt: skip
    if z <= 1e-6:
        none = np.nan
        return none, none, none, none, none, none, none, none, none, none
    a, b = x / z, y / z
    r2 = a * a + b * b
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k5))
    bend = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k5))
    cross = a * b * bend + 2.0 * (k3 * a + k4 * b)
    p_a = radial + a * a * bend + 2.0 * k3 * b + 6.0 * k4 * a
    q_b = radial + b * b * bend + 6.0 * k3 * b + 2.0 * k4 * a
    return (
        a * radial + 2.0 * k3 * a * b + k4 * (r2 + 2.0 * a * a),
        b * radial + k3 * (r2 + 2.0 * b * b) + 2.0 * k4 * a * b,
        p_a / z, cross / z, -(p_a * a + cross * b) / z,
        cross / z, q_b / z, -(cross * a + q_b * b) / z,
        a * r2, b * r2,
    )  # fmt: skip


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def _in_camera(view, forward, left):
    """A road point in the camera's frame, turned by yaw, pitch and roll; one camera height below it."""
    a, b = forward - view[6], left - view[7]
    ahead, right = a * view[4] + b * view[5], a * view[5] - b * view[4]
    down, z = view[0] - view[1] * ahead, view[1] + view[0] * ahead
    x, y = view[2] * right + view[3] * down, view[2] * down - view[3] * right
    return x, y, z, ahead, right, down


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def project_point(fisheye, lens, view, forward, left):
    """Pixel of a road point (ahead of the rear axle, left); NaN behind a pinhole."""
    x, y, z, _, _, _ = _in_camera(view, forward, left)
    seen = _distorted(fisheye, lens, x, y, z)
    return lens[2] + lens[0] * seen[0], lens[3] + lens[1] * seen[1]


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def project_with_slopes(fisheye, lens, view, forward, left, by):
    """Pixel of a road point, and its slopes.

    Args:
        fisheye: Lens model.
        lens: See the module.
        view: See :func:`set_view`.
        forward: Ahead of the rear axle.
        left: Of the middle.
        by: 2 x (2 + ``N_CAMERA``), filled: slopes of u and of v by forward and left, then by the camera's
            numbers.
    """
    cp, sp, cr, sr, cy, sy = view[0], view[1], view[2], view[3], view[4], view[5]
    x, y, z, ahead, right, down = _in_camera(view, forward, left)
    seen = _distorted(fisheye, lens, x, y, z)
    for k in range(2):
        scale = lens[k]
        g_x, g_y, g_z = scale * seen[2 + 3 * k], scale * seen[3 + 3 * k], scale * seen[4 + 3 * k]
        # By a point ahead and to the right of the lens; both tilts move what is below the lens.
        g_down = sr * g_x + cr * g_y
        g_ahead, g_right = cp * g_z - sp * g_down, cr * g_x - sr * g_y
        by[k, 0] = g_ahead * cy + g_right * sy
        by[k, 1] = g_ahead * sy - g_right * cy
        by[k, 2] = scale * seen[k]
        by[k, 3] = 1.0 - k
        by[k, 4] = k
        by[k, 5] = scale * seen[8 + k]
        by[k, 6] = g_z * down - g_down * z
        by[k, 7] = g_x * y - g_y * x
        by[k, 8] = g_right * ahead - g_ahead * right
        by[k, 9] = -by[k, 0]
    return lens[2] + lens[0] * seen[0], lens[3] + lens[1] * seen[1]
