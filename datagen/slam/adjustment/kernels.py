"""Inner loops of the bundle adjustment: points on the road, nearest edges, residuals and Jacobians.

Lengths are in camera heights. A camera is two vectors here: ``lens`` = fx, fy, cx, cy, D (five numbers), and
``mount`` = pitch, roll, yaw, camera ahead of the rear axle, camera left of the middle. Per frame, with its
tilt, the mount becomes a ``view`` (see :func:`set_view`).

numba's cache notices a change of the file that a function is in, but not of one that it calls into: after a
change here delete ``datagen/slam/adjustment/__pycache__``.
"""

from __future__ import annotations

from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float, Int
from numba import njit

#: Adjustable camera parameters: focal length (relative), cx, cy, k1, pitch, roll, yaw, lever.
N_CAMERA = 8
#: Indices of pitch and roll in the camera parameters; each frame adds its own.
_PITCH, _ROLL = 4, 5
#: Numbers of a frame: x, y, heading, and how far its pitch and roll are from the camera's.
N_FRAME = 5
#: Length of a view.
N_VIEW = 8
#: Newton steps that undo a lens, and the step, [rad], at which they end. Four or five are enough for lenses
#: up to 170 degrees; the rest is margin.
_NEWTON_STEPS, _CONVERGED = 8, 1e-13
#: Points whose edge would be wider than this in the other image, relative to their own, are not compared.
#: Chosen: the sigma of their residual would be 2.9 times that of an edge.
_MAX_STRETCH = 4.0
#: Least cosine of the angle between a moved edge and the edge that it meets: 37 degrees. Chosen: wide enough
#: for the error of the first poses, too narrow for the other side of a tape.
_LEAST_COSINE = 0.8


class Pixels(NamedTuple):
    """Edge pixels of all frames.

    Attributes:
        starts: First pixel of each frame, and one behind the last.
        uv: Pixels.
        normals: Unit gradients in the image.
    """

    starts: Int[np.ndarray, "n1"]
    uv: Float[np.ndarray, "m 2"]
    normals: Float[np.ndarray, "m 2"]


