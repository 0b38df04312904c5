"""The line of a lane that is not seen, told by the other one: a lane's width beside it, at corners as well.

At a corner the inner line turns before the outer one, beside the car and out of view, while the outer one
shows the corner further ahead. So the line that is seen is followed beyond the label rows, and what is a
lane's width away from all of it is the other line.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from lanenet.geometry.lane import ROWS_CM
from lanenet.perception.edges.road import RoadEdges
from lanenet.perception.network.refinement import line_at

#: How far the next edge point of a border may be, and how far before the last one. Tried: with 5, 7 and 9 cm
#: the points that turn out too near to the line have 37, 40 and 43 % of the squared errors on 120 simulated
#: drives.
_NEXT_CM, _BACK_CM = 9.0, 0.5
#: Least cosine between a border's direction and that at the next edge point. Chosen: corners of up to 99
#: degrees.
_LEAST_COSINE = -0.15
#: Weight of an edge point's own direction against that of the border so far. Chosen: a corner counts at once.
_TURNED = 2.0
#: Where edge points count: this length before the last label row, and so many widths ahead and beside.
#: Chosen.
_BEFORE_CM, _REACH = 3.0, 1.5
#: Distance of the points of a followed line, and how far behind the front axle it goes on straight. Chosen.
_APART_CM, _BEHIND_CM = 2.0, 30.0
#: Share of a frame in the width that both lines show; and deviation from the lane's width, as a share of it,
#: from which it counts. Chosen: bends and worn tape give less.
_GAIN, _DEVIATION = 0.3, 0.1
#: Sigma of that width once one line only is seen, as a share of the deviation: at first, and per frame. So
#: many frames it is known. On 168 simulated drives of seven seeds the RMSE is 1.28 instead of 1.39 cm for it,
#: and 0.3 % fewer points are answered. Tried: 0.05 per frame, and deviations from 0.06 on, gave the same.
_AT_FIRST, _PER_FRAME, _KNOWN_FRAMES = 0.1, 0.1, 60
_FAR_CM = ROWS_CM[-1]
_ROWS, _ALONG_CM = np.array(ROWS_CM), np.arange(-_BEHIND_CM, _FAR_CM + 1e-9, _APART_CM)


class SeenLine(NamedTuple):
    """A line that a frame shows.

    Attributes:
        side: 0 for the lane's left line, 1 for the right one.
        points_cm: x at the label rows, frame car.
        far: Whether it is seen at the last of them.
        marking_cm: Width of its marking, negative for one that is darker than the floor.
    """

    side: int
    points_cm: Float[np.ndarray, "3"]
    far: bool
    marking_cm: float

    @property
    def inwards(self) -> float:
        """Which way its lane lies: 1 to the right, -1 to the left."""
        return 1.0 if self.side == 0 else -1.0


class WidthHere:
    """How wide a lane was where both of its lines were last seen: some widen, and not where nobody looks."""

    def __init__(self) -> None:
        """Know of nothing but the lane's usual width."""
        self.reset()

    def reset(self) -> None:
        """Forget what earlier frames showed."""
        self._width_cm, self._frames = math.nan, 0

    def look(self, across_cm: float | None) -> None:
        """Take a frame.

        Args:
            across_cm: The distance of the two lines, if both are seen.
        """
        if across_cm is None:
            self._frames += 1
            if self._frames > _KNOWN_FRAMES:
                self.reset()
            return
        before_cm = across_cm if math.isnan(self._width_cm) else self._width_cm
        self._width_cm, self._frames = before_cm + _GAIN * (across_cm - before_cm), 0

    def instead_of(self, width_cm: float) -> tuple[float, float]:
        """Return the lane's width here and its sigma, [cm]: the usual one, and 0, unless they differ."""
        off_cm = self._width_cm - width_cm
        # Not a number where nothing was seen.
        if not abs(off_cm) > _DEVIATION * width_cm:
            return width_cm, 0.0
        return self._width_cm, abs(off_cm) * (_AT_FIRST + _PER_FRAME * self._frames)


