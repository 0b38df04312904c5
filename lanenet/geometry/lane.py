"""The label contract: six x values, their rows, their order, and the parabola through them.

Rows are y = 0, 15, 30 cm ahead of the front axle. The order of the six numbers is the left line near to
far, then the right line near to far. A line's position is the middle of its marking. A missing value is NaN.
Three points and the parabola x = a y^2 + b y + c are one-to-one (Kozlowski et al. 2024, eq. 7-8).

With the lane's width, one line determines the other: a curve at a constant distance. From an aim point in the
lane follows the angle of the front wheels, [rad], positive to the left.
"""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from jaxtyping import Float, Int
from pydantic import AfterValidator

from lanenet.errors import ConfigError

ROWS_CM: tuple[float, float, float] = (0.0, 15.0, 30.0)
SIDES: tuple[str, str] = ("left", "right")
POINT_NAMES: tuple[str, ...] = tuple(f"{side}_{row:.0f}_cm" for side in SIDES for row in ROWS_CM)
N_POINTS = len(POINT_NAMES)
#: Least distance of the front axle's middle from a line between two lanes, in lane widths; closer, the image
#: does not show which lane is the car's. Chosen: 2 cm of a lane of 40 cm.
BESIDE_DIVIDER_LANES = 0.05
#: Tangent of 60 degrees. Chosen: where a line is steeper, 1 cm along the car is 1.7 cm across a label row.
STEEPEST = math.tan(math.pi / 3.0)

#: Widths of lanes. Chosen: a tenth of the width of 1:10 cars, and a road of many lanes.
_LANE_CM = (2.0, 1000.0)

#: x at the three rows = POINTS_FROM_PARABOLA @ (a, b, c).
POINTS_FROM_PARABOLA: Float[np.ndarray, "3 3"] = np.array([[y * y, y, 1.0] for y in ROWS_CM])
#: (a, b, c) = PARABOLA_FROM_POINTS @ x at the three rows.
PARABOLA_FROM_POINTS: Float[np.ndarray, "3 3"] = np.linalg.inv(POINTS_FROM_PARABOLA)
#: Newton steps towards a parallel curve, the longest step, and the error at which it is found. Chosen: steps
#: of a row's distance at most, so that a tight bend does not send the search away; six steps leave less than
#: the tolerance.
_STEPS, _MAX_STEP_CM, _TOLERANCE_CM = 6, 30.0, 1e-3


def check_lane_width(width_cm: float) -> None:
    """Refuse a lane's width that is no centimetres.

    Raises:
        ConfigError: Names the bounds, and the width in centimetres of what seem to be metres.
    """
    least, most = _LANE_CM
    if not least <= width_cm <= most:
        metres = f"; {width_cm:g} m are {100.0 * width_cm:g} cm: type {100.0 * width_cm:g}"
        raise ConfigError(
            f"{width_cm:g}: expected the distance of the lane's two lines in cm, {least:g} to {most:g}"
            f"{metres if least <= 100.0 * width_cm <= most else ''}"
        )


def _checked_setting(width_cm: float) -> float:
    try:
        check_lane_width(width_cm)
    except ConfigError as error:
        raise ValueError(str(error)) from None
    return width_cm


#: Type of a lane's width in settings, which are held to the same bounds as the options.
LaneWidthCm = Annotated[float, AfterValidator(_checked_setting)]


def parabolas_from_points(points_cm: Float[np.ndarray, "*n 6"]) -> Float[np.ndarray, "*n 2 3"]:
    """Return (a, b, c) of the left and the right line; NaN where one of a line's points is missing."""
    points = np.asarray(points_cm, dtype=np.float64)
    return points.reshape(*points.shape[:-1], 2, 3) @ PARABOLA_FROM_POINTS.T


