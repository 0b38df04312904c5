"""What a pixel covers and where it lies along the road, compiled.

Each pixel is taken as the parallelogram that it covers on the road; a border covers the part of it that an
unbounded straight edge at the same distance would, exactly. Corners multiply the two directions' shares.

``no_type_check`` keeps run-time checks of shapes away from what numba compiles.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit


@njit(cache=True, error_model="numpy")
@no_type_check
def box_share(distance, width_a, width_b):
    """Share of a parallelogram on the inner side of an edge.

    The distance across the edge, over the pixel, is the sum of two even distributions: their distribution
    function is the share.

    Args:
        distance: From the pixel's centre to the edge, positive when the centre is inside.
        width_a: Change of the distance over one pixel in u.
        width_b: The same in v.

    Returns:
        0..1.
    """
    a, b = abs(width_a), abs(width_b)
    if a < b:
        a, b = b, a
    half = 0.5 * (a + b)
    d = abs(distance)
    if d >= half:
        outside = 0.0
    elif d <= 0.5 * (a - b):
        outside = 0.5 - d / a
    else:
        outside = (half - d) * (half - d) / (2.0 * a * b)
    return 1.0 - outside if distance > 0.0 else outside


@njit(cache=True, error_model="numpy")
@no_type_check
def fill_grid(nodes_xy, origin_x, origin_y, cell, reach, grid):
    """Write into each cell within ``reach`` of the centre line the index of the nearest sample."""
    rows, columns = grid.shape
    best = np.full(grid.shape, 1e18)
    span = int(np.ceil(reach / cell)) + 1
    for i in range(nodes_xy.shape[0]):
        column0 = int(np.floor((nodes_xy[i, 0] - origin_x) / cell))
        row0 = int(np.floor((nodes_xy[i, 1] - origin_y) / cell))
        for row in range(max(0, row0 - span), min(rows, row0 + span + 1)):
            dy = origin_y + (row + 0.5) * cell - nodes_xy[i, 1]
            for column in range(max(0, column0 - span), min(columns, column0 + span + 1)):
                dx = origin_x + (column + 0.5) * cell - nodes_xy[i, 0]
                d = dx * dx + dy * dy
                if d < best[row, column] and d <= reach * reach:
                    best[row, column] = d
                    grid[row, column] = i


@njit(cache=True, error_model="numpy")
@no_type_check
def locate(x, y, nodes, closed, start):
    """Foot of the perpendicular on the centre line, from a guess.

    Args:
        x: Position, frame map.
        y: Position, frame map.
        nodes: x, y, cos and sin of the heading, curvature, s of each sample.
        closed: Whether the last sample is followed by the first.
        start: Sample to start from.

    Returns:
        Distance along the road, offset (left positive), cos and sin of the heading there, curvature.
    """
    n = nodes.shape[0]
    i = start
    d = (x - nodes[i, 0]) ** 2 + (y - nodes[i, 1]) ** 2
    for _ in range(16):
        before, after = i - 1, i + 1
        if closed:
            before, after = before % n, after % n
        else:
            before, after = max(before, 0), min(after, n - 1)
        d_before = (x - nodes[before, 0]) ** 2 + (y - nodes[before, 1]) ** 2
        d_after = (x - nodes[after, 0]) ** 2 + (y - nodes[after, 1]) ** 2
        if d_before < d and d_before <= d_after:
            i, d = before, d_before
        elif d_after < d:
            i, d = after, d_after
        else:
            break
    c, s, k = nodes[i, 2], nodes[i, 3], nodes[i, 4]
    dx, dy = x - nodes[i, 0], y - nodes[i, 1]
    ahead, left = dx * c + dy * s, dy * c - dx * s
    # The road near a sample is the circle through it; the angle to the foot is small.
    inward = 1.0 - k * left
    along = ahead / inward if inward > 0.2 else ahead
    offset = (2.0 * left - k * (ahead * ahead + left * left)) / (1.0 + np.sqrt((k * ahead) ** 2 + inward**2))
    turn = k * along
    return nodes[i, 5] + along, offset, c - turn * s, s + turn * c, k


@njit(cache=True, error_model="numpy")
@no_type_check
def painted_share(s, width_a, width_b, stretches, first, last):
    """Share of a pixel that lies on painted stretches along the road (rows first..last, ascending)."""
    half = 0.5 * (abs(width_a) + abs(width_b))
    low, high = first, last
    while low < high:  # the first stretch that ends beyond the pixel's start
        middle = (low + high) // 2
        if stretches[middle, 1] > s - half:
            high = middle
        else:
            low = middle + 1
    share = 0.0
    while low < last and stretches[low, 0] < s + half:
        share += box_share(s - stretches[low, 0], width_a, width_b)
        share -= box_share(s - stretches[low, 1], width_a, width_b)
        low += 1
    return min(max(share, 0.0), 1.0)


@njit(cache=True, error_model="numpy")
@no_type_check
def bilinear(texture, column, row):
    """Sample a square texture that repeats; its side is a power of two."""
    mask = texture.shape[0] - 1
    c0, r0 = int(np.floor(column)), int(np.floor(row))
    fc, fr = column - c0, row - r0
    c0, r0 = c0 & mask, r0 & mask
    c1, r1 = (c0 + 1) & mask, (r0 + 1) & mask
    upper = texture[r0, c0] * (1.0 - fc) + texture[r0, c1] * fc
    lower = texture[r1, c0] * (1.0 - fc) + texture[r1, c1] * fc
    return upper * (1.0 - fr) + lower * fr


@njit(cache=True, error_model="numpy")
@no_type_check
def joint_share(position, period, width, width_a, width_b):
    """Share of a pixel on the nearest of evenly spaced joints."""
    d = position - period * np.floor(position / period + 0.5)
    if abs(d) >= 0.5 * (width + abs(width_a) + abs(width_b)):
        return 0.0
    return box_share(d + 0.5 * width, width_a, width_b) - box_share(d - 0.5 * width, width_a, width_b)
