"""Runs of edge points: neighbours in the picture that face the same way, chained."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

_REACH_PX = 2.0  # between neighbours: a pixel's diagonal, and sub-pixel shifts on either side
_SAME_WAY = math.cos(math.radians(30.0))
_LEAST_POINTS = 6
_LEAST_HEIGHTS = 0.5


@dataclass(frozen=True, eq=False)
class Runs:
    """Runs of the edge points of one frame.

    Attributes:
        of_point: Number of each point's run.
        points: Points of each run, about its length in pixels.
        extent_cm: Diagonal of the box that holds each run on the road.
    """

    of_point: Int[np.ndarray, "n"]
    points: Int[np.ndarray, "k"]
    extent_cm: Float[np.ndarray, "k"]

    def are_short(self, camera_height_cm: float) -> Bool[np.ndarray, "k"]:
        """Tell which runs are too short to be told from clutter.

        These are runs of less than half a camera height on the road, or of fewer than six points. Ends of
        dashes are among them, on real roads as on synthetic ones.
        """
        return (self.points < _LEAST_POINTS) | (self.extent_cm < _LEAST_HEIGHTS * camera_height_cm)


def chain_points(
    uv_px: Float[np.ndarray, "n 2"],
    normals: Float[np.ndarray, "n 2"],
    road_cm: Float[np.ndarray, "n 2"],
    round_corners: bool = False,
) -> Runs:
    """Chain edge points to runs.

    Two points belong together where they are within two pixels and their directions within 30 degrees, so
    that a run ends at a corner, and the two edges of a thin line are two runs.

    Args:
        uv_px: Positions, frame image.
        normals: Unit gradients, image axes.
        road_cm: The same points on the road.
        round_corners: Chain neighbours whatever their directions, so that an outline is one run.
    """
    n = len(uv_px)
    if n == 0:
        return Runs(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))
    pairs = cKDTree(uv_px).query_pairs(_REACH_PX, output_type="ndarray")
    if not round_corners:
        pairs = pairs[np.einsum("ij,ij->i", normals[pairs[:, 0]], normals[pairs[:, 1]]) > _SAME_WAY]
    a, b = pairs.T
    count, of_point = connected_components(coo_array((np.ones(len(a)), (a, b)), shape=(n, n)), directed=False)
    order = np.argsort(of_point, kind="stable")
    starts = np.searchsorted(of_point[order], np.arange(count))
    sides = np.maximum.reduceat(road_cm[order], starts) - np.minimum.reduceat(road_cm[order], starts)
    return Runs(
        of_point.astype(np.int64),
        np.bincount(of_point, minlength=count).astype(np.int64),
        np.hypot(sides[:, 0], sides[:, 1]).astype(np.float64),
    )
