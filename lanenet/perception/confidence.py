"""One number for how far a lane can be trusted."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from lanenet.geometry.lane import lane_width_cm

#: Standard deviation of the lane width that is expected beyond the known widths, as a share of the width.
_WIDTH_TOLERANCE = 0.15
#: Uncertainty of the lane's centre that halves the confidence, as a share of the width.
_CENTRE_TOLERANCE = 0.1


def confidence(
    points_cm: Float[np.ndarray, "6"],
    sigma_cm: Float[np.ndarray, "6"],
    presence: Float[np.ndarray, "2"],
    width_range_cm: tuple[float, float],
) -> float:
    """Judge an answer by whether a line is seen, how sure its centre is, and whether it is a lane.

    The product of three factors from 0 to 1:

    - the probability that at least one line is seen, ``1 - (1 - p_left) (1 - p_right)``;
    - ``1 / (1 + (s / (0.1 W))^2)`` with s the standard deviation of the lane's centre at y = 15 cm, half the
      root of the sum of the squares of both lines', and W the middle of the known widths; 1 where no s is
      known;
    - ``exp(-0.5 (d / (0.15 W'))^2)`` with d how far the width of the answer, across the lane, lies outside
      the known widths, and W' the width at the side that it passed; 1 within them.

    Args:
        points_cm: The six points, frame car.
        sigma_cm: Their standard deviations; NaN where unknown.
        presence: Probability that each line can be seen.
        width_range_cm: The narrowest and the widest lane that the network was trained on.

    Returns:
        0 to 1; 0 if the right line does not lie to the right of the left one.

    Source:
        Own choice; values in ``tests/unit/perception/test_confidence.py``.
    """
    width_cm = lane_width_cm(points_cm)
    if not width_cm > 0.0:
        return 0.0
    low, high = width_range_cm
    seen = 1.0 - (1.0 - float(presence[0])) * (1.0 - float(presence[1]))
    centre_cm = 0.5 * math.hypot(float(sigma_cm[1]), float(sigma_cm[4]))
    sure = 1.0
    if math.isfinite(centre_cm):
        sure = 1.0 / (1.0 + (centre_cm / (_CENTRE_TOLERANCE * 0.5 * (low + high))) ** 2)
    nearest_cm = min(max(width_cm, low), high)
    off = (width_cm - nearest_cm) / (_WIDTH_TOLERANCE * nearest_cm)
    return seen * sure * math.exp(-0.5 * off * off)
