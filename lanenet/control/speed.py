"""How fast to go: straight on at the cruising speed, in bends by the sideways acceleration."""

from __future__ import annotations

import math

from pydantic import Field, model_validator

from lanenet.config import Settings
from lanenet.geometry.lane import parabola_through
from lanenet.perception.estimate import LaneEstimate


class SpeedSettings(Settings):
    """Speeds, and the throttle that gives them; nothing on the car measures its speed.

    Attributes:
        cruise_cm_s: On a straight.
        least_cm_s: In the tightest bend.
        max_lateral_cm_s2: Sideways acceleration in a bend.
        throttle_at_rest: Throttle at which the car just begins to roll.
        cm_s_per_throttle: Speed that a throttle of 1 above that would give, from a timed stretch.
    """

    cruise_cm_s: float = Field(default=60.0, gt=0.0)
    least_cm_s: float = Field(default=30.0, gt=0.0)
    max_lateral_cm_s2: float = Field(default=150.0, gt=0.0)
    throttle_at_rest: float = Field(default=0.1, ge=0.0, lt=1.0)
    cm_s_per_throttle: float = Field(default=400.0, gt=0.0)

    @model_validator(mode="after")
    def _check_order(self) -> SpeedSettings:
        if self.least_cm_s > self.cruise_cm_s:
            raise ValueError(
                f"expected least_cm_s below cruise_cm_s, found {self.least_cm_s:g} above {self.cruise_cm_s:g}"
            )
        return self


def lane_curvature_per_cm(estimate: LaneEstimate, y_cm: float) -> float:
    """Return how sharply the lane bends at a distance ahead, [1/cm], never negative.

    Args:
        estimate: The lane of one frame.
        y_cm: Distance ahead of the front axle.

    Returns:
        |x''| / (1 + x'^2)^1.5 of the mean of the known parabolas; NaN when none is known.
    """
    points = estimate.points_cm.tolist()
    lines = [parabola_through(*points[:3]), parabola_through(*points[3:])]
    known = [(a, b) for a, b, c in lines if math.isfinite(a + b + c)]
    if not known:
        return math.nan
    a, b = (sum(values) / len(known) for values in zip(*known, strict=True))
    slope = 2.0 * a * y_cm + b
    return abs(2.0 * a) / (1.0 + slope * slope) ** 1.5


def curve_speed_cm_s(curvature_per_cm: float, settings: SpeedSettings) -> float:
    """Return the speed for a bend: v = sqrt(sideways acceleration / curvature), between least and cruise.

    Args:
        curvature_per_cm: Of the car's way; NaN, where nobody knows, goes at the least speed.
        settings: Speeds and acceleration.
    """
    if not math.isfinite(curvature_per_cm):
        return settings.least_cm_s
    if curvature_per_cm <= 0.0:
        return settings.cruise_cm_s
    speed = math.sqrt(settings.max_lateral_cm_s2 / curvature_per_cm)
    return min(max(speed, settings.least_cm_s), settings.cruise_cm_s)


def throttle_of(speed_cm_s: float, settings: SpeedSettings) -> float:
    """Return the throttle, 0 to 1, that gives a speed; 0 for a car that is to stand."""
    if not speed_cm_s > 0.0:
        return 0.0
    return min(1.0, settings.throttle_at_rest + speed_cm_s / settings.cm_s_per_throttle)
