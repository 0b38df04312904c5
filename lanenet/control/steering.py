"""From a lane estimate to the angle of the front wheels."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from jaxtyping import Float
from pydantic import Field

from lanenet.config import Settings
from lanenet.geometry.lane import (
    ROWS_CM,
    LaneWidthCm,
    parabola_through,
    proportional_angle_rad,
    pure_pursuit_angle_rad,
)
from lanenet.perception.estimate import LaneEstimate


class SteeringSettings(Settings):
    """How the lane's centre becomes a steering angle.

    Attributes:
        law: ``proportional`` is the paper's: the front wheels point at the aim point, which keeps the front
            axle on the lane's centre. ``pure-pursuit`` steers the rear axle along the circle through it; in
            bends the front axle then runs outside.
        look_ahead_cm: Distance of the aim point ahead of the front axle; the paper's 15 cm.
        wheelbase_cm: Distance between the axles.
        max_steering_rad: Bound of the target. Chosen: the steering lock of common 1:10 cars, 26 degrees.
        lane_width_cm: Distance between the two lines; with it one line is enough. None: both are needed.
    """

    law: Literal["pure-pursuit", "proportional"] = "proportional"
    look_ahead_cm: float = Field(default=15.0, gt=0.0)
    wheelbase_cm: float = Field(gt=0.0)
    max_steering_rad: float = Field(default=0.45, gt=0.0, lt=math.pi / 2.0)
    lane_width_cm: LaneWidthCm | None = None


def steering_target_rad(
    estimate: LaneEstimate, settings: SteeringSettings, seen_width_cm: float | None = None
) -> float:
    """Return the front-wheel angle that leads to the lane's centre.

    Args:
        estimate: The lane of one frame.
        settings: Law, look-ahead, wheelbase and limit.
        seen_width_cm: Width in earlier frames, for a frame with one line; replaces that of the settings.

    Returns:
        Steering angle, [rad], positive left, within the limit; NaN when the lane is unknown there.
    """
    width_cm = settings.lane_width_cm if seen_width_cm is None else seen_width_cm
    centre_cm = lane_centre_cm(estimate, settings.look_ahead_cm, width_cm)
    if not math.isfinite(centre_cm):
        return float("nan")
    return _angle_to_rad(centre_cm, settings.look_ahead_cm, settings)


def _angle_to_rad(right_cm: float, ahead_cm: float, settings: SteeringSettings) -> float:
    """Return the angle by which the law aims at a point, within the limit."""
    if settings.law == "proportional":
        angle = proportional_angle_rad(right_cm, ahead_cm)
    else:
        angle = pure_pursuit_angle_rad(right_cm, ahead_cm, settings.wheelbase_cm)
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

    Two rows are not extrapolated, nor is one: NaN outside them.
    """
    x_rows = x_rows_cm.tolist()
    if math.isfinite(sum(x_rows)):
        a, b, c = parabola_through(*x_rows)
        return (a * y_cm + b) * y_cm + c, 2.0 * a * y_cm + b
    known = [(row, x) for row, x in zip(ROWS_CM, x_rows, strict=True) if math.isfinite(x)]
    if not known or not known[0][0] <= y_cm <= known[-1][0]:
        return math.nan, math.nan
    (row, x), (last_row, last_x) = known[0], known[-1]
    if row == last_row:
        return x, 0.0
    slope = (last_x - x) / (last_row - row)
    return x + slope * (y_cm - row), slope
