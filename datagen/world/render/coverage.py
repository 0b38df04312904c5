"""How much of a pixel a thing on the floor covers, compiled.

Each pixel is taken as the parallelogram that it covers on the road, drawn out by the car's motion during the
exposure; a border covers the part of it that an unbounded straight edge at the same distance would. Corners
multiply the two directions' shares.

``no_type_check`` keeps run-time checks of shapes away from what numba compiles.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np

from datagen.world.compiled import compiled_bare


@compiled_bare
@no_type_check
def fold(width_a, width_b, width_c):
    """Turn three widths, of either sign, into two, the larger first: the third goes in by its variance."""
    a, b, c = abs(width_a), abs(width_b), abs(width_c)
    if a < b:
        a, b = b, a
    if c > 0.0:
        if a < c:
            a, c = c, a
        b = np.sqrt(b * b + c * c)
        if a < b:
            a, b = b, a
    return a, b


@compiled_bare
@no_type_check
def inner_share(distance, a, b):
    """Share of a pixel on the inner side of an edge, by its folded widths across the edge."""
    half = 0.5 * (a + b)
    d = abs(distance)
    if d >= half:
        outside = 0.0
    elif d <= 0.5 * (a - b):
        outside = 0.5 - d / a
    else:
        outside = (half - d) * (half - d) / (2.0 * a * b)
    return 1.0 - outside if distance > 0.0 else outside


@compiled_bare
@no_type_check
def box_share(distance, width_a, width_b, width_c=0.0):
    """Share of a parallelogram on the inner side of an edge.

    The distance across the edge, over the pixel, is the sum of two even distributions: their distribution
    function is the share. A third one, the motion, is folded into the smaller of the two by its variance.

    Args:
        distance: From the pixel's centre to the edge, positive when the centre is inside.
        width_a: Change of the distance over one pixel in u.
        width_b: The same in v.
        width_c: The same over the exposure.

    Returns:
        0..1.
    """
    a, b = fold(width_a, width_b, width_c)
    return inner_share(distance, a, b)


@compiled_bare
@no_type_check
def strip_share(distance, half, width_a, width_b, width_c):
    """Share of a pixel on a strip of half width ``half``, by the distance to its middle."""
    a, b = fold(width_a, width_b, width_c)
    if abs(distance) >= half + 0.5 * (a + b):
        return 0.0
    return inner_share(distance + half, a, b) - inner_share(distance - half, a, b)


@compiled_bare
@no_type_check
def painted_share(s, width_a, width_b, width_c, stretches, first, last):
    """Share of a pixel that lies on painted stretches along the road (rows first..last, ascending)."""
    a, b = fold(width_a, width_b, width_c)
    half = 0.5 * (a + b)
    low, high = first, last
    while low < high:  # the first stretch that ends beyond the pixel's start
        middle = (low + high) // 2
        if stretches[middle, 1] > s - half:
            high = middle
        else:
            low = middle + 1
    share = 0.0
    while low < last and stretches[low, 0] < s + half:
        share += inner_share(s - stretches[low, 0], a, b) - inner_share(s - stretches[low, 1], a, b)
        low += 1
    return min(max(share, 0.0), 1.0)


@compiled_bare
@no_type_check
def rectangle_share(x, y, ux, uy, vx, vy, mx, my, reach, boxes, q):
    """Share of a pixel on a rectangle: x, y, cos and sin of the direction, half length, half width, ..."""
    dx, dy, c, s = x - boxes[q, 0], y - boxes[q, 1], boxes[q, 2], boxes[q, 3]
    along, across = dx * c + dy * s, dy * c - dx * s
    if abs(along) >= boxes[q, 4] + reach or abs(across) >= boxes[q, 5] + reach:
        return 0.0
    alpha = strip_share(along, boxes[q, 4], ux * c + uy * s, vx * c + vy * s, mx * c + my * s)
    if alpha > 0.0:
        alpha *= strip_share(across, boxes[q, 5], uy * c - ux * s, vy * c - vx * s, my * c - mx * s)
    return alpha
