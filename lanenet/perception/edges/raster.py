"""What a network sees: the cells that hold an edge point, and for each its direction and its colours."""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8

from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.perception.edges import compiled
from lanenet.perception.edges.road import RoadEdges

#: Planes of a raster: whether the cell holds an edge point, 0 or 255; and for the last of its points x and y
#: of the normal towards the brighter side, and by how much it gets yellower and redder along it. These have
#: ``MIDDLE`` for nothing, and for -1 and 1 ``STEPS`` less and more.
PLANES = ("edge", "normal_x", "normal_y", "yellow", "red")
MIDDLE, STEPS = 128, 127


def new_raster(window: BirdseyeWindow, planes: int = len(PLANES)) -> UInt8[np.ndarray, "p r c"]:
    """Return memory for a raster of the first ``planes`` planes."""
    return np.zeros((planes, window.rows, window.columns), np.uint8)


def fill_raster(
    window: BirdseyeWindow, edges: RoadEdges, out: UInt8[np.ndarray, "p r c"]
) -> UInt8[np.ndarray, "p r c"]:
    """Write edge points into a raster.

    Args:
        window: Which patch of road, and its cells.
        edges: The frame's edge points, in single precision, as label sets hold them.
        out: One plane, or all of them; written.

    Returns:
        ``out``.
    """
    looks = edges.points_cm, edges.normals, edges.hues
    if compiled.is_here() and out.flags.c_contiguous:
        compiled.raster(window, looks, out, MIDDLE, STEPS)
        return out
    if len(out) == 1:
        window.rasterise(edges.points_cm, out=out[0])
        return out
    out[0], out[1:] = 0, MIDDLE
    row, column, inside = window.places(edges.points_cm)
    out[0, row, column] = 255
    # In turn, not at once: of several points in a cell the last one counts in every plane.
    for plane, values in enumerate(
        (*edges.normals.T, *(() if edges.hues is None else edges.hues.T)), start=1
    ):
        looks = np.rint(np.float32(STEPS) * values[inside])
        out[plane, row, column] = (looks + MIDDLE).astype(np.uint8)
    return out