def line_beside(line: SeenLine, width_cm: float, edges: RoadEdges) -> Float[np.ndarray, "3"]:
    """Return the lane's other line at the label rows, frame car; NaN where it cannot be told.

    Args:
        line: The line that is seen.
        width_cm: The lane's width.
        edges: The frame's edge points.
    """
    x, slope = (values[0] for values in line_at(line.points_cm[None], np.maximum(_ALONG_CM, 0.0)[None]))
    x_cm, y_cm = x + slope * np.minimum(_ALONG_CM, 0.0), _ALONG_CM
    if line.far and (ahead := _followed(line, width_cm, edges)):
        x_ahead, y_ahead = zip(*ahead, strict=True)
        x_cm, y_cm = np.append(x_cm, x_ahead), np.append(y_cm, y_ahead)
    # Each point keeps a circle free. The line is where the row leaves the last one.
    ahead_cm = y_cm - _ROWS[:, None]
    half_cm = np.sqrt(np.maximum(width_cm * width_cm - ahead_cm * ahead_cm, 0.0))
    reach_cm = np.where(np.abs(ahead_cm) < width_cm, line.inwards * x_cm + half_cm, -np.inf)
    last = reach_cm.argmax(axis=1)
    # At an end of the line, what is beyond would count as well.
    told = (last > 0) & (last < len(x_cm) - 1)
    return np.where(told, line.inwards * reach_cm.max(axis=1), np.nan)


def _followed(line: SeenLine, width_cm: float, edges: RoadEdges) -> list[tuple[float, float]]:
    """Follow a line from the last label row on, for a lane's width, by its border on the lane's side.

    Returns:
        x and y of its middle, [cm], frame car; none where no border is found.
    """
    near_cm, middle_cm = (float(line.points_cm[i]) for i in (-2, -1))
    half_cm = 0.5 * line.inwards * abs(line.marking_cm)
    x, y = edges.points_cm.T
    ahead = (y > _FAR_CM - _BEFORE_CM) & (y < _FAR_CM + _REACH * width_cm)
    ahead &= np.abs(x - middle_cm) < _REACH * width_cm
    if not ahead.any():
        return []
    x, y = x[ahead].astype(np.float64), y[ahead].astype(np.float64)
    # The marking lies on one side of its border: so an edge's normal tells which way along it is ahead.
    bright = line.inwards * math.copysign(1.0, line.marking_cm)
    along_x, along_y = bright * edges.normals[ahead, 1], -bright * edges.normals[ahead, 0]
    at_x, at_y = middle_cm + half_cm, _FAR_CM
    heading_x, heading_y = middle_cm - near_cm, ROWS_CM[-1] - ROWS_CM[-2]
    found: list[tuple[float, float]] = []
    length_cm = 0.0
    while length_cm < width_cm:
        norm = math.hypot(heading_x, heading_y)
        heading_x, heading_y = heading_x / norm, heading_y / norm
        off_x, off_y = x - at_x, y - at_y
        further_cm = off_x * along_x + off_y * along_y
        next_ = (off_x * off_x + off_y * off_y < _NEXT_CM * _NEXT_CM) & (further_cm > _BACK_CM)
        next_ &= along_x * heading_x + along_y * heading_y > _LEAST_COSINE
        next_ &= off_x * heading_x + off_y * heading_y > -_BACK_CM
        best = int(np.where(next_, further_cm, 0.0).argmax())
        if not next_[best]:
            break
        step_x, step_y = float(off_x[best]), float(off_y[best])
        step_cm = math.hypot(step_x, step_y)
        pieces = max(1, round(step_cm / _APART_CM))
        # The marking's middle lies half its width away from the border, and from the lane.
        from_x, from_y = at_x - half_cm * step_y / step_cm, at_y + half_cm * step_x / step_cm
        found += [(from_x + step_x * i / pieces, from_y + step_y * i / pieces) for i in range(1, pieces + 1)]
        at_x, at_y, length_cm = at_x + step_x, at_y + step_y, length_cm + step_cm
        heading_x += _TURNED * float(along_x[best])
        heading_y += _TURNED * float(along_y[best])
    return found
