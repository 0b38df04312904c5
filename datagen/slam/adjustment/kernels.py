"""Inner loops of the bundle adjustment: points on the road, nearest edges, normal equations.

Lengths are in camera heights. A camera over a flat road is a pair of arrays, ``lens`` and ``mount``.

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


#: Numbers of a frame: x, y, heading, and how far its pitch and roll are from the camera's.
N_FRAME = 5
#: Where pitch and roll stand among the camera's numbers: a frame has its own.
_PITCH, _ROLL = 4, 5
#: Points that would be drawn out more than this, across their edge, are not moved.
_MAX_STRETCH = 4.0


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def lift_points(fisheye, lens, mount, tilt, point_starts, uv, normals, out, out_by, out_normal):
    """Lift pixels to the road, with derivatives.

    Args:
        fisheye: Lens model.
        lens: See the module.
        mount: See the module.
        tilt: Pitch and roll of each frame beyond the camera's.
        point_starts: First pixel of each frame, and one behind the last.
        uv: Pixels.
        normals: Unit gradients in the image.
        out: (ahead, left) of each pixel.
        out_by: Their derivatives by the camera's numbers.
        out_normal: A point of the road half a pixel further along the gradient.
    """
    view, by = np.empty(N_VIEW), np.empty((2, 2 + N_CAMERA))
    for k in range(point_starts.shape[0] - 1):
        set_view(mount, tilt[k, 0], tilt[k, 1], view)
        for p in range(point_starts[k], point_starts[k + 1]):
            a, b = lift_pixel(fisheye, lens, view, uv[p, 0], uv[p, 1])
            out[p, 0], out[p, 1] = a, b
            u, v = uv[p, 0] + 0.5 * normals[p, 0], uv[p, 1] + 0.5 * normals[p, 1]
            out_normal[p, 0], out_normal[p, 1] = lift_pixel(fisheye, lens, view, u, v)
            # The point moves so that its pixel stays.
            project_with_slopes(fisheye, lens, view, a, b, by)
            per_area = 1.0 / (by[0, 0] * by[1, 1] - by[0, 1] * by[1, 0])
            for c in range(N_CAMERA):
                du, dv = by[0, 2 + c], by[1, 2 + c]
                out_by[p, c, 0] = (by[0, 1] * dv - by[1, 1] * du) * per_area
                out_by[p, c, 1] = (by[1, 0] * du - by[0, 0] * dv) * per_area


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def _first_row(edge_uv, start, stop, v):
    """First edge of a frame, whose edges stand in the order of their rows, at or below row v."""
    while start < stop:
        middle = (start + stop) // 2
        if edge_uv[middle, 1] < v:
            start = middle + 1
        else:
            stop = middle
    return start


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def associate(
    fisheye,
    lens,
    mount,
    tilt,
    poses,
    pairs,
    point_starts,
    lifted,
    lifted_normal,
    edge_starts,
    edge_uv,
    edge_normals,
    gate_px,
    min_dot,
    inner,
    in_view,
    matched,
    out_point,
    out_edge,
    out_pair,
    out_sigma,
):
    """Find for every point of frame i the nearest edge of frame j that brightens the same way.

    The edges of each frame stand in the order of their rows. Only what falls into ``inner`` looks for an
    edge: at the rim of what is seen, a point whose edge lies beyond would take one on this side for it, all
    along the rim, and what is seen would seem to stay. ``out_sigma`` is the standard deviation of the
    residual to come, in that of an edge's place in its own picture: an edge seen far ahead is a wide band
    where the road is near. ``in_view`` and ``matched`` count how often each point fell into ``inner`` of the
    other picture, and met an edge there.

    Returns:
        Number of associations written.
    """
    view = np.empty(N_VIEW)
    height, width = inner.shape
    count = 0
    for k in range(pairs.shape[0]):
        i, j = pairs[k, 0], pairs[k, 1]
        set_view(mount, tilt[j, 0], tilt[j, 1], view)
        ci, si = np.cos(poses[i, 2]), np.sin(poses[i, 2])
        cj, sj = np.cos(poses[j, 2]), np.sin(poses[j, 2])
        for p in range(point_starts[i], point_starts[i + 1]):
            u = v = nu = nv = np.nan
            for end in range(2):
                a = lifted[p, 0] if end == 0 else lifted_normal[p, 0]
                b = lifted[p, 1] if end == 0 else lifted_normal[p, 1]
                dx = poses[i, 0] + ci * a - si * b - poses[j, 0]
                dy = poses[i, 1] + si * a + ci * b - poses[j, 1]
                forward, left = cj * dx + sj * dy, cj * dy - sj * dx
                u1, v1 = project_point(fisheye, lens, view, forward, left)
                if end == 0:
                    u, v = u1, v1
                else:
                    nu, nv = u1 - u, v1 - v
            length = np.sqrt(nu * nu + nv * nv)
            # The moved point is half a pixel long: how uncertain its place in the other picture is.
            stretch = 2.0 * length
            if not 1e-9 < stretch < _MAX_STRETCH:
                continue
            if not (0.0 <= u <= width - 1.0 and 0.0 <= v <= height - 1.0):
                continue
            if not inner[int(v + 0.5), int(u + 0.5)]:
                continue
            in_view[p] += 1
            nu, nv = nu / length, nv / length
            best, chosen = gate_px * gate_px, -1
            q, stop = _first_row(edge_uv, edge_starts[j], edge_starts[j + 1], v - gate_px), edge_starts[j + 1]
            while q < stop and edge_uv[q, 1] <= v + gate_px:
                du, dv = edge_uv[q, 0] - u, edge_uv[q, 1] - v
                d = du * du + dv * dv
                if d < best and edge_normals[q, 0] * nu + edge_normals[q, 1] * nv > min_dot:
                    best, chosen = d, q
                q += 1
            if chosen >= 0:
                matched[p] += 1
                out_point[count], out_edge[count], out_pair[count] = p, chosen, k
                out_sigma[count] = np.sqrt(0.5 * (1.0 + stretch * stretch))
                count += 1
    return count


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def accumulate(
    fisheye,
    lens,
    mount,
    tilt,
    poses,
    pairs,
    pair_starts,
    points,
    edges,
    lifted,
    lifted_by,
    edge_uv,
    edge_normals,
    link_sigma,
    point_weight,
    cauchy_px,
    blocks,
    rhs,
    residual,
):
    """Sum the normal equations of all point-to-line residuals, a block per pair of frames.

    The unknowns of a block are frame i (x, y, heading, pitch, roll), frame j, and the camera.

    Returns:
        Robust cost.
    """
    view, by = np.empty(N_VIEW), np.empty((2, 2 + N_CAMERA))
    jac = np.empty(2 * N_FRAME + N_CAMERA)
    n = jac.shape[0]
    cost = 0.0
    for k in range(pairs.shape[0]):
        i, j = pairs[k, 0], pairs[k, 1]
        set_view(mount, tilt[j, 0], tilt[j, 1], view)
        ci, si = np.cos(poses[i, 2]), np.sin(poses[i, 2])
        cj, sj = np.cos(poses[j, 2]), np.sin(poses[j, 2])
        for r in range(pair_starts[k], pair_starts[k + 1]):
            p, q = points[r], edges[r]
            a, b = lifted[p, 0], lifted[p, 1]
            dx = poses[i, 0] + ci * a - si * b - poses[j, 0]
            dy = poses[i, 1] + si * a + ci * b - poses[j, 1]
            forward, left = cj * dx + sj * dy, cj * dy - sj * dx
            u, v = project_with_slopes(fisheye, lens, view, forward, left, by)
            nu, nv = edge_normals[q, 0], edge_normals[q, 1]
            e = (u - edge_uv[q, 0]) * nu + (v - edge_uv[q, 1]) * nv
            if not np.isfinite(e):
                residual[r] = np.nan
                continue
            residual[r] = e
            s = e / (link_sigma[r] * cauchy_px)
            cost += 0.5 * point_weight[p] * cauchy_px * cauchy_px * np.log1p(s * s)
            w = point_weight[p] / ((1.0 + s * s) * link_sigma[r] * link_sigma[r])
            g_f, g_l = nu * by[0, 0] + nv * by[1, 0], nu * by[0, 1] + nv * by[1, 1]
            # By a point of the map, and by the point in the frame i.
            g_x, g_y = g_f * cj - g_l * sj, g_f * sj + g_l * cj
            g_a, g_b = g_x * ci + g_y * si, g_y * ci - g_x * si
            jac[0], jac[1] = g_x, g_y
            jac[2] = g_x * (-si * a - ci * b) + g_y * (ci * a - si * b)
            jac[5], jac[6] = -g_x, -g_y
            jac[7] = g_f * left - g_l * forward
            for c in range(N_CAMERA):
                direct = nu * by[0, 2 + c] + nv * by[1, 2 + c]
                through = g_a * lifted_by[p, c, 0] + g_b * lifted_by[p, c, 1]
                jac[2 * N_FRAME + c] = direct + through
                if c == _PITCH:
                    jac[3], jac[8] = through, direct
                elif c == _ROLL:
                    jac[4], jac[9] = through, direct
            for row in range(n):
                wj = w * jac[row]
                rhs[k, row] -= wj * e
                for column in range(row + 1):
                    blocks[k, row, column] += wj * jac[column]
        for row in range(n):
            for column in range(row):
                blocks[k, column, row] = blocks[k, row, column]
    return cost
