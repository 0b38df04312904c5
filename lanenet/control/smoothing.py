"""Lane points over time: a small Kalman filter per point, carried along with the car's own motion."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from pydantic import Field

from lanenet.config import Settings
from lanenet.geometry.lane import N_POINTS, ROWS_CM, parabola_through
from lanenet.perception.estimate import LaneEstimate

#: A confidence below this weighs no less, so that the weight stays finite.
_MIN_CONFIDENCE = 0.05
#: Nothing is known more exactly.
_MIN_SIGMA_CM = 1e-3
#: Rows that come nearer together belong to a line that runs across the way.
_MIN_STEP_CM = 1.0
#: Of times of frames, so that a line is held for the same number of them whatever the time of day.
_ROUNDING_S = 1e-6


class SmoothingSettings(Settings):
    """How much earlier frames count.

    Attributes:
        enabled: False hands every estimate on as it is.
        drift_cm_per_sqrt_s: What is not known of the car's motion: t seconds without a frame add this times
            sqrt(t) to a point's standard deviation. Larger follows faster and smooths less.
        default_sigma_cm: Standard deviation of a point whose detector does not tell one.
        hold_s: A line that is no longer seen is carried on for this long.
    """

    enabled: bool = True
    drift_cm_per_sqrt_s: float = Field(default=3.0, gt=0.0)
    default_sigma_cm: float = Field(default=1.0, gt=0.0)
    hold_s: float = Field(default=0.25, ge=0.0)


class LaneSmoother:
    """Keeps the lane of the frames before, moved to where the car is now."""

    def __init__(self, settings: SmoothingSettings, wheelbase_cm: float) -> None:
        """Take the settings; ``wheelbase_cm`` turns steering into motion."""
        self._settings, self._wheelbase_cm = settings, wheelbase_cm
        self.reset()

    def reset(self) -> None:
        """Forget what earlier frames showed."""
        # Plain numbers: six of them are not worth the cost of arrays at every frame.
        self._points_cm = [math.nan] * N_POINTS
        self._variance = [math.inf] * N_POINTS
        self._unseen_s = [0.0] * N_POINTS

    def update(
        self, estimate: LaneEstimate, dt_s: float, travel_cm: float = 0.0, steering_rad: float = 0.0
    ) -> LaneEstimate:
        """Join a frame's lane with those before it.

        A point weighs by its variance over the frame's confidence against the variance of what is carried on.

        Args:
            estimate: The lane of the new frame.
            dt_s: Time since the frame before.
            travel_cm: Way of the rear axle since then, as far as it is known.
            steering_rad: Steering on that way, positive left.

        Returns:
            The estimate with smoothed points and their standard deviations; a line that the frame lacks is
            filled in for ``hold_s``. All else is the frame's own.
        """
        if not self._settings.enabled:
            return estimate
        self._predict(max(dt_s, 0.0), travel_cm, steering_rad)
        confidence = estimate.confidence if math.isfinite(estimate.confidence) else 0.0
        weight = 1.0 / max(confidence, _MIN_CONFIDENCE)
        points, variances, sigmas_cm = self._points_cm, self._variance, estimate.sigma_cm.tolist()
        for i, x_cm in enumerate(estimate.points_cm.tolist()):
            if math.isfinite(x_cm):
                sigma_cm = sigmas_cm[i] if math.isfinite(sigmas_cm[i]) else self._settings.default_sigma_cm
                measured = weight * max(sigma_cm, _MIN_SIGMA_CM) ** 2
                if math.isfinite(points[i]):
                    gain = variances[i] / (variances[i] + measured)
                    points[i] += gain * (x_cm - points[i])
                    variances[i] *= 1.0 - gain
                else:
                    points[i], variances[i] = x_cm, measured
                self._unseen_s[i] = 0.0
            sigmas_cm[i] = math.sqrt(variances[i]) if math.isfinite(points[i]) else math.nan
        return replace(estimate, points_cm=np.array(points), sigma_cm=np.array(sigmas_cm))

    def _predict(self, dt_s: float, travel_cm: float, steering_rad: float) -> None:
        growth = dt_s * self._settings.drift_cm_per_sqrt_s**2
        for i in range(N_POINTS):
            self._unseen_s[i] += dt_s
            self._variance[i] += growth
            if self._unseen_s[i] > self._settings.hold_s + _ROUNDING_S:
                self._points_cm[i], self._variance[i] = math.nan, math.inf
        if travel_cm != 0.0:
            turn_rad = travel_cm * math.tan(steering_rad) / self._wheelbase_cm
            self._points_cm = move_points(self._points_cm, travel_cm, turn_rad, self._wheelbase_cm)


def move_points(
    points_cm: Sequence[float], travel_cm: float, turn_rad: float, wheelbase_cm: float
) -> list[float]:
    """Tell where the lane lies after the car has moved.

    The rear axle goes ``travel_cm`` along a chord while the heading turns; three points of each parabola move
    into the new car frame, and the parabola through them is read at the label rows again.

    Args:
        points_cm: Six points, frame car before the motion; NaN where unknown.
        travel_cm: Way of the rear axle, ahead positive.
        turn_rad: Change of heading, positive left.
        wheelbase_cm: Distance between the axles.

    Returns:
        Six points in the new car frame; NaN for a line that lacks a point, or that no longer runs ahead.

    Source:
        Own derivation; exact for straight lines (``tests/unit/control/test_smoothing.py``).
    """
    # The new front axle in the old frame, by way of the rear axle, which lies a wheelbase behind.
    front_x = -travel_cm * math.sin(0.5 * turn_rad) - wheelbase_cm * math.sin(turn_rad)
    front_y = travel_cm * math.cos(0.5 * turn_rad) + wheelbase_cm * (math.cos(turn_rad) - 1.0)
    sine, cosine = math.sin(turn_rad), math.cos(turn_rad)
    moved: list[float] = []
    for line in (points_cm[:3], points_cm[3:]):
        a, b, c = parabola_through(*line)
        new = []
        for row in ROWS_CM:
            y_old = row + front_y
            dx, dy = (a * y_old + b) * y_old + c - front_x, row
            new.append((cosine * dx + sine * dy, cosine * dy - sine * dx))
        moved += _read_at_rows(new)
    return moved


def _read_at_rows(points: list[tuple[float, float]]) -> list[float]:
    """x at the label rows of the parabola through three points; NaN where they do not recede."""
    (x_0, y_0), (x_1, y_1), (x_2, y_2) = points
    # Written so that NaN fails as well.
    if not (y_1 - y_0 > _MIN_STEP_CM and y_2 - y_1 > _MIN_STEP_CM):
        return [math.nan] * len(ROWS_CM)
    near, far = (x_1 - x_0) / (y_1 - y_0), (x_2 - x_1) / (y_2 - y_1)
    bend = (far - near) / (y_2 - y_0)
    return [x_0 + (row - y_0) * (near + bend * (row - y_1)) for row in ROWS_CM]