def parabola_through(x_0: float, x_15: float, x_30: float) -> tuple[float, float, float]:
    """Return (a, b, c) of one line of plain numbers, for loops in which an array costs more than its sums."""
    far = (x_30 - x_0) / ROWS_CM[2]
    near = (x_15 - x_0) / ROWS_CM[1]
    a = (far - near) / (ROWS_CM[2] - ROWS_CM[1])
    return a, near - a * ROWS_CM[1], x_0


def rows_of_polyline(line_car_cm: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "3"]:
    """Find x where a lane line crosses the label rows.

    The line is walked in the order of its points, which is the direction of travel; of several crossings of
    one row the first that goes upwards (the line recedes from the car) counts. NaN where no section does, so
    that a line that turns away or back is not answered with another section of the line.

    Args:
        line_car_cm: Polyline in the direction of travel, [cm], frame car; NaN rows break it.

    Returns:
        x at y = 0, 15, 30 cm, [cm], frame car.
    """
    x, y = np.pad(line_car_cm, ((0, 2), (0, 0)), constant_values=np.nan).T
    point, share = (found[0] for found in row_crossings(y[None]))
    return np.asarray(x[point] + share * (x[point + 1] - x[point]))


def row_crossings(
    y_cm: Float[np.ndarray, "n m"],
) -> tuple[Int[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Find where polylines first cross the label rows upwards.

    Args:
        y_cm: Of two and more points of each polyline, frame car.

    Returns:
        By polyline and row the point before the crossing, and the share of the way to the next point; NaN
        where there is none.
    """
    crossed = (y_cm[:, :-1, None] <= ROWS_CM) & (y_cm[:, 1:, None] > ROWS_CM)
    point = crossed.argmax(axis=1)
    low, high = (np.take_along_axis(y_cm, at, axis=1) for at in (point, point + 1))
    share = np.divide(ROWS_CM - low, high - low, out=np.full(low.shape, np.nan), where=crossed.any(axis=1))
    return point, share


def label_rows(line_car_cm: Float[np.ndarray, "m 2"], steepest: float = STEEPEST) -> Float[np.ndarray, "3"]:
    """Find x where a line of a map crosses the label rows; NaN where too obliquely or more than once.

    Stricter than :func:`rows_of_polyline`, which ground truth uses: a map may be wrong.

    Args:
        line_car_cm: Polyline in the direction of travel, frame car; NaN rows break it.
        steepest: Most centimetres across for one along the car.
    """
    found = rows_of_polyline(line_car_cm)
    x, y = line_car_cm[:, 0], line_car_cm[:, 1]
    for i, row in enumerate(ROWS_CM):
        crossed = np.flatnonzero((y[:-1] <= row) != (y[1:] <= row))
        crossed = crossed[np.isfinite(y[crossed]) & np.isfinite(y[crossed + 1])]
        sideways, ahead = (abs(part[crossed + 1] - part[crossed]) for part in (x, y))
        if len(crossed) != 1 or sideways[0] > steepest * ahead[0]:
            found[i] = np.nan
    return found


def mirror_points(points_cm: Float[np.ndarray, "*n 6"]) -> Float[np.ndarray, "*n 6"]:
    """Mirror left and right: x changes sign and the lines swap."""
    points = np.asarray(points_cm)
    return -np.concatenate([points[..., 3:], points[..., :3]], axis=-1)


def lane_width_cm(points_cm: Float[np.ndarray, "6"]) -> float:
    """Return the distance between the two lines at y = 15 cm, measured across the lane.

    The gap along x divided by sqrt(1 + slope^2), with the mean slope dx/dy of the two parabolas there.

    Args:
        points_cm: The six points, frame car.

    Returns:
        Width; NaN where a point is missing, negative where the lines are swapped.
    """
    left_0, left_15, left_30, right_0, right_15, right_30 = points_cm.tolist()
    # The slope of a parabola in the middle between two rows is that of the chord through them.
    slope = 0.5 * (left_30 - left_0 + right_30 - right_0) / (ROWS_CM[2] - ROWS_CM[0])
    return float((right_15 - left_15) / math.hypot(1.0, slope))


def parallel_points(
    points_cm: Float[np.ndarray, "3"], distance_cm: float, beyond_cm: float = math.inf
) -> Float[np.ndarray, "3"]:
    """Return the three label points of the curve at a constant distance from a line.

    The line is the parabola through its three points, also beyond them. A point of the parallel lies
    perpendicular to a point of the line, for an oblique line one in another row: Newton's method finds it.

    Args:
        points_cm: x of the line at the label rows, frame car.
        distance_cm: To the right of the line in the direction of travel; negative to its left.
        beyond_cm: How far beyond its first and last point the line is extrapolated.

    Returns:
        x of the parallel at the label rows; NaN where there is none, because the line bends more tightly than
        the distance, or a point of the line is missing, or where it lies across one that is too far beyond.

    Source:
        Own derivation; circles about one centre and straight lines in
        ``tests/unit/geometry/test_parallel.py``.
    """
    a, b, c = PARABOLA_FROM_POINTS @ np.asarray(points_cm, np.float64)
    rows = np.array(ROWS_CM)
    y = rows.copy()
    # The point of the line at y has its parallel at y - d m / sqrt(1 + m^2), with the slope m = dx/dy there.
    for _ in range(_STEPS):
        slope = 2.0 * a * y + b
        length = np.sqrt(1.0 + slope * slope)
        off = y - distance_cm * slope / length - rows
        gradient = 1.0 - 2.0 * a * distance_cm / length**3
        with np.errstate(divide="ignore", invalid="ignore"):
            y = y - np.clip(off / gradient, -_MAX_STEP_CM, _MAX_STEP_CM)
    slope = 2.0 * a * y + b
    length = np.sqrt(1.0 + slope * slope)
    found = np.abs(y - distance_cm * slope / length - rows) < _TOLERANCE_CM
    # Beyond the centre of the bend the curve runs backwards.
    ahead = 2.0 * a * distance_cm / length**3 < 1.0
    believed = (y >= rows[0] - beyond_cm) & (y <= rows[-1] + beyond_cm)
    return np.where(found & ahead & believed, (a * y + b) * y + c + distance_cm / length, np.nan)


def proportional_angle_rad(aim_right_cm: float, aim_ahead_cm: float) -> float:
    """Aim the front wheels at a point: atan of lateral over ahead.

    Args:
        aim_right_cm: Lateral position of the lane centre A, [cm], frame car, positive right.
        aim_ahead_cm: Distance of A ahead of the front axle, [cm], > 0.

    Returns:
        Steering angle, [rad], positive left.

    Source:
        Kozlowski et al. 2024, eq. 3, with the sign of REP 103.
    """
    return math.atan2(-aim_right_cm, aim_ahead_cm)


def pure_pursuit_angle_rad(aim_right_cm: float, aim_ahead_cm: float, wheelbase_cm: float) -> float:
    """Steer the rear axle onto the circle through a point.

    The circle through the rear axle, tangent to the heading, that meets the aim point has curvature
    2 * lateral / distance^2; the bicycle's front wheel makes it with atan(wheelbase * curvature).

    Args:
        aim_right_cm: Lateral position of the aim point, [cm], frame car, positive right.
        aim_ahead_cm: Distance of the aim point ahead of the front axle, [cm].
        wheelbase_cm: Distance between the axles, [cm].

    Returns:
        Steering angle, [rad], positive left.

    Source:
        Coulter 1992, "Implementation of the Pure Pursuit Path Tracking Algorithm", CMU-RI-TR-92-01.
    """
    forward = aim_ahead_cm + wheelbase_cm
    curvature = -2.0 * aim_right_cm / (forward * forward + aim_right_cm * aim_right_cm)
    return math.atan(wheelbase_cm * curvature)
