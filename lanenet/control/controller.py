"""From lane estimates to steering and speed, with memory from frame to frame."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import ClassVar

from pydantic import Field

from lanenet.config import Rule, Settings
from lanenet.control.plausibility import JumpCheck, fault_of, misfit_of
from lanenet.control.smoothing import LaneSmoother, SmoothingSettings
from lanenet.control.steering import SteeringSettings, steering_target_rad
from lanenet.geometry.lane import parabola_through
from lanenet.perception.estimate import Detector, LaneEstimate, LaneMemory, TakesMotion

#: The width is learned from frames of at least this confidence; chosen: those at which the car does not slow.
_WIDTH_CONFIDENCE = 0.5


class SpeedSettings(Settings):
    """Speeds, and the throttle for each; no sensor of the car measures its speed.

    Attributes:
        cruise_cm_s: Speed on a straight.
        least_cm_s: Speed in the tightest bend.
        max_lateral_cm_s2: Largest lateral acceleration in a bend.
        throttle_at_rest: Throttle at which the car just begins to roll.
        cm_s_per_throttle: Speed per throttle above that, from a timed distance.
    """

    rules: ClassVar[tuple[Rule, ...]] = (
        Rule(
            ("least_cm_s", "cruise_cm_s"),
            lambda s: s.least_cm_s <= s.cruise_cm_s,
            lambda s: (
                f"expected least_cm_s at most {s.cruise_cm_s:g} cm/s: bends are not faster than straights"
            ),
        ),
    )

    cruise_cm_s: float = Field(default=60.0, gt=0.0)
    least_cm_s: float = Field(default=30.0, gt=0.0)
    max_lateral_cm_s2: float = Field(default=150.0, gt=0.0)
    throttle_at_rest: float = Field(default=0.1, ge=0.0, lt=1.0)
    cm_s_per_throttle: float = Field(default=400.0, gt=0.0)

    @property
    def cruise_throttle(self) -> float:
        """Throttle of the cruise speed, not limited: above 1 there is no such speed."""
        return self.throttle_at_rest + self.cruise_cm_s / self.cm_s_per_throttle


def lane_curvature_per_cm(estimate: LaneEstimate, y_cm: float) -> float:
    """Return the curvature of the lane at a distance ahead, [1/cm], never negative.

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
    """Return the speed for a bend: v = sqrt(lateral acceleration / curvature), between least and cruise.

    Args:
        curvature_per_cm: Curvature of the car's path; NaN, unknown, gives the least speed.
        settings: Speeds and acceleration.
    """
    if not math.isfinite(curvature_per_cm):
        return settings.least_cm_s
    if curvature_per_cm <= 0.0:
        return settings.cruise_cm_s
    speed = math.sqrt(settings.max_lateral_cm_s2 / curvature_per_cm)
    return min(max(speed, settings.least_cm_s), settings.cruise_cm_s)


def throttle_of(speed_cm_s: float, settings: SpeedSettings) -> float:
    """Return the throttle, 0 to 1, for a speed; 0 to stand still."""
    if not speed_cm_s > 0.0:
        return 0.0
    return min(1.0, settings.throttle_at_rest + speed_cm_s / settings.cm_s_per_throttle)


def speed_of_cm_s(throttle: float, settings: SpeedSettings) -> float:
    """Return the speed of a car at a throttle; 0 where it does not roll. What reverses is not known."""
    return max(0.0, (throttle - settings.throttle_at_rest) * settings.cm_s_per_throttle)


class ControlSettings(Settings):
    """From the lane to steering and speed.

    Attributes:
        steering: Law, look-ahead, wheelbase and lock.
        smoothing: Of the points over time; can be switched off.
        speed: Speed on straights and in bends.
        own_target: Follow the detector's own steering target instead of a law, for detectors without points
            in cm.
        width_memory: Remember the lane's width if none is given, so that one visible line is enough.
    """

    steering: SteeringSettings
    smoothing: SmoothingSettings = SmoothingSettings()
    speed: SpeedSettings = Field(default_factory=SpeedSettings)
    own_target: bool = False
    width_memory: bool = True


@dataclass(frozen=True)
class Target:
    """Steering and speed for the lane, before any limit.

    Attributes:
        steering_rad: Steering, positive left; NaN when the lane is unknown.
        speed_cm_s: Speed for the bend ahead.
        estimate: The lane that it follows from, smoothed.
        fault: Why the frame's lane cannot be the car's; empty if it can.
    """

    steering_rad: float
    speed_cm_s: float
    estimate: LaneEstimate = field(repr=False)
    fault: str = ""


