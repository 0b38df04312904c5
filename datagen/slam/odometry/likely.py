"""The edge points of a frame that are most likely borders of markings, where a textured floor has too many.

A marking's border is straight over some pixels, and on one side of it lies the marking, a strip as wide as
tape without an edge. The grains of a carpet or of a foam mat have neither: their borders bend within a few
pixels, and the next grain follows. Contrast tells less, for a grain may be as bright as tape.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from jaxtyping import UInt8
from numba import njit

from lanenet.perception.edges.pixels import EdgePixels

#: Edge points of a frame that are mapped at most. Measured in whole images: the real tubs, 160 and 320 px
#: wide, have 1,300 to 2,200 (median) and 1,800 to 3,200 (95 % of the frames), simulated tape on plain floors,
#: 640 px wide, 2,700 to 5,000 and 3,500 to 6,300; carpets, on the road alone, 32,000.
MOST_POINTS = 6000
#: Pixels along a border to either side, and across it to one side, that are looked at. Measured on a carpet,
#: 640 x 480 px, of whose edge points 18 % are kept: among them are 89 % of the tape's borders within three
#: camera heights, and 87 to 89 % with 4 to 20 px along and twice as many across; by contrast alone 68 %.
_ALONG_PX, _ACROSS_PX = 8, 40
#: Edges face the same way where their normals have at least this cosine. Chosen: 37 degrees.
_ALIKE = 0.8


def likely_markings(edges: EdgePixels, keep: UInt8[np.ndarray, "h w"]) -> EdgePixels:
    """Keep at most :data:`MOST_POINTS` edge points of a frame, those that are most like a marking's border.

    Args:
        edges: Edge points of the frame.
        keep: Pixels in which they were looked for, 0 elsewhere.

    Returns:
        The same points where they are not too many, else the chosen ones in their order.
    """
    if len(edges.uv_px) <= MOST_POINTS:
        return edges
    at = np.where(keep > 0, -1, -2).astype(np.int32)
    score = np.empty(len(edges.uv_px))
    _rate(edges.uv_px, edges.normals, at, score)
    chosen = np.sort(np.argsort(-score, kind="stable")[:MOST_POINTS])
    return EdgePixels(edges.uv_px[chosen], edges.normals[chosen])


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def _rate(uv, normals, at, score):
    """Rate edges: how far each goes on straight, times how wide the strip without an edge beside it is.

    Args:
        uv: Edges of a frame.
        normals: Their unit gradients.
        at: -1 where edges were looked for, else -2; filled with the edges' indices.
        score: Filled, [px^2].
    """
    height, width = at.shape
    for p in range(len(uv)):
        u, v = int(np.rint(uv[p, 0])), int(np.rint(uv[p, 1]))
        at[min(max(v, 0), height - 1), min(max(u, 0), width - 1)] = p
    for p in range(len(uv)):
        u, v, nu, nv = uv[p, 0], uv[p, 1], normals[p, 0], normals[p, 1]
        along, across = 1, 0
        for sign in (-1.0, 1.0):
            for k in range(1, _ALONG_PX + 1):
                goes_on = False
                for aside in (0.0, -1.0, 1.0):
                    column = int(np.rint(u - sign * k * nv + aside * nu))
                    row = int(np.rint(v + sign * k * nu + aside * nv))
                    if 0 <= column < width and 0 <= row < height:
                        q = at[row, column]
                        goes_on = goes_on or (q >= 0 and normals[q, 0] * nu + normals[q, 1] * nv > _ALIKE)
                if not goes_on:
                    break
                along += 1
            # The pixel next to an edge may be its own chain.
            free = 2
            while free < _ACROSS_PX:
                column, row = int(np.rint(u + sign * free * nu)), int(np.rint(v + sign * free * nv))
                if not (0 <= column < width and 0 <= row < height) or at[row, column] != -1:
                    break
                free += 1
            across = max(across, free)
        score[p] = along * across
