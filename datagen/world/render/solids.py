"""Things above the floor, ray by ray: upright boxes, cylinders and cones, with soft edges.

A solid's outline against the background is made of planes through the eye: its left and right tangent plane.
The share of a pixel inside such a plane follows from the pixel's ray, as it does for edges on the floor.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np

from datagen.world.render.compiled import (
    AHEAD,
    AHEAD_U,
    AHEAD_V,
    COS,
    HALF_LENGTH,
    HALF_WIDTH,
    RAY_NUMBERS,
    RIGHT,
    RIGHT_U,
    RIGHT_V,
    SIN,
    TILE,
    UP,
    UP_U,
    UP_V,
    X,
    Y,
    compiled,
    compiled_bare,
)

#: Shapes.
BOX, CYLINDER, CONE = 0.0, 1.0, 2.0
#: Columns of a solid after those that all things have (round ones: the radius twice): bottom, top, shape;
#: where the colour and the colour of a band begin (blue, green, red); bottom and top of the band.
BOTTOM, TOP, SHAPE, COLOUR, BAND_COLOUR, BAND_BOTTOM, BAND_TOP = 6, 7, 8, 9, 12, 15, 16
SOLID_COLUMNS = 17
#: Columns of an outline: normals of both planes, pointing inwards; distances to where the planes touch.
LEFT_X, LEFT_Y, LEFT_Z, RIGHT_X, RIGHT_Y, RIGHT_Z, LEFT_DISTANCE, RIGHT_DISTANCE = range(8)
#: Half a pixel of the coarsest cameras.
_WIDEST_PX_RAD = 0.04
#: By how much an outline may bend between a tile's corners.
_CURVED_RAD = 0.03
#: How much brighter tops are, and sides that face the light; chosen: less than paint differs from the floor.
_TOP_GAIN, _SIDE_GAIN = 1.12, 0.22


@compiled_bare
@no_type_check
def _outline(solid, ex, ey, height, planes):
    """Find the planes through the eye that touch a solid on the left and on the right.

    Args:
        solid: See :data:`BOTTOM`.
        ex: Eye, frame map.
        ey: Eye, frame map.
        height: Of the eye.
        planes: Filled, see :data:`LEFT_X`.

    Returns:
        Horizontal distances to the nearest and the farthest point; the nearest is 0 with the eye inside, and
        both are -1 where an outline does not exist (above a cone).
    """
    x, y, shape = solid[X] - ex, solid[Y] - ey, solid[SHAPE]
    distance = np.sqrt(x * x + y * y)
    if shape == BOX:
        c, s, half_a, half_b = solid[COS], solid[SIN], solid[HALF_LENGTH], solid[HALF_WIDTH]
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
                planes[LEFT_X], planes[LEFT_Y] = yi / length, -xi / length
                planes[LEFT_Z], planes[LEFT_DISTANCE] = 0.0, length
            if most_right:
                planes[RIGHT_X], planes[RIGHT_Y] = -yi / length, xi / length
                planes[RIGHT_Z], planes[RIGHT_DISTANCE] = 0.0, length
        return nearest, farthest
    radius = solid[HALF_LENGTH]
    if distance <= radius:
        return 0.0, 0.0
    planes[LEFT_DISTANCE], planes[RIGHT_DISTANCE] = distance, distance
    if shape == CYLINDER:
        sine = radius / distance
        cosine = np.sqrt(1.0 - sine * sine)
        # The tangents' directions: the axis' direction turned by the half angle to either side.
        cx, cy = x / distance, y / distance
        planes[LEFT_X], planes[LEFT_Y] = cy * cosine + cx * sine, cy * sine - cx * cosine
        planes[RIGHT_X], planes[RIGHT_Y] = cx * sine - cy * cosine, cx * cosine + cy * sine
        planes[LEFT_Z] = planes[RIGHT_Z] = 0.0
        return distance - radius, distance + radius
    slope = radius / (solid[TOP] - solid[BOTTOM])
    cosine = -slope * (height - solid[TOP]) / distance
    if abs(cosine) >= 1.0:
        return -1.0, -1.0
    # Normals of the cone's side that are square to the line from its tip to the eye.
    sine, shrink = np.sqrt(1.0 - cosine * cosine), 1.0 / np.sqrt(1.0 + slope * slope)
    bx, by = -x / distance, -y / distance
    along_x, along_y, across_x, across_y = bx * cosine, by * cosine, bx * sine, by * sine
    planes[LEFT_X], planes[LEFT_Y] = -shrink * (along_x + across_y), -shrink * (along_y - across_x)
    planes[RIGHT_X], planes[RIGHT_Y] = -shrink * (along_x - across_y), -shrink * (along_y + across_x)
    planes[LEFT_Z] = planes[RIGHT_Z] = -shrink * slope
    return distance - radius, distance + radius


@compiled_bare
@no_type_check
def _pierce(solid, ex, ey, height, rx, ry, rz):
    """Find where a ray enters and leaves a solid, taken as endless upwards and downwards (a cone: downwards).

    A ray that just misses a round solid is taken where it comes closest.

    Returns:
        Distances along the ray, and the horizontal normal where it enters.
    """
    x, y, shape = ex - solid[X], ey - solid[Y], solid[SHAPE]
    if shape == BOX:
        c, s = solid[COS], solid[SIN]
        a, b, ra, rb = x * c + y * s, y * c - x * s, rx * c + ry * s, ry * c - rx * s
        tiny = 1e-12
        ra = tiny if abs(ra) < tiny else ra
        rb = tiny if abs(rb) < tiny else rb
        a0, a1 = (-solid[HALF_LENGTH] - a) / ra, (solid[HALF_LENGTH] - a) / ra
        b0, b1 = (-solid[HALF_WIDTH] - b) / rb, (solid[HALF_WIDTH] - b) / rb
        enter_a, enter_b = min(a0, a1), min(b0, b1)
        leave = min(max(a0, a1), max(b0, b1))
        if enter_a > enter_b:
            sign = -1.0 if ra > 0.0 else 1.0
            return min(enter_a, leave), leave, sign * c, sign * s
        sign = -1.0 if rb > 0.0 else 1.0
        return min(enter_b, leave), leave, -sign * s, sign * c
    if shape == CYLINDER:
        slope2, reach, fall = 0.0, solid[HALF_LENGTH], 0.0
        free = reach * reach
    else:
        slope = solid[HALF_LENGTH] / (solid[TOP] - solid[BOTTOM])
        slope2, reach = slope * slope, solid[TOP] - height
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


@compiled_bare
@no_type_check
def _soft(distance, width):
    """Share of a pixel on the inner side of an edge, as a ramp."""
    return min(max(0.5 + distance / max(width, 1e-9), 0.0), 1.0)


@compiled_bare
@no_type_check
def _mark_outside(lattice, planes, low, high, margin, marks):
    """Mark on which sides of a solid's outline the rays at the tiles' corners lie.

    Args:
        lattice: Rays at the corners, row by row, and the length of their horizontal part.
        planes: See :func:`_outline`.
        low: Slope of the solid's lower end.
        high: Slope of its upper end.
        margin: By how much a ray must lie outside, [rad].
        marks: Filled, a bit per side. A tile whose corners share one does not see the solid; a corner that
            the lens does not see has none.
    """
    lower, higher = margin * (1.0 + abs(low)), margin * (1.0 + abs(high))
    p0, p1, p2 = planes[LEFT_X], planes[LEFT_Y], planes[LEFT_Z]
    p3, p4, p5 = planes[RIGHT_X], planes[RIGHT_Y], planes[RIGHT_Z]
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
def paint_solids(canvas, ground, view, solids, light):
    """Paint solids over what is already there.

    Args:
        canvas: Painted in place.
        ground: The camera's rays.
        view: The frame.
        solids: The far ones first; x and y from the frame's pose.
        light: Cosine and sine of the direction from which the light comes.
    """
    tile_rows, corners = (ground.height + TILE - 1) // TILE, ground.stride // TILE + 1
    buffers = (
        np.empty((TILE, 8)), np.empty(8), np.empty(2 * TILE, np.float32),
        np.empty((4, (tile_rows + 1) * corners)), np.empty((tile_rows + 1) * corners, np.uint8),
    )  # fmt: skip
    _paint_all(canvas, ground, view, solids, light, buffers)


@compiled_bare
@no_type_check
def _paint_all(canvas, ground, view, solids, light, buffers):
    """Paint with buffers at hand; see :func:`paint_solids`."""
    outlines, planes, inner, lattice, marks = buffers
    rays, rows, eye, shake, stride = ground.rays, view.rows, ground.eye_cm, view.shake, ground.stride
    height = ground.height
    tile_rows, tile_columns = (height + TILE - 1) // TILE, stride // TILE
    corners = tile_columns + 1
    canvas.depth[:] = np.inf
    c, s = rows[height // 2, 2], rows[height // 2, 3]
    mid_x, mid_y = eye[1] * c + eye[0] * s, eye[1] * s - eye[0] * c
    for j in range(tile_rows + 1):
        for k in range(tile_columns + 1):
            i = min(j * TILE, height - 1) * stride + min(k * TILE, ground.width - 1)
            n = i // TILE * RAY_NUMBERS + i % TILE
            right, ahead, up = rays[n + RIGHT], rays[n + AHEAD], rays[n + UP]
            a = shake[0, 0] * right + shake[0, 1] * ahead + shake[0, 2] * up
            b = shake[1, 0] * right + shake[1, 1] * ahead + shake[1, 2] * up
            corner = j * corners + k
            lattice[0, corner], lattice[1, corner] = b * c + a * s, b * s - a * c
            lattice[2, corner] = shake[2, 0] * right + shake[2, 1] * ahead + shake[2, 2] * up
            lattice[3, corner] = np.hypot(a, b)
    for q in range(solids.shape[0]):
        solid = solids[q]
        nearest, farthest = _outline(solid, mid_x, mid_y, eye[2], planes)
        if nearest <= 0.0:
            continue
        low = (solid[BOTTOM] - eye[2]) / (nearest if solid[BOTTOM] < eye[2] else farthest)
        high = (solid[TOP] - eye[2]) / (nearest if solid[TOP] > eye[2] else farthest)
        margin = _CURVED_RAD + view.slack_rad + abs(view.turn_rad) + abs(view.move_cm) / nearest
        _mark_outside(lattice, planes, low, high, margin, marks)
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
                        inside, _ = _outline(solid, ex, ey, eye[2], outlines[v - top])
                        known = known and inside > 0.0
                    if not known:  # the eye reaches the solid while the frame is read
                        break
                for v in range(top, bottom):
                    start = v * stride + k * TILE
                    _paint_row(canvas, ground, view, start, v, solid, outlines[v - top], light, inner)


@compiled_bare
@no_type_check
def _paint_row(canvas, ground, view, start, v, solid, planes, light, inner):
    """Paint one solid into ``TILE`` pixels of image row ``v``."""
    shake, rows, eye, move, turn = view.shake, view.rows, ground.eye_cm, view.move_cm, view.turn_rad
    c, s = rows[v, 2], rows[v, 3]
    ahead_x, ahead_y = eye[1] * c + eye[0] * s, eye[1] * s - eye[0] * c
    ex, ey = rows[v, 0] + ahead_x, rows[v, 1] + ahead_y
    # How the eye moves while the pixel is exposed, and how far beyond an edge a pixel may still see of it.
    move_x, move_y = move * c - turn * ahead_y, move * s + turn * ahead_x
    nearest = min(planes[LEFT_DISTANCE], planes[RIGHT_DISTANCE])
    edge = _WIDEST_PX_RAD + abs(turn) + (abs(move_x) + abs(move_y)) / nearest
    left_move = (planes[LEFT_X] * move_x + planes[LEFT_Y] * move_y) / planes[LEFT_DISTANCE]
    right_move = (planes[RIGHT_X] * move_x + planes[RIGHT_Y] * move_y) / planes[RIGHT_DISTANCE]
    # From the camera's shaken axes (right, ahead, up) to the map's, in one step.
    m00, m10, m20 = shake[1, 0] * c + shake[0, 0] * s, shake[1, 0] * s - shake[0, 0] * c, shake[2, 0]
    m01, m11, m21 = shake[1, 1] * c + shake[0, 1] * s, shake[1, 1] * s - shake[0, 1] * c, shake[2, 1]
    m02, m12, m22 = shake[1, 2] * c + shake[0, 2] * s, shake[1, 2] * s - shake[0, 2] * c, shake[2, 2]
    n = ground.rays[start * 9 : (start + TILE) * 9]
    # The planes in the ray's own axes; most pixels of a tile lie outside, which is found in plain float32.
    f = np.float32
    left_a = f(planes[LEFT_X] * m00 + planes[LEFT_Y] * m10 + planes[LEFT_Z] * m20)
    left_b = f(planes[LEFT_X] * m01 + planes[LEFT_Y] * m11 + planes[LEFT_Z] * m21)
    left_d = f(planes[LEFT_X] * m02 + planes[LEFT_Y] * m12 + planes[LEFT_Z] * m22)
    right_a = f(planes[RIGHT_X] * m00 + planes[RIGHT_Y] * m10 + planes[RIGHT_Z] * m20)
    right_b = f(planes[RIGHT_X] * m01 + planes[RIGHT_Y] * m11 + planes[RIGHT_Z] * m21)
    right_d = f(planes[RIGHT_X] * m02 + planes[RIGHT_Y] * m12 + planes[RIGHT_Z] * m22)
    for j in range(TILE):
        a, b, d = n[RIGHT + j], n[AHEAD + j], n[UP + j]
        inner[j] = left_a * a + left_b * b + left_d * d
        inner[TILE + j] = right_a * a + right_b * b + right_d * d
    for j in range(TILE):
        left, right = inner[j], inner[TILE + j]
        if not min(left, right) > -edge:  # also where the lens sees nothing
            continue
        i = start + j
        a, b, d = n[RIGHT + j], n[AHEAD + j], n[UP + j]
        rx, ry, rz = m00 * a + m01 * b + m02 * d, m10 * a + m11 * b + m12 * d, m20 * a + m21 * b + m22 * d
        ua, ub, ud = n[RIGHT_U + j], n[AHEAD_U + j], n[UP_U + j]
        va, vb, vd = n[RIGHT_V + j], n[AHEAD_V + j], n[UP_V + j]
        alpha = 1.0
        if left < edge:
            du, dv = left_a * ua + left_b * ub + left_d * ud, left_a * va + left_b * vb + left_d * vd
            dm = left_move + turn * (planes[LEFT_Y] * rx - planes[LEFT_X] * ry)
            alpha = _soft(left, np.sqrt(du * du + dv * dv + dm * dm))
        if right < edge:
            du, dv = right_a * ua + right_b * ub + right_d * ud, right_a * va + right_b * vb + right_d * vd
            dm = right_move + turn * (planes[RIGHT_Y] * rx - planes[RIGHT_X] * ry)
            alpha *= _soft(right, np.sqrt(du * du + dv * dv + dm * dm))
        if alpha <= 0.0:
            continue
        enter, leave, nx, ny = _pierce(solid, ex, ey, eye[2], rx, ry, rz)
        if not enter > 0.0 or enter >= canvas.depth[i]:
            continue
        z_enter, z_leave = eye[2] + enter * rz, eye[2] + leave * rz
        flat = max(np.sqrt(rx * rx + ry * ry), 0.05)
        size = np.sqrt(0.5 * (ua * ua + ub * ub + ud * ud + va * va + vb * vb + vd * vd))
        # A step of one pixel up or down, at the solid, and what the approach adds to it.
        width = enter * size / flat + abs(rz) * abs(move) / flat
        bottom, top = (z_enter, z_leave) if rz < 0.0 else (z_leave, z_enter)
        alpha *= _soft(bottom - solid[BOTTOM], width) * _soft(solid[TOP] - top, width)
        if alpha <= 0.0:
            continue
        side = 1.0 + _SIDE_GAIN * (nx * light[0] + ny * light[1])
        on_top = _soft(z_enter - solid[TOP], width) if rz < 0.0 and solid[SHAPE] != CONE else 0.0
        banded = 0.0
        if solid[BAND_TOP] > solid[BAND_BOTTOM]:
            banded = _soft(z_enter - solid[BAND_BOTTOM], width) * _soft(solid[BAND_TOP] - z_enter, width)
            banded *= 1.0 - on_top
        gain = side + on_top * (_TOP_GAIN - side)
        for channel in range(3):
            colour, band = solid[COLOUR + channel], solid[BAND_COLOUR + channel]
            colour += banded * (band - colour)
            canvas.light[i, channel] += alpha * (min(gain * colour, 255.0) - canvas.light[i, channel])
        if alpha > 0.5:
            canvas.depth[i] = enter