class LaneController:
    """Turns the lane of each frame into steering and speed."""

    def __init__(self, settings: ControlSettings) -> None:
        """Take the settings; the lane is unknown at first."""
        self._settings = settings
        self._smoother = LaneSmoother(settings.smoothing, settings.steering.wheelbase_cm)
        self._steering = settings.steering
        self._memory = LaneMemory(settings.steering.lane_width_cm)
        self._jumps = JumpCheck()
        self._t_s = math.nan

    @property
    def lane_width_cm(self) -> float | None:
        """Width of the lane, given or learned from frames with both lines; None while unknown."""
        return self._memory.width_cm

    def reset(self) -> None:
        """Forget earlier frames; the lane's width stays, since the road is the same."""
        self._smoother.reset()
        self._jumps.reset()
        self._t_s = math.nan

    def tell(self, detector: Detector, t_s: float, speed_cm_s: float, steering_rad: float) -> None:
        """Tell a detector that asks for it how the car has moved since the last frame.

        Args:
            detector: That of the frame to come.
            t_s: Time of that frame.
            speed_cm_s: Speed since the frame before, as far as it is known.
            steering_rad: Steering since then, positive left.
        """
        if isinstance(detector, TakesMotion) and math.isfinite(self._t_s):
            travel_cm, wheelbase_cm = speed_cm_s * (t_s - self._t_s), self._steering.wheelbase_cm
            detector.moved(travel_cm, travel_cm * math.tan(steering_rad) / wheelbase_cm, wheelbase_cm)

    def target(
        self, estimate: LaneEstimate, t_s: float, speed_cm_s: float = 0.0, steering_rad: float = 0.0
    ) -> Target:
        """Return steering and speed for a frame.

        Args:
            estimate: The frame's lane.
            t_s: The frame's time, later than that of the one before.
            speed_cm_s: Speed since the frame before, as far as it is known; 0 at standstill.
            steering_rad: Steering since then, positive left.

        Returns:
            Steering and speed; NaN steering when the lane is unknown at the look-ahead distance. An answer
            that cannot be the car's lane counts as none.
        """
        width_cm = self._memory.width_cm
        fastest_cm_s = max(speed_cm_s, self._settings.speed.cruise_cm_s)
        impossible = fault_of(estimate)
        # A frame of another width counts as well: else a wrong one, once learned, would refuse all others.
        if self._settings.width_memory and not impossible and estimate.confidence >= _WIDTH_CONFIDENCE:
            self._memory.learn(estimate.points_cm, estimate.presence)
        fault = (
            impossible
            or (width_cm is not None and misfit_of(estimate, width_cm))
            or self._jumps.fault_of(estimate, t_s, fastest_cm_s, width_cm)
        )
        if fault:
            estimate = LaneEstimate()
        dt_s = t_s - self._t_s if math.isfinite(self._t_s) else 0.0
        self._t_s = t_s
        smooth = self._smoother.update(estimate, dt_s, speed_cm_s * dt_s, steering_rad)
        steering = self._target_rad(estimate, smooth)
        curvature = lane_curvature_per_cm(smooth, self._steering.look_ahead_cm)
        if math.isfinite(steering):
            # A car that returns to a straight lane drives a bend of its own.
            own = abs(math.tan(steering)) / self._steering.wheelbase_cm
            curvature = own if not math.isfinite(curvature) else max(curvature, own)
        return Target(steering, curve_speed_cm_s(curvature, self._settings.speed), smooth, fault)

    def _target_rad(self, estimate: LaneEstimate, smooth: LaneEstimate) -> float:
        if self._settings.own_target:
            limit, target = self._steering.max_steering_rad, estimate.steering_rad
            return min(max(target, -limit), limit) if math.isfinite(target) else math.nan
        # Smoothing may hold one line, but a frame without any line has no target.
        if not any(map(math.isfinite, estimate.points_cm.tolist())):
            return math.nan
        # The width matters only if a line is missing.
        complete = all(map(math.isfinite, smooth.points_cm.tolist()))
        width_cm = None if complete else self._memory.width_cm
        return steering_target_rad(smooth, self._steering, width_cm)
