"""Inner loops of the odometry from pictures: which edge is near a pixel, and how well a motion fits."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

#: Directions that edges are told apart by; each edge counts for the two nearest.
SECTORS = 8
#: Pixels around an edge from which it is found.
REACH = 2


@njit(cache=True, error_model="numpy")
@no_type_check
def index_edges(uv, sector, nearest, distance):
    """Enter for each pixel and sector the nearest edge around it.

    Args:
        uv: Edge pixels of a frame.
        sector: Direction of each in sectors, as a real number.
        nearest: Filled: index of the edge, -1 without one.
        distance: Of the same shape, for the squared distances.
    """
    nearest[:] = -1
    distance[:] = 1e9
    _, height, width = nearest.shape
    for q in range(uv.shape[0]):
        u0, v0 = int(np.rint(uv[q, 0])), int(np.rint(uv[q, 1]))
        first = int(np.floor(sector[q]))
        for v in range(max(v0 - REACH, 0), min(v0 + REACH + 1, height)):
            for u in range(max(u0 - REACH, 0), min(u0 + REACH + 1, width)):
                d = (u - uv[q, 0]) ** 2 + (v - uv[q, 1]) ** 2
                for s in (first % SECTORS, (first + 1) % SECTORS):
                    if d < distance[s, v, u]:
                        distance[s, v, u] = d
                        nearest[s, v, u] = q


@njit(cache=True, error_model="numpy")
@no_type_check
def fit_of_motions(
    points, sector, uv, normals, nearest, pixel_of, origin, cell, ways, turns, sigma_px, gain, out, unseen
):
    """Add up how well each motion carries the points of one frame onto the edges of a later one.

    Args:
        points: Points of the earlier frame, ahead and left of its rear axle.
        sector: Sector of each.
        uv: Edge pixels of the later frame.
        normals: Their normals.
        nearest: See :func:`index_edges`, of the later frame.
        pixel_of: Pixel of each point of a grid on the road, NaN where the camera does not see it.
        origin: Ahead and left of the grid's first point.
        cell: Its spacing.
        ways: Ways of the rear axle to try.
        turns: Turns to try, positive left.
        sigma_px: Standard deviation of an edge's place across itself.
        gain: How much likelier a place is on an edge than off it.
        out: The sums over the points that stay in view, a row per way and a column per turn.
        unseen: Of the same shape: number of points that leave the view.
    """
    height, width = nearest.shape[1:]
    rows, columns = pixel_of.shape[:2]
    for a in range(ways.shape[0]):
        for b in range(turns.shape[0]):
            c, s = np.cos(turns[b]), np.sin(turns[b])
            dx, dy = ways[a] * np.cos(0.5 * turns[b]), ways[a] * np.sin(0.5 * turns[b])
            total, lost = 0.0, 0
            for p in range(points.shape[0]):
                x, y = points[p, 0] - dx, points[p, 1] - dy
                gx, gy = (c * x + s * y - origin[0]) / cell, (c * y - s * x - origin[1]) / cell
                ix, iy = int(np.floor(gx)), int(np.floor(gy))
                if not (0 <= ix < rows - 1 and 0 <= iy < columns - 1):
                    lost += 1
                    continue
                tx, ty = gx - ix, gy - iy
                w00, w01 = (1.0 - tx) * (1.0 - ty), (1.0 - tx) * ty
                w10, w11 = tx * (1.0 - ty), tx * ty
                p00, p01 = pixel_of[ix, iy], pixel_of[ix, iy + 1]
                p10, p11 = pixel_of[ix + 1, iy], pixel_of[ix + 1, iy + 1]
                u = w00 * p00[0] + w01 * p01[0] + w10 * p10[0] + w11 * p11[0]
                v = w00 * p00[1] + w01 * p01[1] + w10 * p10[1] + w11 * p11[1]
                if not (0.0 <= u <= width - 1.0 and 0.0 <= v <= height - 1.0):
                    lost += 1
                    continue
                q = nearest[sector[p], int(v + 0.5), int(u + 0.5)]
                if q >= 0:
                    e = (u - uv[q, 0]) * normals[q, 0] + (v - uv[q, 1]) * normals[q, 1]
                    total += np.log1p(gain * np.exp(-0.5 * (e / sigma_px) ** 2))
            out[a, b], unseen[a, b] = total, lost
