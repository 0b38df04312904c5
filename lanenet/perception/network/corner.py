"""A line at a corner of its tape: up to there it is seen, and beyond there is only floor.

A parabola goes straight on where tape is laid in two pieces. Each border, moved by half the marking's width,
lies on the middle of the tape; so the tape is where both borders meet, whichever way it runs. Where it goes
on from the line, but aside, and nothing more of it lies on the line itself, the line has turned.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from lanenet.perception.network import compiled
from lanenet.perception.network.refinement import BASIS, RoadBorders, line_at

#: The part of the road that is looked at, ahead of the front axle and to both sides of the line.
_NEAR_CM, _FAR_CM, _FARTHEST_CM = -4.0, 45.0, 30.0
#: A border is the line's own within this distance, and from this cosine of the directions on.
_OWN_CM, _OWN_COSINE = 1.2, 0.8
#: It belongs to tape that runs aside from this distance on, and below this cosine, of 20 degrees.
_ASIDE_CM, _ASIDE_COSINE = 2.5, math.cos(math.radians(20.0))
#: The two borders of a tape meet within this distance, with normals that are at least that opposite.
_MEET_CM, _OPPOSITE = 1.3, -0.8
#: Tape goes on at the next edge point within this distance.
_NEXT_CM = 4.0
#: Least number of edge points aside, and what they span.
_LEAST, _SPAN_CM = 6, 6.0
#: From so far beyond the corner on, a line has fewer edge points of its own than this.
_BEYOND_CM, _GOES_ON = 4.0, 4
#: All of the above, as ``CornerNumbers`` of ``_kernels.cpp`` has them. On 144 simulated drives of six seeds
#: 0.1 % fewer points are answered for it, and the RMSE is 1.25 instead of 1.37 cm. Other numbers were tried
#: (1 to 1.8 cm apart, 4 to 7 to the next, 2 to 8 own ones beyond): 1.24 to 1.25 cm.
_NUMBERS = np.concatenate(
    [
        BASIS.ravel(),
        [
            _NEAR_CM,
            _FAR_CM,
            _FARTHEST_CM,
            _OWN_CM,
            _OWN_COSINE,
            _ASIDE_CM,
            _ASIDE_COSINE,
            _MEET_CM,
            _OPPOSITE,
        ],
        [_NEXT_CM, _LEAST, _SPAN_CM, _BEYOND_CM, _GOES_ON],
    ]
)
#: Points that are compared with all others at a time, without compiled loops.
_AT_A_TIME = 128


class Corner(NamedTuple):
    """Where the tape of a line turns off it.

    Attributes:
        ahead_cm: y of the corner, frame car.
        aside_cm: How far the tape gets beside the line on average, positive to the right.
        cosine: Of the angle by which it turns, from 0 to less than 180 degrees.
    """

    ahead_cm: float
    aside_cm: float
    cosine: float

    def of_other_cm(self, side: int, width_cm: float) -> float:
        """Return y at which the lane's other line turns: the inner one of a corner does before the outer one.

        Args:
            side: Of the line that is seen, 0 for the left one.
            width_cm: The lane's width.
        """
        before_cm = width_cm * math.sqrt((1.0 - self.cosine) / (1.0 + self.cosine))
        is_outer = (self.aside_cm > 0.0) == (side == 0)
        return self.ahead_cm - before_cm if is_outer else self.ahead_cm + before_cm


def corners(
    points_cm: Sequence[Sequence[float]], markings_cm: Sequence[float], borders: RoadBorders
) -> list[Corner | None]:
    """Find the corners at which tape turns off lines.

    Args:
        points_cm: x of each line at the label rows, frame car.
        markings_cm: Widths of their markings, negative for those that are darker than the floor.
        borders: The frame's edge points.

    Returns:
        Of each line its corner, if it has one.
    """
    if not points_cm:
        return []
    lines = np.array([(*line_cm, width_cm) for line_cm, width_cm in zip(points_cm, markings_cm, strict=True)])
    if compiled.is_here():
        found = compiled.corners(lines, borders.edges, _NUMBERS).tolist()
    else:
        found = [_corner(line, borders) for line in lines]
    return [None if math.isnan(ahead_cm) else Corner(ahead_cm, *more) for ahead_cm, *more in found]


def _corner(line: Float[np.ndarray, "4"], borders: RoadBorders) -> list[float]:
    """Find the corner of one line, given by its points and its marking; not a number if there is none."""
    nowhere = [math.nan] * 3
    edges = borders.edges
    normals = edges.normals.astype(np.float64)
    x, y = (edges.points_cm.astype(np.float64) + normals * (0.5 * line[3])).T
    normal_x, normal_y = normals.T
    (line_cm,), (slope,) = line_at(line[None, :3], y[None])
    steep, off_cm = 1.0 + slope * slope, x - line_cm
    near = (y > _NEAR_CM) & (y < _FAR_CM) & (off_cm * off_cm < _FARTHEST_CM * _FARTHEST_CM * steep)
    across = 1.0 / np.sqrt(steep)
    off_cm *= across
    along = np.abs(normal_x - normal_y * slope) * across
    x, y, normal_x, normal_y, off_cm, along = (v[near] for v in (x, y, normal_x, normal_y, off_cm, along))
    own = (np.abs(off_cm) < _OWN_CM) & (along > _OWN_COSINE)
    aside = (np.abs(off_cm) > _ASIDE_CM) & (along < _ASIDE_COSINE)
    if own.sum() < _LEAST or aside.sum() < _LEAST:
        return nowhere
    of_tape, next_to = _neighbours(x, y, normal_x, normal_y)
    tape_beside = of_tape & ~own
    start = tape_beside & (np.abs(off_cm) < _OWN_CM + _NEXT_CM) & next_to[own].any(axis=0)
    turned = aside & _connected(start, tape_beside, next_to)
    if turned.sum() < _LEAST:
        return nowhere
    span_x, span_y = np.ptp(x[turned]), np.ptp(y[turned])
    if span_x * span_x + span_y * span_y < _SPAN_CM * _SPAN_CM:
        return nowhere
    apart_x, apart_y = x[turned] - x[own, None], y[turned] - y[own, None]
    nearest = (apart_x * apart_x + apart_y * apart_y).min(axis=1).argmin()
    ahead_cm = y[own][nearest]
    if (own & of_tape & (y > ahead_cm + _BEYOND_CM)).sum() >= _GOES_ON:
        return nowhere
    aside_cm, cosine, far_cm = (sum(v[turned].tolist()) / int(turned.sum()) for v in (off_cm, along, y))
    # Tape that runs back has turned by more than a right angle.
    return [float(ahead_cm), aside_cm, -cosine if far_cm < ahead_cm else cosine]


def _neighbours(
    x: Float[np.ndarray, "n"],
    y: Float[np.ndarray, "n"],
    normal_x: Float[np.ndarray, "n"],
    normal_y: Float[np.ndarray, "n"],
) -> tuple[Bool[np.ndarray, "n"], Bool[np.ndarray, "n n"]]:
    """Return which points have the other border of their tape where they are, and which are next to which."""
    n = len(x)
    of_tape, next_to = np.zeros(n, dtype=bool), np.zeros((n, n), dtype=bool)
    # Some points at a time: all pairs of a crowded frame would take hundreds of megabytes.
    for begin in range(0, n, _AT_A_TIME):
        some = slice(begin, begin + _AT_A_TIME)
        apart_x, apart_y = x - x[some, None], y - y[some, None]
        apart2 = apart_x * apart_x + apart_y * apart_y
        opposite = normal_x * normal_x[some, None] + normal_y * normal_y[some, None] < _OPPOSITE
        of_tape[some] = (opposite & (apart2 < _MEET_CM * _MEET_CM)).any(axis=1)
        next_to[some] = apart2 < _NEXT_CM * _NEXT_CM
    return of_tape, next_to


def _connected(
    start: Bool[np.ndarray, "n"], there: Bool[np.ndarray, "n"], next_to: Bool[np.ndarray, "n n"]
) -> Bool[np.ndarray, "n"]:
    """Return which points hang together with those at the start."""
    reached, latest = start, start
    while latest.any():
        latest = there & ~reached & next_to[latest].any(axis=0)
        reached = reached | latest
    return reached
