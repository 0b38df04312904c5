"""The lane beyond a junction: its lines further ahead than the label rows, about where it goes straight on.

What a car finds there tells more of where the lane goes on than the direction in which it went before.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from lanenet.geometry.lane import ROWS_CM
from lanenet.perception.edges.road import RoadEdges
from lanenet.perception.network.refinement import RoadBorders, refined

_ROWS = np.array(ROWS_CM)
#: The label rows are moved ahead by so much, so that the window of the networks ends at the last of the bins
#: along a line; and y of their middle.
_AHEAD_CM = 45.0
_MIDDLE_CM = _AHEAD_CM + ROWS_CM[1]
#: How far from where the lane goes straight on it may be there, as a share of its width, and by how much its
#: slope, dx/dy, may differ; steps of both. In 278 frames at junctions of 29 simulated roads these limits, and
#: lines seen over 12 cm, leave 101 lanes that are 0.15 cm off (median) and 2.8 cm at most, 60 cm ahead, where
#: the lane that goes straight on is 4.7 cm off. With 0.5, 0.4 and 6 cm 14 of 148 are more than 6 cm off.
_BESIDE, _TURNED, _OFFSETS, _SLOPES = 0.4, 0.35, 9, 7
#: The same for what is found. Chosen: half a step more.
_MOST_BESIDE, _MOST_TURNED = 0.45, 0.4
#: Length in which each line has to be seen, [cm], and by how much their distance may differ from the lane's
#: width, as a share. See above.
_SEEN_CM, _WIDTH = 12.0, 0.12
#: Distance and cosine up to which an edge point speaks for a line, before it is looked at closely. Chosen.
_NEAR_CM, _COSINE = 2.5, 0.8
#: Sigma of a line's place there before it is looked at closely, and of its marking's width. Chosen.
_SIGMA_CM, _MARKING_SIGMA_CM = 1.5, 0.3
#: What it costs, in centimetres of seen borders, that the width differs by all of itself, that the lane lies
#: a centimetre beside the expected place, and that its slope differs by 1. Chosen: a line that is only seen
#: at its far end has any slope.
_BY_WIDTH_CM, _BY_PLACE, _BY_SLOPE_CM = 20.0, 0.1, 20.0
#: Columns of a refined line: the length in which it is seen, and whether it is at each row.
_SEEN, _SEEN_AT = 7, slice(8, 11)


def lane_beyond(
    lines_cm: Float[np.ndarray, "2 3"], width_cm: float, markings_cm: Sequence[float], edges: RoadEdges
) -> Float[np.ndarray, "k 2"] | None:
    """Find the lane 41 to 87 cm ahead.

    Args:
        lines_cm: x of the lane's lines at the label rows if it goes straight on, frame car.
        width_cm: Its width.
        markings_cm: Width of the marking of each line, negative for one that is darker than the floor.
        edges: The frame's edge points.

    Returns:
        Points in the middle of the lane where both lines are seen, frame car; None if it is not found.
    """
    slope = float((lines_cm[:, -1] - lines_cm[:, 0]).mean()) / ROWS_CM[-1]
    expected_cm = float(lines_cm[:, 0].mean()) + slope * _MIDDLE_CM
    offsets_cm = np.linspace(-_BESIDE, _BESIDE, _OFFSETS) * width_cm
    turned = slope + np.linspace(-_TURNED, _TURNED, _SLOPES)
    middles_cm, slopes = (x.ravel() for x in np.meshgrid(expected_cm + offsets_cm, turned, indexing="ij"))
    aside_cm = 0.5 * width_cm * np.hypot(1.0, slopes)
    places_cm = middles_cm - aside_cm, middles_cm + aside_cm
    ahead_cm = np.array([0.0, _AHEAD_CM], edges.points_cm.dtype)
    borders = RoadBorders(RoadEdges(edges.points_cm - ahead_cm, edges.normals, edges.hues))
    support = [
        _support(x, slopes, marking_cm, borders) for x, marking_cm in zip(places_cm, markings_cm, strict=True)
    ]
    # Of each place the best direction.
    tried = np.minimum(*support).reshape(_OFFSETS, _SLOPES).argmax(axis=1) + _SLOPES * np.arange(_OFFSETS)
    left, right = (
        refined(_asked(x[tried], slopes[tried], marking_cm), borders)
        for x, marking_cm in zip(places_cm, markings_cm, strict=True)
    )
    slopes = 0.5 * (left[:, 2] - left[:, 0] + right[:, 2] - right[:, 0]) / ROWS_CM[-1]
    across = (right[:, :3] - left[:, :3]) / (width_cm * np.hypot(1.0, slopes))[:, None]
    misfit, middles_cm = np.abs(across - 1.0).max(axis=1), 0.5 * (left[:, 1] + right[:, 1])
    score_cm = left[:, _SEEN] + right[:, _SEEN] - _BY_WIDTH_CM * misfit
    score_cm -= _BY_PLACE * np.abs(middles_cm - expected_cm) + _BY_SLOPE_CM * np.abs(slopes - slope)
    is_lane = (np.minimum(left[:, _SEEN], right[:, _SEEN]) >= _SEEN_CM) & (misfit < _WIDTH)
    is_lane &= np.abs(slopes - slope) < _MOST_TURNED
    is_lane &= np.abs(middles_cm - expected_cm) < _MOST_BESIDE * width_cm
    best = int(np.where(is_lane, score_cm, -np.inf).argmax())
    both_seen = (left[best, _SEEN_AT] > 0.0) & (right[best, _SEEN_AT] > 0.0)
    if not is_lane[best] or not both_seen.any():
        return None
    middle_cm = 0.5 * (left[best, : len(_ROWS)] + right[best, : len(_ROWS)])
    return np.column_stack([middle_cm, _ROWS + _AHEAD_CM])[both_seen]


def _support(
    x_cm: Float[np.ndarray, "k"], slopes: Float[np.ndarray, "k"], marking_cm: float, borders: RoadBorders
) -> Int[np.ndarray, "k"]:
    """Return how many edge points of each straight line's borders there are, by its place in the middle."""
    near, half_cm = borders.near, 0.5 * marking_cm
    # Edge points moved to the middle of their marking.
    x, y = near.x + half_cm * near.normal_x, near.y + half_cm * near.normal_y
    slope, steep = slopes[:, None], np.hypot(1.0, slopes)[:, None]
    off_cm = x - (x_cm[:, None] + slope * (y - ROWS_CM[1]))
    along = near.normal_x - near.normal_y * slope
    return np.count_nonzero((np.abs(off_cm) < _NEAR_CM * steep) & (np.abs(along) > _COSINE * steep), axis=1)


def _asked(
    x_cm: Float[np.ndarray, "k"], slopes: Float[np.ndarray, "k"], marking_cm: float
) -> Float[np.ndarray, "k 10"]:
    """Return straight lines as :func:`lanenet.perception.network.refinement.refined` wants them."""
    points_cm = x_cm[:, None] + slopes[:, None] * (_ROWS - ROWS_CM[1])
    known = [*[_SIGMA_CM] * len(_ROWS), marking_cm, _MARKING_SIGMA_CM, math.nan, math.nan]
    return np.column_stack([points_cm, np.tile(known, (len(x_cm), 1))])
