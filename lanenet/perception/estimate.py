"""What every detector answers, and what every detector is.

One number for how far a lane can be trusted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8

from lanenet.geometry.lane import N_POINTS, SIDES, lane_width_cm, parabolas_from_points


def _no_points() -> Float[np.ndarray, "6"]:
    return np.full(N_POINTS, np.nan)


def _no_presence() -> Float[np.ndarray, "2"]:
    return np.full(len(SIDES), np.nan)


@dataclass(frozen=True)
class LaneEstimate:
    """The lane as one frame shows it.

    Attributes:
        points_cm: Six points in the order of the label contract, frame car; NaN where unknown.
        sigma_cm: Standard deviation of each point; NaN where the detector does not know it.
        steering_rad: Steering target, positive left; NaN when there is none.
        confidence: 0 (nothing seen) to 1.
        radius_cm: Radius of curvature of the lane's middle; infinite where straight, NaN where the detector
            does not know it.
        offset_cm: The car's place right of the lane's middle; NaN where the detector does not know it.
        presence: Probability that the left and the right line can be seen; NaN where the detector does not
            know it.
    """

    points_cm: Float[np.ndarray, "6"] = field(default_factory=_no_points)
    sigma_cm: Float[np.ndarray, "6"] = field(default_factory=_no_points)
    steering_rad: float = float("nan")
    confidence: float = 0.0
    radius_cm: float = float("nan")
    offset_cm: float = float("nan")
    presence: Float[np.ndarray, "2"] = field(default_factory=_no_presence)

    @property
    def mask(self) -> np.ndarray:
        """True where a point is known."""
        return np.isfinite(self.points_cm)

    @property
    def parabolas(self) -> Float[np.ndarray, "2 3"]:
        """(a, b, c) of the left and right line; NaN for a line that lacks a point."""
        return parabolas_from_points(self.points_cm)


@runtime_checkable
class Detector(Protocol):
    """A lane detector: frame in, estimate out; it may keep state from frame to frame."""

    def detect(self, frame_bgr: UInt8[np.ndarray, "h w 3"]) -> LaneEstimate:
        """Find the lane in one frame."""
        ...

    def reset(self) -> None:
        """Forget what earlier frames showed."""
        ...


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
