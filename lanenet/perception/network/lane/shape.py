"""The lane's shape as four numbers: a parabola as its centre line, and a width.

A state is (offset of the centre line to the right of the front axle's middle [cm], slope dx/dy of the centre
line there, its curvature there [1/cm], positive to the right, logarithm of the lane's width [cm]), frame car.
The centre line is the parabola x(y) with these three, both lines are the curves parallel to it at half a
width, so that either of them tells the other.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from lanenet.geometry.lane import ROWS_CM, SIDES

OFFSET, SLOPE, CURVATURE, LOG_WIDTH = range(4)
#: y of each of the six points, frame car, and half a lane to the left and to the right, in lane widths.
ROW_CM = np.tile(np.array(ROWS_CM), len(SIDES))
_HALF = np.repeat([-0.5, 0.5], len(ROWS_CM))
#: Tightest bend of a lane, [1/cm], and how far beside its row a point of the centre line is looked for, [cm].
#: Chosen: a radius of 17 cm is less than any car here turns; twice the distance of two rows.
_TIGHTEST, _REACH_CM = 0.06, 30.0
#: Steepest centre line, [rad]. Chosen: beyond it no line crosses the label rows.
STEEPEST_RAD = 1.2


def linearised(
    states: Float[np.ndarray, "n 4"],
) -> tuple[Float[np.ndarray, "n 6"], Float[np.ndarray, "n 6 4"]]:
    """Return x of both lines at the label rows, frame car, [cm], of lanes, and its derivatives by the states.

    Source:
        Own derivation. Parallel curves share their tangents, so that a point moves along the row with the
        centre line's own change at its foot, and with the width by one over the cosine of the slope. The foot
        is found by two steps of a fixed-point iteration.
    """
    offset, slope, curvature, log_width = states.T[..., None]
    half_cm = _HALF * np.exp(log_width)
    bend, bend_by_slope, bend_by_curvature = _bend(slope, curvature)
    y = ROW_CM
    for _ in range(2):
        at = slope + bend * y
        aside_cm = half_cm * at / np.sqrt(1.0 + at * at)
        y = ROW_CM + np.minimum(np.maximum(aside_cm, -_REACH_CM), _REACH_CM)
    at = slope + bend * y
    across = np.sqrt(1.0 + at * at)
    half_square = 0.5 * y * y
    change = np.empty((*y.shape, states.shape[1]))
    change[..., OFFSET] = 1.0
    change[..., SLOPE] = y + half_square * bend_by_slope
    change[..., CURVATURE] = half_square * bend_by_curvature
    change[..., LOG_WIDTH] = half_cm * across
    return offset + slope * y + bend * half_square + half_cm / across, change


def points_of(states: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 6"]:
    """Return x of both lines of lanes at the label rows, frame car, [cm]."""
    return linearised(states)[0]


def moved(
    states: Float[np.ndarray, "n 4"], travel_cm: float, turn_rad: float, wheelbase_cm: float
) -> tuple[Float[np.ndarray, "n 4"], Float[np.ndarray, "n 4 4"]]:
    """Return lanes as the car sees them after it has moved, and their derivatives by the states before.

    Args:
        states: Of lanes, frame car before the motion.
        travel_cm: Distance of the rear axle along its arc, positive ahead.
        turn_rad: Change of heading, positive left.
        wheelbase_cm: Distance between the axles.
    """
    offset, slope, curvature, _ = states.T
    bend, bend_by_slope, bend_by_curvature = _bend(slope, curvature)
    sine, cosine = math.sin(turn_rad), math.cos(turn_rad)
    # The new middle of the front axle in the old frame.
    x = -0.5 * travel_cm * turn_rad - wheelbase_cm * sine
    y = travel_cm + wheelbase_cm * (cosine - 1.0)
    beside_cm = offset + (slope + 0.5 * bend * y) * y - x
    # The new x axis meets the lane further ahead, or behind.
    ahead_cm = y + beside_cm * sine
    before = slope + bend * ahead_cm
    after = np.tan(np.clip(np.arctan(before) + turn_rad, -STEEPEST_RAD, STEEPEST_RAD))
    out = states.copy()
    out[:, OFFSET], out[:, SLOPE] = beside_cm * (cosine + after * sine), after
    change = np.zeros((len(states), 4, 4))
    turned = (1.0 + after * after) / (1.0 + before * before)
    change[:, SLOPE, SLOPE] = turned * (1.0 + ahead_cm * bend_by_slope)
    change[:, SLOPE, CURVATURE] = turned * ahead_cm * bend_by_curvature
    aside = cosine + after * sine
    change[:, OFFSET, OFFSET] = aside
    change[:, OFFSET, SLOPE] = aside * (y + 0.5 * y * y * bend_by_slope)
    change[:, OFFSET, CURVATURE] = aside * (0.5 * y * y * bend_by_curvature)
    change[:, OFFSET] += (beside_cm * sine)[:, None] * change[:, SLOPE]
    change[:, CURVATURE, CURVATURE] = change[:, LOG_WIDTH, LOG_WIDTH] = 1.0
    return out, change


def _bend(
    slope: Float[np.ndarray, "*n"], curvature: Float[np.ndarray, "*n"]
) -> tuple[Float[np.ndarray, "*n"], Float[np.ndarray, "*n"], Float[np.ndarray, "*n"]]:
    """Return d2x/dy2 of curves with a slope and a curvature, and its derivatives by the two."""
    steep = 1.0 + slope * slope
    root = np.sqrt(steep)
    bend = curvature * steep * root
    free = (np.abs(bend) < _TIGHTEST) * root
    bend = np.minimum(np.maximum(bend, -_TIGHTEST), _TIGHTEST)
    return bend, free * (3.0 * curvature * slope), free * steep
