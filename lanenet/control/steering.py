"""From a lane estimate to the angle of the front wheels."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from jaxtyping import Float
from pydantic import Field

from lanenet.config import Settings
from lanenet.geometry.lane import PARABOLA_FROM_POINTS, ROWS_CM
from lanenet.geometry.steering import proportional_angle_rad, pure_pursuit_angle_rad
from lanenet.perception.estimate import LaneEstimate


class SteeringSettings(Settings):
    """How the lane's centre becomes a steering angle.

    Attributes:
        law: ``pure-pursuit`` steers the rear axle onto the circle through the aim point; ``proportional`` is
            the paper's: the front wheels point at it.
        look_ahead_cm: Distance of the aim point ahead of the front axle.
        wheelbase_cm: Distance between the axles.
        max_steering_rad: The target stays within plus and minus this.
        lane_width_cm: Distance between the two lines; with it one line is enough. None: both are needed.
    """

    law: Literal["pure-pursuit", "proportional"] = "pure-pursuit"
    look_ahead_cm: float = Field(default=15.0, gt=0.0)
    wheelbase_cm: float = Field(gt=0.0)
    max_steering_rad: float = Field(default=0.45, gt=0.0, lt=math.pi / 2.0)
    lane_width_cm: float | None = Field(default=None, gt=0.0)


def steering_target_rad(estimate: LaneEstimate, settings: SteeringSettings) -> float:
    """Return the front-wheel angle that leads to the lane's centre.

    Args:
        estimate: The lane of one frame.
        settings: Law, look-ahead, wheelbase and limit.

    Returns:
        Steering angle, [rad], positive left, within the limit; NaN when the lane is unknown there.
    """
    centre_cm = lane_centre_cm(estimate, settings.look_ahead_cm, settings.lane_width_cm)
    if not math.isfinite(centre_cm):
        return float("nan")
    if settings.law == "proportional":
        angle = proportional_angle_rad(centre_cm, settings.look_ahead_cm)
    else:
        angle = pure_pursuit_angle_rad(centre_cm, settings.look_ahead_cm, settings.wheelbase_cm)
    return min(max(angle, -settings.max_steering_rad), settings.max_steering_rad)


def lane_centre_cm(estimate: LaneEstimate, y_cm: float, lane_width_cm: float | None = None) -> float:
    """Return x of the lane's centre at a distance ahead, [cm], frame car.

    With one line and the lane's width the centre is half a width beside that line, measured across the line:
    along x it is further where the line runs at an angle.

    Args:
        estimate: The lane of one frame.
        y_cm: Distance ahead of the front axle.
        lane_width_cm: Distance between the lines, or None to require both.

    Returns:
        x of the centre; NaN when it is unknown.

    Source:
        Own derivation for one line; exact for straight lines (``tests/unit/control/test_steering.py``).
    """
    left_cm, left_slope = _line_at(estimate.points_cm[:3], y_cm)
    right_cm, right_slope = _line_at(estimate.points_cm[3:], y_cm)
    if math.isfinite(left_cm) and math.isfinite(right_cm):
        return 0.5 * (left_cm + right_cm)
    if lane_width_cm is None:
        return float("nan")
    if math.isfinite(left_cm):
        return left_cm + 0.5 * lane_width_cm * math.hypot(1.0, left_slope)
    return right_cm - 0.5 * lane_width_cm * math.hypot(1.0, right_slope)


def _line_at(x_rows_cm: Float[np.ndarray, "3"], y_cm: float) -> tuple[float, float]:
    """Return x and dx/dy of a line at a distance: parabola, else chord between two rows, else its one row.

    Two known rows are not extended beyond themselves, one not beyond itself: NaN there.
    """
    known = np.isfinite(x_rows_cm)
    if known.all():
        a, b, c = (float(v) for v in PARABOLA_FROM_POINTS @ x_rows_cm)
        return (a * y_cm + b) * y_cm + c, 2.0 * a * y_cm + b
    rows, x = np.array(ROWS_CM)[known], x_rows_cm[known]
    if rows.size == 0 or not rows[0] <= y_cm <= rows[-1]:
        return float("nan"), float("nan")
    if rows.size == 1:
        return float(x[0]), 0.0
    slope = float((x[1] - x[0]) / (rows[1] - rows[0]))
    return float(x[0]) + slope * (y_cm - float(rows[0])), slope
