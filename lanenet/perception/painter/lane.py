"""What the two lines of the painter say of the lane on the road: radius, offset and the point to aim at."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lanenet.geometry.lane import ROWS_CM
from lanenet.perception.painter.curves import curvature_radius, mean_curve
from lanenet.perception.painter.markings import Pair


@dataclass(frozen=True)
class PaintedLane:
    """Radius and offset of the lane on the road in the last frame; needs a calibrated camera.

    Attributes:
        radius_cm: Radius of curvature of the lane's middle at its near end; infinite where both lines are
            straight, NaN where a line is unknown.
        offset_cm: How far the car is to the right of the lane's centre line, at the nearest row that both
            lines reach; NaN without one.
    """

    radius_cm: float = float("nan")
    offset_cm: float = float("nan")

    @property
    def text(self) -> str:
        """Both figures for people; empty where neither is known."""
        parts = []
        if not math.isnan(self.radius_cm):
            parts.append(f"R {self.radius_cm:.0f} cm" if self.radius_cm < 1e4 else "straight")
        if math.isfinite(self.offset_cm):
            side = "right" if self.offset_cm > 0.0 else "left"
            parts.append(f"{abs(self.offset_cm):.1f} cm {side} of the middle")
        return "  ".join(parts)


def measure_lane(found: Pair, rows_cm: Float[np.ndarray, "2 3"]) -> PaintedLane:
    """Measure radius and offset of a lane on the road.

    The radius is that of the mean of both parabolas. If only one line is curved, the other was seen over too
    short a section to show a bend, and the radius is that of the curved one.

    Args:
        found: The two lines; both are needed.
        rows_cm: x of both at the label rows, [cm], frame car; NaN where unknown.
    """
    left, right = found
    if left is None or right is None:
        return PaintedLane()
    curves = [marking.curve for marking in (left, right) if marking.curve is not None]
    radius_cm = math.inf
    if curves:
        middle = curves[0] if len(curves) == 1 else mean_curve(curves[0], curves[1])
        radius_cm = curvature_radius(middle, middle.near)
    middle_cm = rows_cm.mean(axis=0)
    known = np.flatnonzero(np.isfinite(middle_cm))
    offset_cm = -float(middle_cm[known[0]]) if len(known) else float("nan")
    return PaintedLane(radius_cm, offset_cm)


def find_aim_cm(found: Pair, look_ahead_cm: float) -> tuple[float, float] | None:
    """Return the aim point, (x, y) in cm, frame car: the lane's centre at the look-ahead distance.

    It is moved to the nearest distance at which both lines are seen; None if there is no such distance.
    """
    left, right = found
    if left is None or right is None or len(left.points) == 0 or len(right.points) == 0:
        return None
    near = max(float(left.points[0, 1]), float(right.points[0, 1]))
    far = min(float(left.points[-1, 1]), float(right.points[-1, 1]))
    y = min(max(look_ahead_cm, near), far)
    # Behind or beside the axle nothing can be aimed at.
    if far < near or y < ROWS_CM[1]:
        return None
    lines = (left.points, right.points)
    return 0.5 * sum(float(np.interp(y, line[:, 1], line[:, 0])) for line in lines), y
