"""Inner loops of the bundle adjustment: points on the road, nearest edges, normal equations.

Lengths are in camera heights; a camera is ``lens`` and ``mount`` as in :mod:`datagen.slam.lens_kernels`.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from datagen.slam.lens_kernels import (
    N_CAMERA,
    N_VIEW,
    lift_pixel,
    project_point,
    project_with_slopes,
    set_view,
)

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
