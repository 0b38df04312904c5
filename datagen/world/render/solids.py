"""Things above the floor, ray by ray: upright boxes, cylinders and cones, with soft edges.

A solid's outline against the background is made of planes through the eye: its left and right tangent plane.
The share of a pixel inside such a plane follows from the pixel's ray, as it does for borders on the floor.

Upright boxes, cylinders and cones, compiled: their outlines, and where a ray meets them.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np

from datagen.world.compiled import compiled, compiled_bare
from datagen.world.render.ground import TILE

BOX, CYLINDER, CONE = 0.0, 1.0, 2.0
#: Columns of a solid: x, y, cos and sin of its direction, half length, half width (radius of the round ones,
#: twice), bottom, top, shape, colour (3), colour of a band (3), bottom and top of the band.
SOLID_COLUMNS = 17


@compiled_bare
@no_type_check
def outline(solid, ex, ey, height, planes):
    """Find the planes through the eye that touch a solid on the left and on the right.

    Args:
        solid: See ``SOLID_COLUMNS``.
        ex: Eye, frame map.
        ey: Eye, frame map.
        height: Of the eye.
        planes: Filled: two normals, each pointing inwards, and the distances to where the planes touch.

    Returns:
        Horizontal distances to the nearest and the farthest point; the nearest is 0 with the eye inside, and
        both are -1 where an outline does not exist (above a cone).
    """
    x, y, shape = solid[0] - ex, solid[1] - ey, solid[8]
    distance = np.sqrt(x * x + y * y)
    if shape == BOX:
        c, s, half_a, half_b = solid[2], solid[3], solid[4], solid[5]
        a, b = -(x * c + y * s), -(y * c - x * s)  # the eye, from the box
        outside_a, outside_b = max(abs(a) - half_a, 0.0), max(abs(b) - half_b, 0.0)
        nearest = np.sqrt(outside_a * outside_a + outside_b * outside_b)
        if nearest <= 0.0:
            return 0.0, 0.0
        farthest = np.sqrt((abs(a) + half_a) ** 2 + (abs(b) + half_b) ** 2)
        for i in range(4):
            xi = x + (1 - 2 * (i & 1)) * half_a * c - (1 - (i & 2)) * half_b * s
            yi = y + (1 - 2 * (i & 1)) * half_a * s + (1 - (i & 2)) * half_b * c
            most_left, most_right = True, True
            for j in range(4):
                xj = x + (1 - 2 * (j & 1)) * half_a * c - (1 - (j & 2)) * half_b * s
                yj = y + (1 - 2 * (j & 1)) * half_a * s + (1 - (j & 2)) * half_b * c
                turn = xi * yj - yi * xj
                most_left, most_right = most_left and turn <= 1e-9, most_right and turn >= -1e-9
            length = np.sqrt(xi * xi + yi * yi)
            if most_left:
                planes[0], planes[1], planes[2], planes[6] = yi / length, -xi / length, 0.0, length
            if most_right:
                planes[3], planes[4], planes[5], planes[7] = -yi / length, xi / length, 0.0, length
        return nearest, farthest
    radius = solid[4]
    if distance <= radius:
        return 0.0, 0.0
    planes[6], planes[7] = distance, distance
    if shape == CYLINDER:
        sine = radius / distance
        cosine = np.sqrt(1.0 - sine * sine)
        # The tangents' directions: the axis' direction turned by the half angle to either side.
        cx, cy = x / distance, y / distance
        planes[0], planes[1], planes[2] = cy * cosine + cx * sine, cy * sine - cx * cosine, 0.0
        planes[3], planes[4], planes[5] = cx * sine - cy * cosine, cx * cosine + cy * sine, 0.0
        return distance - radius, distance + radius
    slope = radius / (solid[7] - solid[6])
    cosine = -slope * (height - solid[7]) / distance
    if abs(cosine) >= 1.0:
        return -1.0, -1.0
    # Normals of the cone's side that are square to the line from its tip to the eye.
    sine, shrink = np.sqrt(1.0 - cosine * cosine), 1.0 / np.sqrt(1.0 + slope * slope)
    bx, by = -x / distance, -y / distance
    planes[0], planes[1] = -shrink * (bx * cosine + by * sine), -shrink * (by * cosine - bx * sine)
    planes[3], planes[4] = -shrink * (bx * cosine - by * sine), -shrink * (by * cosine + bx * sine)
    planes[2] = planes[5] = -shrink * slope
    return distance - radius, distance + radius


@compiled_bare
@no_type_check
def pierce(solid, ex, ey, height, rx, ry, rz):
    """Find where a ray enters and leaves a solid, taken as endless upwards and downwards (a cone: downwards).

    A ray that just misses a round solid is taken where it comes closest.

    Returns:
        Distances along the ray, and the horizontal normal where it enters.
    """
    x, y, shape = ex - solid[0], ey - solid[1], solid[8]
    if shape == BOX:
        c, s = solid[2], solid[3]
        a, b, ra, rb = x * c + y * s, y * c - x * s, rx * c + ry * s, ry * c - rx * s
        tiny = 1e-12
        ra = tiny if abs(ra) < tiny else ra
        rb = tiny if abs(rb) < tiny else rb
        a0, a1 = (-solid[4] - a) / ra, (solid[4] - a) / ra
        b0, b1 = (-solid[5] - b) / rb, (solid[5] - b) / rb
        enter_a, enter_b = min(a0, a1), min(b0, b1)
        leave = min(max(a0, a1), max(b0, b1))
        if enter_a > enter_b:
            sign = -1.0 if ra > 0.0 else 1.0
            return min(enter_a, leave), leave, sign * c, sign * s
        sign = -1.0 if rb > 0.0 else 1.0
        return min(enter_b, leave), leave, -sign * s, sign * c
    if shape == CYLINDER:
        slope2, reach, fall = 0.0, solid[4], 0.0
        free = reach * reach
    else:
        slope = solid[4] / (solid[7] - solid[6])
        slope2, reach = slope * slope, solid[7] - height
        free, fall = slope2 * reach * reach, slope2 * reach * rz
    # |p + t r|^2 = slope^2 (top - height - t rz)^2
    qa = max(rx * rx + ry * ry - slope2 * rz * rz, 1e-9)
    qb = x * rx + y * ry + fall
    qc = x * x + y * y - free
    root = np.sqrt(max(qb * qb - qa * qc, 0.0))
    enter, leave = (-qb - root) / qa, (-qb + root) / qa
    px, py = x + enter * rx, y + enter * ry
    length = max(np.sqrt(px * px + py * py), 1e-9)
    return enter, leave, px / length, py / length


_WIDEST_PX_RAD = 0.04  # half a pixel, of the coarsest cameras
_CURVED_RAD = 0.03  # by how much an outline may bend between a tile's corners
_TOP_GAIN, _SIDE_GAIN = 1.12, 0.22  # how much brighter tops are, and sides that face the light


@compiled_bare
@no_type_check
def soft(distance, width):
    """Share of a pixel on the inner side of an edge, as a ramp."""
    return min(max(0.5 + distance / max(width, 1e-9), 0.0), 1.0)


@compiled_bare
@no_type_check
def mark_outside(lattice, planes, low, high, margin, marks):
    """Mark on which sides of a solid's outline the rays at the tiles' corners lie.

    Args:
        lattice: Rays at the corners, row by row, and the length of their horizontal part.
        planes: See :func:`datagen.world.render.solids.outline`.
        low: Slope of the solid's lower end.
        high: Slope of its upper end.
        margin: By how much a ray must lie outside, [rad].
        marks: Filled, a bit per side. A tile whose corners share one does not see the solid; a corner that
            the lens does not see has none.
    """
    lower, higher = margin * (1.0 + abs(low)), margin * (1.0 + abs(high))
    p0, p1, p2, p3, p4, p5 = planes[0], planes[1], planes[2], planes[3], planes[4], planes[5]
    xs, ys, zs, flats = lattice[0], lattice[1], lattice[2], lattice[3]
    for k in range(marks.shape[0]):
        x, y, z, flat = xs[k], ys[k], zs[k], flats[k]
        mark = np.uint8(x * p0 + y * p1 + z * p2 < -margin)
        mark |= np.uint8(x * p3 + y * p4 + z * p5 < -margin) << np.uint8(1)
        mark |= np.uint8(z + lower < low * flat) << np.uint8(2)
        mark |= np.uint8(z - higher > high * flat) << np.uint8(3)
        marks[k] = mark


@compiled
@no_type_check
def paint_solids(out, depth, rays, width, image_width, shake, rows, eye, way, turn, slack, solids, light):
    """Paint solids over what is already there, the far ones first.

    Args:
        out: Image as rows of pixels, float32, changed in place.
        depth: Buffer, a float32 per pixel, overwritten: distance to the nearest solid.
        rays: See :class:`datagen.world.render.ground.PixelGround`, in one row.
        width: Pixels per row, filled up.
        image_width: Pixels per row that are part of the image.
        shake: See :func:`datagen.world.render.ground.cast_tile`.
        rows: See there.
        eye: See there.
        way: See there.
        turn: See there.
        slack: Largest angle by which a row's view of a near solid differs from the middle row's.
        solids: Sorted, see :data:`datagen.world.render.solids.SOLID_COLUMNS`; x and y from the frame's pose.
        light: cos and sin of the direction from which the light comes.
    """
    tile_rows, tile_columns = (rows.shape[0] + TILE - 1) // TILE, width // TILE
    corners = tile_columns + 1
    buffers = (
        np.empty((TILE, 8)), np.empty(8), np.empty(2 * TILE, np.float32),
        np.empty((4, (tile_rows + 1) * corners)), np.empty((tile_rows + 1) * corners, np.uint8),
    )  # fmt: skip
    _paint_all(
        out, depth, rays, width, image_width, shake, rows, eye, way, turn, slack, solids, light, buffers
    )


@compiled_bare
@no_type_check
def _paint_all(
    out, depth, rays, width, image_width, shake, rows, eye, way, turn, slack, solids, light, buffers
):
    """Paint with buffers at hand; see :func:`paint_solids`."""
    band, planes, inner, lattice, marks = buffers
    height = rows.shape[0]
    tile_rows, tile_columns = (height + TILE - 1) // TILE, width // TILE
    corners = tile_columns + 1
    depth[:] = np.inf
    c, s = rows[height // 2, 2], rows[height // 2, 3]
    mid_x, mid_y = eye[1] * c + eye[0] * s, eye[1] * s - eye[0] * c
    for j in range(tile_rows + 1):
        for k in range(tile_columns + 1):
            i = min(j * TILE, height - 1) * width + min(k * TILE, image_width - 1)
            n = i // TILE * 9 * TILE + i % TILE
            right, ahead, up = rays[n], rays[n + TILE], rays[n + 2 * TILE]
            a = shake[0, 0] * right + shake[0, 1] * ahead + shake[0, 2] * up
            b = shake[1, 0] * right + shake[1, 1] * ahead + shake[1, 2] * up
            corner = j * corners + k
            lattice[0, corner], lattice[1, corner] = b * c + a * s, b * s - a * c
            lattice[2, corner] = shake[2, 0] * right + shake[2, 1] * ahead + shake[2, 2] * up
            lattice[3, corner] = np.hypot(a, b)
    for q in range(solids.shape[0]):
        solid = solids[q]
        nearest, farthest = outline(solid, mid_x, mid_y, eye[2], planes)
        if nearest <= 0.0:
            continue
        low = (solid[6] - eye[2]) / (nearest if solid[6] < eye[2] else farthest)
        high = (solid[7] - eye[2]) / (nearest if solid[7] > eye[2] else farthest)
        margin = _CURVED_RAD + slack + abs(turn) + abs(way) / nearest
        mark_outside(lattice, planes, low, high, margin, marks)
        for j in range(tile_rows):
            top, bottom = j * TILE, min(j * TILE + TILE, height)
            known = False
            for k in range(tile_columns):
                corner = j * corners + k
                upper, lower = marks[corner] & marks[corner + 1], marks[corner + corners]
                if upper & lower & marks[corner + corners + 1]:
                    continue
                if not known:
                    known = True
                    for v in range(top, bottom):
                        c, s = rows[v, 2], rows[v, 3]
                        ex = rows[v, 0] + eye[1] * c + eye[0] * s
                        ey = rows[v, 1] + eye[1] * s - eye[0] * c
                        inside, _ = outline(solid, ex, ey, eye[2], band[v - top])
                        known = known and inside > 0.0
                    if not known:  # the eye reaches the solid while the frame is read
                        break
                for v in range(top, bottom):
                    start = v * width + k * TILE
                    _paint_row(
                        out, depth, rays, start, shake, rows, v, eye, way, turn, solid, band, v - top, light,
                        inner,
                    )  # fmt: skip


@compiled_bare
@no_type_check
def _paint_row(out, depth, rays, start, shake, rows, v, eye, way, turn, solid, band, at, light, inner):
    """Paint one solid into ``TILE`` pixels of an image row."""
    c, s = rows[v, 2], rows[v, 3]
    ahead_x, ahead_y = eye[1] * c + eye[0] * s, eye[1] * s - eye[0] * c
    ex, ey = rows[v, 0] + ahead_x, rows[v, 1] + ahead_y
    # How the eye moves while the pixel is exposed, and how far beyond an edge a pixel may still see of it.
    move_x, move_y = way * c - turn * ahead_y, way * s + turn * ahead_x
    edge = _WIDEST_PX_RAD + abs(turn) + (abs(move_x) + abs(move_y)) / min(band[at, 6], band[at, 7])
    left_move = (band[at, 0] * move_x + band[at, 1] * move_y) / band[at, 6]
    right_move = (band[at, 3] * move_x + band[at, 4] * move_y) / band[at, 7]
    # From the camera's shaken axes (right, ahead, up) to the map's, in one step.
    m00, m10, m20 = shake[1, 0] * c + shake[0, 0] * s, shake[1, 0] * s - shake[0, 0] * c, shake[2, 0]
    m01, m11, m21 = shake[1, 1] * c + shake[0, 1] * s, shake[1, 1] * s - shake[0, 1] * c, shake[2, 1]
    m02, m12, m22 = shake[1, 2] * c + shake[0, 2] * s, shake[1, 2] * s - shake[0, 2] * c, shake[2, 2]
    n = rays[start * 9 : (start + TILE) * 9]
    # The planes in the ray's own axes; most pixels of a tile lie outside, which is found in plain float32.
    f = np.float32
    left_a = f(band[at, 0] * m00 + band[at, 1] * m10 + band[at, 2] * m20)
    left_b = f(band[at, 0] * m01 + band[at, 1] * m11 + band[at, 2] * m21)
    left_d = f(band[at, 0] * m02 + band[at, 1] * m12 + band[at, 2] * m22)
    right_a = f(band[at, 3] * m00 + band[at, 4] * m10 + band[at, 5] * m20)
    right_b = f(band[at, 3] * m01 + band[at, 4] * m11 + band[at, 5] * m21)
    right_d = f(band[at, 3] * m02 + band[at, 4] * m12 + band[at, 5] * m22)
    for j in range(TILE):
        a, b, d = n[j], n[TILE + j], n[2 * TILE + j]
        inner[j] = left_a * a + left_b * b + left_d * d
        inner[TILE + j] = right_a * a + right_b * b + right_d * d
    for j in range(TILE):
        left, right = inner[j], inner[TILE + j]
        if not min(left, right) > -edge:  # also where the lens sees nothing
            continue
        i = start + j
        a, b, d = n[j], n[TILE + j], n[2 * TILE + j]
        rx, ry, rz = m00 * a + m01 * b + m02 * d, m10 * a + m11 * b + m12 * d, m20 * a + m21 * b + m22 * d
        ua, ub, ud = n[3 * TILE + j], n[4 * TILE + j], n[5 * TILE + j]
        va, vb, vd = n[6 * TILE + j], n[7 * TILE + j], n[8 * TILE + j]
        alpha = 1.0
        if left < edge:
            du, dv = left_a * ua + left_b * ub + left_d * ud, left_a * va + left_b * vb + left_d * vd
            dm = left_move + turn * (band[at, 1] * rx - band[at, 0] * ry)
            alpha = soft(left, np.sqrt(du * du + dv * dv + dm * dm))
        if right < edge:
            du, dv = right_a * ua + right_b * ub + right_d * ud, right_a * va + right_b * vb + right_d * vd
            dm = right_move + turn * (band[at, 4] * rx - band[at, 3] * ry)
            alpha *= soft(right, np.sqrt(du * du + dv * dv + dm * dm))
        if alpha <= 0.0:
            continue
        enter, leave, nx, ny = pierce(solid, ex, ey, eye[2], rx, ry, rz)
        if not enter > 0.0 or enter >= depth[i]:
            continue
        z_enter, z_leave = eye[2] + enter * rz, eye[2] + leave * rz
        flat = max(np.sqrt(rx * rx + ry * ry), 0.05)
        size = np.sqrt(0.5 * (ua * ua + ub * ub + ud * ud + va * va + vb * vb + vd * vd))
        # A step of one pixel up or down, at the solid, and what the approach adds to it.
        width = enter * size / flat + abs(rz) * abs(way) / flat
        bottom, top = (z_enter, z_leave) if rz < 0.0 else (z_leave, z_enter)
        alpha *= soft(bottom - solid[6], width) * soft(solid[7] - top, width)
        if alpha <= 0.0:
            continue
        side = 1.0 + _SIDE_GAIN * (nx * light[0] + ny * light[1])
        on_top = soft(z_enter - solid[7], width) if rz < 0.0 and solid[8] != CONE else 0.0
        banded = 0.0
        if solid[16] > solid[15]:
            banded = soft(z_enter - solid[15], width) * soft(solid[16] - z_enter, width) * (1.0 - on_top)
        gain = side + on_top * (_TOP_GAIN - side)
        for channel in range(3):
            colour = solid[9 + channel] + banded * (solid[12 + channel] - solid[9 + channel])
            out[i, channel] += alpha * (min(gain * colour, 255.0) - out[i, channel])
        if alpha > 0.5:
            depth[i] = enter
