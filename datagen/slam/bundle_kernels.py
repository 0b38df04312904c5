"""Inner loops of the bundle adjustment: pixel to road, road to pixel, nearest edge, normal equations.

Lengths are in camera heights. A camera is two vectors here: ``lens`` = fx, fy, cx, cy, D (five numbers) and
``mount`` = pitch, roll, yaw, camera ahead of the rear axle, camera left of the middle. All in one file:
numba's cache does not notice a change of a callee that lives in another file.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

#: Numbers of the camera that can be adjusted: focal length (relative), cx, cy, k1, pitch, roll, yaw, lever.
N_CAMERA = 8
#: Numbers of a frame: x, y, heading, and how far its pitch and roll are from the camera's.
N_FRAME = 5
_NEWTON_STEPS = 8
#: Points that would be drawn out more than this, across their edge, are not moved.
_MAX_STRETCH = 4.0


@njit(cache=True, error_model="numpy", inline="always")
@no_type_check
def _changed(lens, mount, which, amount):
    """Return focal factor, cx, cy, k1 and the mount with one number of the camera changed."""
    f, cx, cy, k1 = 1.0, lens[2], lens[3], lens[4]
    pitch, roll, yaw, lever = mount[0], mount[1], mount[2], mount[3]
    if which == 0:
        f += amount
    elif which == 1:
        cx += amount
    elif which == 2:
        cy += amount
    elif which == 3:
        k1 += amount
    elif which == 4:
        pitch += amount
    elif which == 5:
        roll += amount
    elif which == 6:
        yaw += amount
    elif which == 7:
        lever += amount
    return f, cx, cy, k1, pitch, roll, yaw, lever


@njit(cache=True, error_model="numpy")
@no_type_check
def _lift_pixel(fisheye, lens, mount, u, v, which, amount):
    """Road point (ahead, left) of a pixel; the ray must meet the road, or both are NaN."""
    f, cx, cy, k1, pitch, roll, yaw, lever = _changed(lens, mount, which, amount)
    mx, my = (u - cx) / (f * lens[0]), (v - cy) / (f * lens[1])
    if fisheye:
        radius = np.hypot(mx, my)
        theta = radius
        for _ in range(_NEWTON_STEPS):
            t2 = theta * theta
            error = theta * (1.0 + t2 * (k1 + t2 * (lens[5] + t2 * (lens[6] + t2 * lens[7])))) - radius
            slope = 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * lens[5] + t2 * (7.0 * lens[6] + t2 * 9.0 * lens[7])))
            theta -= error / max(slope, 0.1)
        scale = np.sin(theta) / radius if radius > 1e-12 else 1.0
        x, y, z = mx * scale, my * scale, np.cos(theta)
    else:
        x, y = mx, my
        for _ in range(_NEWTON_STEPS):
            r2 = x * x + y * y
            radial = 1.0 + r2 * (k1 + r2 * (lens[5] + r2 * lens[8]))
            dx = 2.0 * lens[6] * x * y + lens[7] * (r2 + 2.0 * x * x)
            dy = lens[6] * (r2 + 2.0 * y * y) + 2.0 * lens[7] * x * y
            x, y = (mx - dx) / radial, (my - dy) / radial
        z = 1.0
    # Undo roll, then pitch; camera y down and z ahead become up and ahead; then yaw.
    cr, sr = np.cos(roll), np.sin(roll)
    x, y = cr * x - sr * y, sr * x + cr * y
    cp, sp = np.cos(pitch), np.sin(pitch)
    down, ahead = cp * y + sp * z, cp * z - sp * y
    if down <= 1e-6:
        return np.nan, np.nan
    ahead, right = ahead / down, x / down
    cy_, sy_ = np.cos(yaw), np.sin(yaw)
    return lever + ahead * cy_ + right * sy_, mount[4] + ahead * sy_ - right * cy_


@njit(cache=True, error_model="numpy")
@no_type_check
def _project_point(fisheye, lens, mount, forward, left, which, amount):
    """Pixel of a road point (ahead of the rear axle, left); NaN behind a pinhole."""
    f, cx, cy, k1, pitch, roll, yaw, lever = _changed(lens, mount, which, amount)
    cy_, sy_ = np.cos(yaw), np.sin(yaw)
    a, b = forward - lever, left - mount[4]
    ahead, right = a * cy_ + b * sy_, a * sy_ - b * cy_
    cp, sp = np.cos(pitch), np.sin(pitch)
    # One camera height below the camera.
    y, z = cp - sp * ahead, sp + cp * ahead
    cr, sr = np.cos(roll), np.sin(roll)
    x, y = cr * right + sr * y, cr * y - sr * right
    if fisheye:
        r = np.hypot(x, y)
        theta = np.arctan2(r, z)
        t2 = theta * theta
        radius = theta * (1.0 + t2 * (k1 + t2 * (lens[5] + t2 * (lens[6] + t2 * lens[7]))))
        scale = radius / r if r > 1e-12 else 1.0
        x, y = x * scale, y * scale
    else:
        if z <= 1e-6:
            return np.nan, np.nan
        x, y = x / z, y / z
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (lens[5] + r2 * lens[8]))
        dx = 2.0 * lens[6] * x * y + lens[7] * (r2 + 2.0 * x * x)
        dy = lens[6] * (r2 + 2.0 * y * y) + 2.0 * lens[7] * x * y
        x, y = x * radial + dx, y * radial + dy
    return cx + f * lens[0] * x, cy + f * lens[1] * y


@njit(cache=True, error_model="numpy")
@no_type_check
def lift_points(fisheye, lens, mount, tilt, frame, uv, normals, steps, active, out, out_by, out_normal):
    """Lift pixels to the road, with derivatives.

    Args:
        fisheye: Lens model.
        lens: See the module.
        mount: See the module.
        tilt: Pitch and roll of each frame beyond the camera's.
        frame: Frame of each pixel.
        uv: Pixels.
        normals: Unit gradients in the image.
        steps: Step of the difference for each number of the camera.
        active: Which of them a derivative is wanted for.
        out: (ahead, left) of each pixel.
        out_by: Their derivatives by the camera's numbers.
        out_normal: A point of the road half a pixel further along the gradient.
    """
    m = np.empty(5)
    for p in range(uv.shape[0]):
        m[:] = mount
        m[0] += tilt[frame[p], 0]
        m[1] += tilt[frame[p], 1]
        a, b = _lift_pixel(fisheye, lens, m, uv[p, 0], uv[p, 1], -1, 0.0)
        out[p, 0], out[p, 1] = a, b
        u, v = uv[p, 0] + 0.5 * normals[p, 0], uv[p, 1] + 0.5 * normals[p, 1]
        out_normal[p, 0], out_normal[p, 1] = _lift_pixel(fisheye, lens, m, u, v, -1, 0.0)
        for k in range(N_CAMERA):
            if not active[k]:
                continue
            a1, b1 = _lift_pixel(fisheye, lens, m, uv[p, 0], uv[p, 1], k, steps[k])
            out_by[p, k, 0], out_by[p, k, 1] = (a1 - a) / steps[k], (b1 - b) / steps[k]


@njit(cache=True, error_model="numpy")
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
    width,
    height,
    in_view,
    matched,
    out_point,
    out_edge,
    out_pair,
    out_sigma,
):
    """Find for every point of frame i the nearest edge of frame j that brightens the same way.

    ``out_sigma`` is the standard deviation of the residual to come, in that of an edge's place in its own
    picture: an edge seen far ahead is a wide band where the road is near. ``in_view`` and ``matched`` count
    how often each point fell into the other picture, and met an edge there.

    Returns:
        Number of associations written.
    """
    m = np.empty(5)
    count = 0
    for k in range(pairs.shape[0]):
        i, j = pairs[k, 0], pairs[k, 1]
        m[:] = mount
        m[0] += tilt[j, 0]
        m[1] += tilt[j, 1]
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
                u1, v1 = _project_point(fisheye, lens, m, forward, left, -1, 0.0)
                if end == 0:
                    u, v = u1, v1
                else:
                    nu, nv = u1 - u, v1 - v
            length = np.hypot(nu, nv)
            # The moved point is half a pixel long: how uncertain its place in the other picture is.
            stretch = 2.0 * length
            if not 1e-9 < stretch < _MAX_STRETCH:
                continue
            if 0.0 <= u < width and 0.0 <= v < height:
                in_view[p] += 1
            nu, nv = nu / length, nv / length
            best, chosen = gate_px * gate_px, -1
            for q in range(edge_starts[j], edge_starts[j + 1]):
                du, dv = edge_uv[q, 0] - u, edge_uv[q, 1] - v
                d = du * du + dv * dv
                if d < best and edge_normals[q, 0] * nu + edge_normals[q, 1] * nv > min_dot:
                    best, chosen = d, q
            if chosen >= 0:
                matched[p] += 1
                out_point[count], out_edge[count], out_pair[count] = p, chosen, k
                out_sigma[count] = np.sqrt(0.5 * (1.0 + stretch * stretch))
                count += 1
    return count


@njit(cache=True, error_model="numpy")
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
    steps,
    active,
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
    m = np.empty(5)
    jac = np.empty(2 * N_FRAME + N_CAMERA)
    n = jac.shape[0]
    cost = 0.0
    for k in range(pairs.shape[0]):
        i, j = pairs[k, 0], pairs[k, 1]
        m[:] = mount
        m[0] += tilt[j, 0]
        m[1] += tilt[j, 1]
        ci, si = np.cos(poses[i, 2]), np.sin(poses[i, 2])
        cj, sj = np.cos(poses[j, 2]), np.sin(poses[j, 2])
        for r in range(pair_starts[k], pair_starts[k + 1]):
            p, q = points[r], edges[r]
            a, b = lifted[p, 0], lifted[p, 1]
            dx = poses[i, 0] + ci * a - si * b - poses[j, 0]
            dy = poses[i, 1] + si * a + ci * b - poses[j, 1]
            forward, left = cj * dx + sj * dy, cj * dy - sj * dx
            u, v = _project_point(fisheye, lens, m, forward, left, -1, 0.0)
            nu, nv = edge_normals[q, 0], edge_normals[q, 1]
            e = (u - edge_uv[q, 0]) * nu + (v - edge_uv[q, 1]) * nv
            if not np.isfinite(e):
                residual[r] = np.nan
                continue
            residual[r] = e
            s = e / (link_sigma[r] * cauchy_px)
            cost += 0.5 * point_weight[p] * cauchy_px * cauchy_px * np.log1p(s * s)
            w = point_weight[p] / ((1.0 + s * s) * link_sigma[r] * link_sigma[r])
            h = 1e-4
            u1, v1 = _project_point(fisheye, lens, m, forward + h, left, -1, 0.0)
            g_f = ((u1 - u) * nu + (v1 - v) * nv) / h
            u1, v1 = _project_point(fisheye, lens, m, forward, left + h, -1, 0.0)
            g_l = ((u1 - u) * nu + (v1 - v) * nv) / h
            # By a point of the map, and by the point in the frame i.
            g_x, g_y = g_f * cj - g_l * sj, g_f * sj + g_l * cj
            g_a, g_b = g_x * ci + g_y * si, g_y * ci - g_x * si
            jac[0], jac[1] = g_x, g_y
            jac[2] = g_x * (-si * a - ci * b) + g_y * (ci * a - si * b)
            jac[3] = g_a * lifted_by[p, 4, 0] + g_b * lifted_by[p, 4, 1]
            jac[4] = g_a * lifted_by[p, 5, 0] + g_b * lifted_by[p, 5, 1]
            jac[5], jac[6] = -g_x, -g_y
            jac[7] = g_f * left - g_l * forward
            for c in range(N_CAMERA):
                if not active[c]:
                    jac[2 * N_FRAME + c] = 0.0
                    continue
                u1, v1 = _project_point(fisheye, lens, m, forward, left, c, steps[c])
                direct = ((u1 - u) * nu + (v1 - v) * nv) / steps[c]
                if c == 4:
                    jac[8] = direct
                elif c == 5:
                    jac[9] = direct
                jac[2 * N_FRAME + c] = direct + g_a * lifted_by[p, c, 0] + g_b * lifted_by[p, c, 1]
            for row in range(n):
                wj = w * jac[row]
                rhs[k, row] -= wj * e
                for column in range(row + 1):
                    blocks[k, row, column] += wj * jac[column]
        for row in range(n):
            for column in range(row):
                blocks[k, column, row] = blocks[k, row, column]
    return cost
