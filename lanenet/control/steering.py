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

#: So far from the lane's centre, as a share of its width, a car cuts a corner at most. Tried: on 28 simulated
#: roads with corners 0.08, 0.15 and 0.25 gave 10, 8 and 9 without a departure, and 3, 5 and 6 departures on
#: one of them, whose lane is 33 cm wide.
_MOST_ASIDE = 0.15
#: Steps along each piece of the way around a corner, of 1 cm at most; and how far ahead the aim is at least.
_SHARES, _LEAST_AHEAD_CM = np.linspace(0.0, 1.0, 91), 1e-6


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


def corner_target_rad(
    centre_line_cm: Float[np.ndarray, "3 2"], settings: SteeringSettings, lane_width_cm: float | None = None
) -> float:
    """Return the front-wheel angle that leads around a corner of the lane.

    The car aims at the look-ahead distance on the centre line, where that is rounded off by the tightest bend
    that the front axle can follow, as far as the lane is wide enough for it.

    Args:
        centre_line_cm: The lane's centre before, at and beyond its corner, frame car.
        settings: Law, look-ahead, wheelbase and limit.
        lane_width_cm: Distance between the lines; replaces that of the settings.

    Returns:
        Steering angle, [rad], positive left, within the limit.

    Source:
        Own derivation: an arc of radius R passes a corner of angle t at R (1 / cos(t / 2) - 1) on its inner
        side, and begins R tan(t / 2) before it. What is driven is a parabola with its tangents, which turns
        more in the middle and cuts less.
    """
    first_cm, corner_cm, last_cm = np.asarray(centre_line_cm, np.float64)
    legs_cm = math.dist(first_cm, corner_cm), math.dist(corner_cm, last_cm)
    there, on = (corner_cm - first_cm) / legs_cm[0], (last_cm - corner_cm) / legs_cm[1]
    half_rad = 0.5 * math.acos(min(1.0, max(-1.0, float(there @ on))))
    aside = 1.0 / math.cos(half_rad) - 1.0
    radius_cm = settings.wheelbase_cm / math.sin(settings.max_steering_rad)
    width_cm = settings.lane_width_cm if lane_width_cm is None else lane_width_cm
    if width_cm is not None and radius_cm * aside > _MOST_ASIDE * width_cm:
        radius_cm = _MOST_ASIDE * width_cm / aside
    cut_cm = min(radius_cm * math.tan(half_rad), *legs_cm)
    # A parabola with the tangents of the arc.
    t = _SHARES[:, None]
    arc_cm = corner_cm + cut_cm * (t * t * on - (1.0 - t) ** 2 * there)
    begin_cm, end_cm = arc_cm[0], arc_cm[-1]
    path_cm = np.concatenate([first_cm + t * (begin_cm - first_cm), arc_cm, end_cm + t * (last_cm - end_cm)])
    away_cm = np.hypot(path_cm[:, 0], path_cm[:, 1])
    reached = np.flatnonzero(away_cm <= settings.look_ahead_cm)
    x, y = path_cm[reached[-1] if len(reached) else int(away_cm.argmin())].tolist()
    return _angle_to_rad(x, max(y, _LEAST_AHEAD_CM), settings)


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