class Links(NamedTuple):
    """Which point meets which edge, sorted by pair of frames.

    Attributes:
        point: Compared points.
        edge: The edge that each meets.
        pair: The pair of frames.
        sigma: Sigma of each residual, relative to that of an edge in its own image. A far edge is a wide band
            where the road is near.
    """

    point: Int[np.ndarray, "r"]
    edge: Int[np.ndarray, "r"]
    pair: Int[np.ndarray, "r"]
    sigma: Float[np.ndarray, "r"]


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def set_view(mount, pitch_more, roll_more, view):
    """Fill a view: cosine and sine of one frame's pitch, roll and yaw, then the camera ahead and left."""
    pitch, roll = mount[0] + pitch_more, mount[1] + roll_more
    view[0], view[1] = np.cos(pitch), np.sin(pitch)
    view[2], view[3] = np.cos(roll), np.sin(roll)
    view[4], view[5] = np.cos(mount[2]), np.sin(mount[2])
    view[6], view[7] = mount[3], mount[4]


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def lift_pixel(fisheye, lens, view, u, v):
    """Road point of a pixel (ahead of the rear axle, left); NaN where its ray does not meet the road."""
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
    # Undo roll, then pitch (camera y and z become down and ahead), then yaw.
    x, y = view[2] * x - view[3] * y, view[3] * x + view[2] * y
    down, ahead = view[0] * y + view[1] * z, view[0] * z - view[1] * y
    if down <= 1e-6:
        return np.nan, np.nan
    ahead, right = ahead / down, x / down
    return view[6] + ahead * view[4] + right * view[5], view[7] + ahead * view[5] - right * view[4]


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def _distorted(fisheye, lens, x, y, z):
    """Project a point of the camera's frame, before focal length and centre; NaN behind a pinhole.

    Returns:
        Both image coordinates; derivatives of the first by x, y and z; those of the second; both by k1.
    """
    k1, k2, k3, k4, k5 = lens[4], lens[5], lens[6], lens[7], lens[8]
    if fisheye:
        r2 = x * x + y * y
        r, norm2 = np.sqrt(r2), r2 + z * z
        theta = np.arctan2(r, z)
        t2 = theta * theta
        slope = 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)))
        # Image radius per radius in the camera's frame, and its derivatives; 1 / z on the axis.
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
    """Return a road point in the camera frame and in the level frame, one camera height above the road."""
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
def project_with_jacobian(fisheye, lens, view, forward, left, by):
    """Pixel of a road point, and its Jacobian.

    Args:
        fisheye: Lens model.
        lens: See the module.
        view: See :func:`set_view`.
        forward: Ahead of the rear axle.
        left: Of the middle.
        by: Filled, 2 x (2 + ``N_CAMERA``): derivatives of u and v by forward and left, then by the camera's
            numbers.
    """
    cp, sp, cr, sr, cy, sy = view[0], view[1], view[2], view[3], view[4], view[5]
    x, y, z, ahead, right, down = _in_camera(view, forward, left)
    seen = _distorted(fisheye, lens, x, y, z)
    for k in range(2):
        scale = lens[k]
        g_x, g_y, g_z = scale * seen[2 + 3 * k], scale * seen[3 + 3 * k], scale * seen[4 + 3 * k]
        # By the point ahead and to the right of the lens; pitch and roll also move what is below it.
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


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def lift_points(state, points, part, out, out_by, out_half):
    """Lift pixels to the road, with Jacobians.

    Args:
        state: See :class:`datagen.slam.adjustment.state.BundleState`.
        points: Pixels of all frames.
        part: First frame whose pixels are lifted, and one behind the last.
        out: Filled: road point of each pixel (ahead, left).
        out_by: Filled: derivatives by the camera parameters.
        out_half: Filled: road point half a pixel further along the gradient.
    """
    lens, tilt, uv, normals = state.lens, state.tilt, points.uv, points.normals
    view, by = np.empty(N_VIEW), np.empty((2, 2 + N_CAMERA))
    for k in range(part[0], part[1]):
        set_view(state.mount, tilt[k, 0], tilt[k, 1], view)
        for p in range(points.starts[k], points.starts[k + 1]):
            a, b = lift_pixel(state.fisheye, lens, view, uv[p, 0], uv[p, 1])
            out[p, 0], out[p, 1] = a, b
            u, v = uv[p, 0] + 0.5 * normals[p, 0], uv[p, 1] + 0.5 * normals[p, 1]
            out_half[p, 0], out_half[p, 1] = lift_pixel(state.fisheye, lens, view, u, v)
            # Implicit differentiation: the road point moves so that its pixel stays.
            project_with_jacobian(state.fisheye, lens, view, a, b, by)
            per_area = 1.0 / (by[0, 0] * by[1, 1] - by[0, 1] * by[1, 0])
            for c in range(N_CAMERA):
                du, dv = by[0, 2 + c], by[1, 2 + c]
                out_by[p, c, 0] = (by[0, 1] * dv - by[1, 1] * du) * per_area
                out_by[p, c, 1] = (by[1, 0] * du - by[0, 0] * dv) * per_area


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def _moved(poses, turns, frames, a, b):
    """Return a road point of frame i (ahead of the rear axle, left) in frame j; see :func:`_compare`."""
    (ci, si, cj, sj), (i, j) = turns, frames
    dx = poses[i, 0] + ci * a - si * b - poses[j, 0]
    dy = poses[i, 1] + si * a + ci * b - poses[j, 1]
    return cj * dx + sj * dy, cj * dy - sj * dx


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def associate(state, pairs, part, points, lifted, lifted_half, edges, gate_px, inner, seen, in_view, links):
    """Find for every point of frame i the nearest edge of frame j that brightens in the same direction.

    The edges of each frame are sorted by row. Only points that fall into ``inner`` get an edge: beyond the
    rim of the visible road, a point would be matched to another edge on this side of it, all along the rim,
    and the road would seem to stand still.

    Args:
        state: See :class:`datagen.slam.adjustment.state.BundleState`.
        pairs: Pairs of frames, i and j.
        part: First pair that is looked at, and one behind the last.
        points: Compared pixels.
        lifted: Road point of each, see :func:`lift_points`.
        lifted_half: The same half a pixel further along the gradient.
        edges: Edges of all frames.
        gate_px: Search radius.
        inner: Pixels in which points get an edge.
        seen: Counts in how many frames each point fell into ``inner``, and in how many of these it met an
            edge.
        in_view: Counts for each pair the points that fell into ``inner``.
        links: Filled from the front.

    Returns:
        Number of links.
    """
    poses, tilt, edge_uv, edge_normals = state.poses, state.tilt, edges.uv, edges.normals
    view = np.empty(N_VIEW)
    height, width = inner.shape
    count = 0
    for k in range(part[0], part[1]):
        i, j = pairs[k, 0], pairs[k, 1]
        set_view(state.mount, tilt[j, 0], tilt[j, 1], view)
        turns = np.cos(poses[i, 2]), np.sin(poses[i, 2]), np.cos(poses[j, 2]), np.sin(poses[j, 2])
        for p in range(points.starts[i], points.starts[i + 1]):
            a, b = _moved(poses, turns, (i, j), lifted[p, 0], lifted[p, 1])
            u, v = project_point(state.fisheye, state.lens, view, a, b)
            if not (0.0 <= u <= width - 1.0 and 0.0 <= v <= height - 1.0):
                continue
            if not inner[int(v + 0.5), int(u + 0.5)]:
                continue
            a, b = _moved(poses, turns, (i, j), lifted_half[p, 0], lifted_half[p, 1])
            u_half, v_half = project_point(state.fisheye, state.lens, view, a, b)
            nu, nv = u_half - u, v_half - v
            length = np.sqrt(nu * nu + nv * nv)
            # Half a pixel became this long: so uncertain is the place of the point in the other image.
            stretch = 2.0 * length
            if not 1e-9 < stretch < _MAX_STRETCH:
                continue
            seen[0, p] += 1
            in_view[k] += 1
            nu, nv = nu / length, nv / length
            best, chosen = gate_px * gate_px, -1
            stop = edges.starts[j + 1]
            # Bisection; NumPy's takes a second to compile.
            q, behind = edges.starts[j], stop
            while q < behind:
                middle = (q + behind) // 2
                if edge_uv[middle, 1] < v - gate_px:
                    q = middle + 1
                else:
                    behind = middle
            while q < stop and edge_uv[q, 1] <= v + gate_px:
                du, dv = edge_uv[q, 0] - u, edge_uv[q, 1] - v
                d = du * du + dv * dv
                if d < best and edge_normals[q, 0] * nu + edge_normals[q, 1] * nv > _LEAST_COSINE:
                    best, chosen = d, q
                q += 1
            if chosen >= 0:
                seen[1, p] += 1
                links.point[count], links.edge[count], links.pair[count] = p, chosen, k
                links.sigma[count] = np.sqrt(0.5 * (1.0 + stretch * stretch))
                count += 1
    return count


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def _compare(state, edges, turns, frames, moved, moved_by, q, view, by, jac):
    """Compare a point of frame i with an edge of frame j.

    Args:
        state: See :class:`datagen.slam.adjustment.state.BundleState`.
        edges: Edges of all frames.
        turns: Cosines and sines of both headings, of i and then of j.
        frames: i and j.
        moved: Road point in frame i.
        moved_by: Its Jacobian by the camera parameters.
        q: The edge.
        view: Of frame j.
        by: Buffer, see :func:`project_with_jacobian`.
        jac: Filled: Jacobian of the residual by frame i, frame j and the camera.

    Returns:
        Distance of the moved point from the edge, along the edge's gradient.
    """
    poses = state.poses
    ci, si, cj, sj = turns
    a, b = moved[0], moved[1]
    forward, left = _moved(poses, turns, frames, a, b)
    u, v = project_with_jacobian(state.fisheye, state.lens, view, forward, left, by)
    nu, nv = edges.normals[q, 0], edges.normals[q, 1]
    g_f, g_l = nu * by[0, 0] + nv * by[1, 0], nu * by[0, 1] + nv * by[1, 1]
    # By the point in the map, and by the point in frame i.
    g_x, g_y = g_f * cj - g_l * sj, g_f * sj + g_l * cj
    g_a, g_b = g_x * ci + g_y * si, g_y * ci - g_x * si
    jac[0], jac[1] = g_x, g_y
    jac[2] = g_x * (-si * a - ci * b) + g_y * (ci * a - si * b)
    jac[5], jac[6] = -g_x, -g_y
    jac[7] = g_f * left - g_l * forward
    for c in range(N_CAMERA):
        direct = nu * by[0, 2 + c] + nv * by[1, 2 + c]
        through = g_a * moved_by[c, 0] + g_b * moved_by[c, 1]
        jac[2 * N_FRAME + c] = direct + through
        if c == _PITCH:
            jac[3], jac[8] = through, direct
        elif c == _ROLL:
            jac[4], jac[9] = through, direct
    return (u - edges.uv[q, 0]) * nu + (v - edges.uv[q, 1]) * nv


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def link_scores(
    state, pairs, part, edges, lifted, lifted_by, links, starts, point_weight, cauchy_px, through, scores
):  # fmt: skip
    """Find what an error of each link adds to the camera's scores, J^T w with the frames eliminated.

    Args:
        state: See :class:`datagen.slam.adjustment.state.BundleState`.
        pairs: Pairs of frames, i and j.
        part: First pair whose links are looked at, and one behind the last.
        edges: Edges of all frames.
        lifted: Road point of each compared pixel.
        lifted_by: Its Jacobian by the camera parameters.
        links: Which point meets which edge.
        starts: First link of each pair, and one behind the last.
        point_weight: Inverse variance of each compared pixel.
        cauchy_px: Scale of the loss, see :func:`accumulate`.
        through: Change of each frame's numbers with each of the camera's, ``N_FRAME`` rows per frame.
        scores: Filled where a link has a residual, a row per link.
    """
    poses, tilt = state.poses, state.tilt
    view, by = np.empty(N_VIEW), np.empty((2, 2 + N_CAMERA))
    jac = np.empty(2 * N_FRAME + N_CAMERA)
    for k in range(part[0], part[1]):
        i, j = pairs[k, 0], pairs[k, 1]
        set_view(state.mount, tilt[j, 0], tilt[j, 1], view)
        turns = np.cos(poses[i, 2]), np.sin(poses[i, 2]), np.cos(poses[j, 2]), np.sin(poses[j, 2])
        for r in range(starts[k], starts[k + 1]):
            p, sigma = links.point[r], links.sigma[r]
            e = _compare(state, edges, turns, (i, j), lifted[p], lifted_by[p], links.edge[r], view, by, jac)
            if not np.isfinite(e):
                continue
            s = e / (sigma * cauchy_px)
            weight = point_weight[p] / ((1.0 + s * s) * sigma * sigma)
            for c in range(N_CAMERA):
                total = jac[2 * N_FRAME + c]
                for m in range(N_FRAME):
                    total += jac[m] * through[N_FRAME * i + m, c]
                    total += jac[N_FRAME + m] * through[N_FRAME * j + m, c]
                scores[r, c] = weight * total


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def accumulate(
    state, pairs, part, edges, lifted, lifted_by, links, starts, point_weight, cauchy_px, free,
    blocks, descents, residual
):  # fmt: skip
    """Add up the normal equations of all point-to-line residuals, a block per pair of frames.

    The residual e of a link is the distance of the moved point from its edge, along the edge's gradient, with
    the Cauchy loss: weight w = 1 / (1 + (e / (sigma c))^2). The unknowns of a block are frame i (x, y,
    heading, pitch, roll), frame j, and the camera's free numbers.

    Args:
        state: See :class:`datagen.slam.adjustment.state.BundleState`.
        pairs: Pairs of frames, i and j.
        part: First pair whose links are added up, and one behind the last.
        edges: Edges of all frames.
        lifted: Road point of each compared pixel.
        lifted_by: Its Jacobian by the camera parameters.
        links: Which point meets which edge.
        starts: First link of each pair, and one behind the last.
        point_weight: Inverse variance of each compared pixel.
        cauchy_px: Scale c of the loss.
        free: Which of the camera's numbers are free, by index.
        blocks: Filled: J^T W J of each pair; with a length of 0, only cost and residuals are found.
        descents: Filled: -J^T W e of each pair.
        residual: Filled: e of each link; NaN where the point is behind the camera.

    Returns:
        Robust cost.
    """
    poses, tilt = state.poses, state.tilt
    view, by = np.empty(N_VIEW), np.empty((2, 2 + N_CAMERA))
    jac = np.empty(2 * N_FRAME + N_CAMERA)
    both, n, only_cost = 2 * N_FRAME, 2 * N_FRAME + free.shape[0], blocks.shape[0] == 0
    cost = 0.0
    for k in range(part[0], part[1]):
        i, j = pairs[k, 0], pairs[k, 1]
        set_view(state.mount, tilt[j, 0], tilt[j, 1], view)
        turns = np.cos(poses[i, 2]), np.sin(poses[i, 2]), np.cos(poses[j, 2]), np.sin(poses[j, 2])
        for r in range(starts[k], starts[k + 1]):
            p, sigma = links.point[r], links.sigma[r]
            e = _compare(state, edges, turns, (i, j), lifted[p], lifted_by[p], links.edge[r], view, by, jac)
            if not np.isfinite(e):
                residual[r] = np.nan
                continue
            residual[r] = e
            s = e / (sigma * cauchy_px)
            cost += 0.5 * point_weight[p] * cauchy_px * cauchy_px * np.log1p(s * s)
            if only_cost:
                continue
            w = point_weight[p] / ((1.0 + s * s) * sigma * sigma)
            for c in range(free.shape[0]):
                # In ascending order, so that none is overwritten before it is read.
                jac[both + c] = jac[both + free[c]]
            for row in range(n):
                wj = w * jac[row]
                descents[k, row] -= wj * e
                for column in range(row + 1):
                    blocks[k, row, column] += wj * jac[column]
        if only_cost:
            continue
        for row in range(n):
            for column in range(row):
                blocks[k, column, row] = blocks[k, row, column]
    return cost
