"""Lane points over time: a scalar Kalman filter per point, moved with the car between frames."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from pydantic import Field

from lanenet.config import Settings
from lanenet.geometry.lane import N_POINTS, ROWS_CM, parabola_through
from lanenet.perception.estimate import LaneEstimate

#: Least confidence in the weight of a frame, which stays finite by it; chosen.
_MIN_CONFIDENCE = 0.05
#: Least sigma, which keeps variances above 0; chosen: far below any measurement.
_MIN_SIGMA_CM = 1e-3
#: Least distance ahead between the points of a moved line; closer, the line runs across the car's path.
#: Chosen: a fifteenth of the distance between the label rows.
_MIN_STEP_CM = 1.0
#: Rounding error of frame times: a line is held for the same number of frames at any time of day.
_ROUNDING_S = 1e-6


class SmoothingSettings(Settings):
    """Weight of earlier frames.

    Attributes:
        enabled: False returns every estimate unchanged.
        drift_cm_per_sqrt_s: Uncertainty of the car's motion: t seconds without a frame add this squared times
            t to a point's variance. Larger values follow faster and smooth less.
        default_sigma_cm: Sigma of a point whose detector gives none; about that of the baselines on synthetic
            drives.
        hold_s: A line that is no longer seen is held for this long.
    """

    enabled: bool = True
    drift_cm_per_sqrt_s: float = Field(default=3.0, gt=0.0)
    default_sigma_cm: float = Field(default=1.0, gt=0.0)
    hold_s: float = Field(default=0.25, ge=0.0)


class LaneSmoother:
    """The lane of earlier frames in the car's present frame."""

    def __init__(self, settings: SmoothingSettings, wheelbase_cm: float) -> None:
        """Take the settings; ``wheelbase_cm`` converts steering to motion."""
        self._settings, self._wheelbase_cm = settings, wheelbase_cm
        self.reset()

    def reset(self) -> None:
        """Forget what earlier frames showed."""
        # Plain numbers: for six of them arrays cost more than they save.
        self._points_cm = [math.nan] * N_POINTS
        self._variance = [math.inf] * N_POINTS
        self._unseen_s = [0.0] * N_POINTS

    def update(
        self, estimate: LaneEstimate, dt_s: float, travel_cm: float = 0.0, steering_rad: float = 0.0
    ) -> LaneEstimate:
        """Fuse a frame's lane with those before it.

        A point's variance, divided by the frame's confidence, is weighed against that of the prediction.

        Args:
            estimate: The lane of the new frame.
            dt_s: Time since the frame before.
            travel_cm: Distance of the rear axle since then, as far as it is known.
            steering_rad: Steering since then, positive left.

        Returns:
            The estimate with smoothed points and their standard deviations; a missing line is held for
            ``hold_s``. All else is the frame's own.
        """
        if not self._settings.enabled:
            return estimate
        self._predict(max(dt_s, 0.0), travel_cm, steering_rad)
        confidence = estimate.confidence if math.isfinite(estimate.confidence) else 0.0
        weight = 1.0 / max(confidence, _MIN_CONFIDENCE)
        points, variances, sigmas_cm = self._points_cm, self._variance, estimate.sigma_cm.tolist()
        default_cm, isfinite = self._settings.default_sigma_cm, math.isfinite
        for i, (x_cm, sigma_cm) in enumerate(zip(estimate.points_cm.tolist(), sigmas_cm, strict=True)):
            known = isfinite(points[i])
            if isfinite(x_cm):
                measured = weight * max(sigma_cm if isfinite(sigma_cm) else default_cm, _MIN_SIGMA_CM) ** 2
                if known:
                    gain = variances[i] / (variances[i] + measured)
                    points[i] += gain * (x_cm - points[i])
                    variances[i] *= 1.0 - gain
                else:
                    known, points[i], variances[i] = True, x_cm, measured
                self._unseen_s[i] = 0.0
            sigmas_cm[i] = math.sqrt(variances[i]) if known else math.nan
        # Not by dataclasses.replace(), which takes thrice the time.
        return LaneEstimate(
            points_cm=np.array(points),
            sigma_cm=np.array(sigmas_cm),
            steering_rad=estimate.steering_rad,
            confidence=estimate.confidence,
            radius_cm=estimate.radius_cm,
            offset_cm=estimate.offset_cm,
            presence=estimate.presence,
            own_lane=estimate.own_lane,
            reason=estimate.reason,
            lines_px=estimate.lines_px,
        )

    def _predict(self, dt_s: float, travel_cm: float, steering_rad: float) -> None:
        growth = dt_s * self._settings.drift_cm_per_sqrt_s**2
        longest_s = self._settings.hold_s + _ROUNDING_S
        self._unseen_s = [unseen_s + dt_s for unseen_s in self._unseen_s]
        self._variance = [variance + growth for variance in self._variance]
        for i, unseen_s in enumerate(self._unseen_s):
            if unseen_s > longest_s:
                self._points_cm[i], self._variance[i] = math.nan, math.inf
        if travel_cm != 0.0:
            turn_rad = travel_cm * math.tan(steering_rad) / self._wheelbase_cm
            self._points_cm = move_points(self._points_cm, travel_cm, turn_rad, self._wheelbase_cm)


def move_points(
    points_cm: Sequence[float], travel_cm: float, turn_rad: float, wheelbase_cm: float
) -> list[float]:
    """Return the lane's points after the car has moved.

    The rear axle moves by ``travel_cm`` along a chord while the heading turns. Three points of each parabola
    move into the new car frame, and the parabola through them is evaluated at the label rows.

    Args:
        points_cm: Six points, frame car before the motion; NaN where unknown.
        travel_cm: Distance of the rear axle, positive ahead.
        turn_rad: Change of heading, positive left.
        wheelbase_cm: Distance between the axles.

    Returns:
        Six points in the new car frame; NaN for a line that lacks a point, or that no longer runs ahead.

    Source:
        Own derivation; exact for straight lines (``tests/unit/control/test_smoothing.py``).
    """
    # The new front axle in the old frame, through the rear axle, which lies a wheelbase behind.
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
