"""The other line of a lane from one line and the lane's width: a curve at a constant distance."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from lanenet.geometry.lane import PARABOLA_FROM_POINTS, ROWS_CM

_STEPS = 6
#: A step of the search is at most this long.
_MAX_STEP_CM = 30.0
_TOLERANCE_CM = 1e-3


def parallel_points(
    points_cm: Float[np.ndarray, "3"], distance_cm: float, beyond_cm: float = math.inf
) -> Float[np.ndarray, "3"]:
    """Return the three label points of the curve at a constant distance from a line.

    The line is the parabola through its three points, also beyond them. Each point of the parallel lies
    across the line from one of its points, which for a line at an angle is in another row: Newton's method
    finds it.

    Args:
        points_cm: x of the line at the label rows, frame car.
        distance_cm: To the right of the line in the direction of travel; negative to its left.
        beyond_cm: How far beyond its first and its last point the line is believed.

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
