"""What the renderer's compiled loops share: how they are compiled, names of columns, coverage of a pixel.

numba's cache notices a change of the file that a function stands in, but not of one that it calls into: after
a change here or in another file's compiled function, delete ``datagen/world/render/__pycache__``.

Coverage: each pixel is the parallelogram that it covers on the road, drawn out by the car's motion during the
exposure. An edge covers the part of it that an unbounded straight edge at the same distance would; at corners
the shares of both directions are multiplied.

``no_type_check`` keeps run-time checks of shapes away from what numba compiles.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

#: Kept on disk; division by zero gives infinity.
compiled = njit(cache=True, error_model="numpy")
#: For functions that allocate nothing. Counting references to arrays costs more than a row of pixels
#: does, and these do not need it: their callers hold all arrays that they pass.
compiled_bare = njit(cache=True, error_model="numpy", _nrt=False)

#: Side of the square blocks of pixels that are drawn together, [px]: one vector of 512 bits in float32.
TILE = 16
#: ``TILE`` neighbouring pixels keep each of their numbers together. Where each starts in a block of rays: the
#: unit ray to the right, ahead and up, its change per pixel in u and in v.
RIGHT, AHEAD, UP, RIGHT_U, AHEAD_U, UP_U, RIGHT_V, AHEAD_V, UP_V = range(0, 9 * TILE, TILE)
RAY_NUMBERS = 9 * TILE
#: Likewise in a block of what the pixels see of the floor: their point from the rear axle, axes of the map;
#: what they cover, as the change of that point per pixel in u, in v, and during the exposure; all in cm.
AT_X, AT_Y, U_X, U_Y, V_X, V_Y, MOVE_X, MOVE_Y = range(0, 8 * TILE, TILE)
FLOOR_NUMBERS = 8 * TILE
#: Values of a pixel's level: it sees no floor; added to the texture's level beyond what is painted.
NOT_FLOOR, FAR = 255, 8

#: Columns that all things in a scene begin with: place and direction, frame map, and half their size, [cm].
X, Y, COS, SIN, HALF_LENGTH, HALF_WIDTH = range(6)
#: The column at which the colour of a flat rectangle begins: blue, green, red.
BLUE = 6


@compiled_bare
@no_type_check
def widths_along(pixel, c, s):
    """Change of a distance along the direction (c, s) over a pixel: in u, in v, and over the exposure.

    Args:
        pixel: x and y on the map, reach (see ``REACH`` in :mod:`datagen.world.render.floor`), then ``U_X`` to
            ``MOVE_Y``.
        c: Cosine of the direction.
        s: Sine of it.
    """
    _, _, _, ux, uy, vx, vy, mx, my = pixel
    return ux * c + uy * s, vx * c + vy * s, mx * c + my * s


@compiled_bare
@no_type_check
def fold(widths):
    """Turn three widths, of either sign, into two, the larger first: the third goes in by its variance."""
    a, b, c = abs(widths[0]), abs(widths[1]), abs(widths[2])
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
    """Share of a pixel on the inner side of an edge, by its folded widths across the edge.

    The distance across the edge, over the pixel, is the sum of two uniform distributions; their distribution
    function is the share.
    """
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
def edge_share(distance, widths):
    """Share of a pixel on the inner side of an edge; the distance is positive when its centre is inside."""
    a, b = fold(widths)
    return inner_share(distance, a, b)


@compiled_bare
@no_type_check
def strip_share(distance, half, widths):
    """Share of a pixel on a strip of half width ``half``, by the distance to its middle."""
    a, b = fold(widths)
    if abs(distance) >= half + 0.5 * (a + b):
        return 0.0
    return inner_share(distance + half, a, b) - inner_share(distance - half, a, b)


@compiled_bare
@no_type_check
def painted_share(s, widths, painted, first, last):
    """Share of a pixel on painted sections along the road: rows ``first`` to ``last``, ascending."""
    a, b = fold(widths)
    half = 0.5 * (a + b)
    low, high = first, last
    while low < high:  # the first section that ends beyond the pixel's start
        middle = (low + high) // 2
        if painted[middle, 1] > s - half:
            high = middle
        else:
            low = middle + 1
    share = 0.0
    while low < last and painted[low, 0] < s + half:
        share += inner_share(s - painted[low, 0], a, b) - inner_share(s - painted[low, 1], a, b)
        low += 1
    return min(max(share, 0.0), 1.0)


@compiled_bare
@no_type_check
def rectangle_share(pixel, rectangle):
    """Share of a pixel on a flat rectangle."""
    x, y, reach = pixel[0], pixel[1], pixel[2]
    dx, dy, c, s = x - rectangle[X], y - rectangle[Y], rectangle[COS], rectangle[SIN]
    along, across = dx * c + dy * s, dy * c - dx * s
    if abs(along) >= rectangle[HALF_LENGTH] + reach or abs(across) >= rectangle[HALF_WIDTH] + reach:
        return 0.0
    share = strip_share(along, rectangle[HALF_LENGTH], widths_along(pixel, c, s))
    if share > 0.0:
        share *= strip_share(across, rectangle[HALF_WIDTH], widths_along(pixel, -s, c))
    return share
