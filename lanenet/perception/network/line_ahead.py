"""A line beyond the label rows, followed along one border of its marking.

Where only one line of a lane is seen, the other one lies a lane's width beside it, as far as the first goes on
as it does within the label rows. At a corner it does not: the inner line turns before the outer one, and out
of view. The outer one shows the corner ahead.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float

from lanenet.geometry.lane import ROWS_CM
from lanenet.perception.edges.road import RoadEdges

#: How far the next edge point of a border may be, tried from 5 to 9 cm, and how far before the last one. Chosen.
_STEP_CM, _BACK_CM = 9.0, 0.5
#: Least cosine between a border's direction and that at the next edge point. Chosen: corners of up to 99 degrees.
_LEAST_COSINE = -0.15
#: Points nearer to a line than this share of the lane's width cannot be on the lane's other line. Tried: from 0.8
#: to 0.97.
_TOO_NEAR = 0.9
#: Length before the last label row from which edge points count. Chosen.
_BEFORE_CM = 3.0


def lie_too_near(
    told_cm: Float[np.ndarray, "3"],
    seen_cm: Float[np.ndarray, "3"],
    side: int,
    marking_cm: float,
    width_cm: float,
    edges: RoadEdges,
) -> Bool[np.ndarray, "3"]:
    """Return which points of a line that is not seen lie nearer to the seen one than lines of a lane do.

    Args:
        told_cm: The line that is not seen at the label rows, frame car.
        seen_cm: The other one, likewise.
        side: 0 if the left line is seen, 1 if the right one is.
        marking_cm: Width of its marking, negative for one that is darker than the floor.
        width_cm: The lane's width.
        edges: The frame's edge points.
    """
    told = np.column_stack([told_cm, ROWS_CM])
    border = _border_ahead(seen_cm, side, marking_cm, width_cm, edges)
    if border is None:
        return np.zeros(len(ROWS_CM), dtype=bool)
    off_cm = np.hypot(*(told[:, None] - border).transpose(2, 0, 1)).min(axis=1)
    return off_cm < _TOO_NEAR * width_cm - 0.5 * abs(marking_cm)


def _border_ahead(
    seen_cm: Float[np.ndarray, "3"], side: int, marking_cm: float, width_cm: float, edges: RoadEdges
) -> Float[np.ndarray, "n 2"] | None:
    """Follow the border of a marking on the lane's side from the last label row on, for a lane's width."""
    inwards = 1.0 if side == 0 else -1.0
    near_cm = ROWS_CM[-1] - _BEFORE_CM
    place = np.array([seen_cm[-1] + inwards * 0.5 * abs(marking_cm), ROWS_CM[-1]])
    along = np.array([seen_cm[-1] - seen_cm[-2], ROWS_CM[-1] - ROWS_CM[-2]])
    along /= math.hypot(*along)
    x, y = edges.points_cm.T
    ahead = np.flatnonzero((y > near_cm) & (y < near_cm + 1.5 * width_cm) & (np.abs(x - place[0]) < 1.5 * width_cm))
    points = edges.points_cm[ahead].astype(np.float64)
    # An edge has the marking on one side: so its normal tells which way along it is ahead.
    bright = inwards * math.copysign(1.0, marking_cm)
    directions = bright * edges.normals[ahead][:, ::-1] * (1.0, -1.0)
    found, length_cm = [], 0.0
    while length_cm < width_cm:
        off = points - place
        further_cm = (off * directions).sum(axis=1)
        next_ = (off * off).sum(axis=1) < _STEP_CM**2
        next_ &= (directions @ along > _LEAST_COSINE) & (off @ along > -_BACK_CM) & (further_cm > _BACK_CM)
        if not next_.any():
            break
        best = int(np.where(next_, further_cm, 0.0).argmax())
        length_cm += float(further_cm[best])
        place = points[best]
        along = along + 2.0 * directions[best]
        along /= math.hypot(*along)
        found.append(place)
    return np.array(found) if found else None
