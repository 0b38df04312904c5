"""Lane points over time: a small Kalman filter per point, carried along with the car's own motion."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from pydantic import Field

from lanenet.config import Settings
from lanenet.geometry.lane import N_POINTS, ROWS_CM, parabolas_from_points
from lanenet.perception.estimate import LaneEstimate

_ROWS = np.array(ROWS_CM)
#: A confidence below this weighs no less, so that the weight stays finite.
_MIN_CONFIDENCE = 0.05


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
        self._points_cm: Float[np.ndarray, "6"] = np.full(N_POINTS, np.nan)
        self._variance: Float[np.ndarray, "6"] = np.full(N_POINTS, np.inf)
        self._unseen_s: Float[np.ndarray, "6"] = np.zeros(N_POINTS)

    def reset(self) -> None:
        """Forget what earlier frames showed."""
        self._points_cm = np.full(N_POINTS, np.nan)
        self._variance = np.full(N_POINTS, np.inf)
        self._unseen_s = np.zeros(N_POINTS)

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
        seen = np.isfinite(estimate.points_cm)
        sigma_cm = np.where(
            np.isfinite(estimate.sigma_cm), estimate.sigma_cm, self._settings.default_sigma_cm
        )
        confidence = estimate.confidence if math.isfinite(estimate.confidence) else 0.0
        measured = np.maximum(sigma_cm, 1e-3) ** 2 / max(confidence, _MIN_CONFIDENCE)
        both = seen & np.isfinite(self._points_cm)
        gain = self._variance[both] / (self._variance[both] + measured[both])
        self._points_cm[both] += gain * (estimate.points_cm[both] - self._points_cm[both])
        self._variance[both] *= 1.0 - gain
        new = seen & ~both
        self._points_cm[new] = estimate.points_cm[new]
        self._variance[new] = measured[new]
        self._unseen_s[seen] = 0.0
        known = np.isfinite(self._points_cm)
        return replace(
            estimate,
            points_cm=self._points_cm.copy(),
            sigma_cm=np.where(known, np.sqrt(self._variance), np.nan),
        )

    def _predict(self, dt_s: float, travel_cm: float, steering_rad: float) -> None:
        self._unseen_s += dt_s
        self._variance += dt_s * self._settings.drift_cm_per_sqrt_s**2
        gone = self._unseen_s > self._settings.hold_s
        self._points_cm[gone], self._variance[gone] = np.nan, np.inf
        if travel_cm != 0.0:
            turn_rad = travel_cm * math.tan(steering_rad) / self._wheelbase_cm
            self._points_cm = move_points(self._points_cm, travel_cm, turn_rad, self._wheelbase_cm)


def move_points(
    points_cm: Float[np.ndarray, "6"], travel_cm: float, turn_rad: float, wheelbase_cm: float
) -> Float[np.ndarray, "6"]:
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
    moved = np.full(N_POINTS, np.nan)
    for side, (a, b, c) in enumerate(parabolas_from_points(points_cm)):
        if not math.isfinite(a):
            continue
        y_old = _ROWS + front_y
        x_old = (a * y_old + b) * y_old + c
        dx, dy = x_old - front_x, y_old - front_y
        x_new, y_new = cosine * dx + sine * dy, cosine * dy - sine * dx
        if not (np.diff(y_new) > 1.0).all():
            continue
        parabola = np.linalg.solve(np.stack([y_new * y_new, y_new, np.ones(3)], axis=1), x_new)
        moved[3 * side : 3 * side + 3] = (parabola[0] * _ROWS + parabola[1]) * _ROWS + parabola[2]
    return moved
