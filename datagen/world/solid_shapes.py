"""Upright boxes, cylinders and cones, compiled: their outlines, and where a ray meets them."""

from __future__ import annotations

from typing import no_type_check

import numpy as np

from datagen.world.compiled import compiled_bare

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
