"""Estimate after estimate to steering and speed; the one place with memory between frames of a drive."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from pydantic import Field

from lanenet.config import Settings
from lanenet.control.smoothing import LaneSmoother, SmoothingSettings
from lanenet.control.speed import SpeedSettings, curve_speed_cm_s, lane_curvature_per_cm
from lanenet.control.steering import SteeringSettings, steering_target_rad
from lanenet.perception.estimate import LaneEstimate
from lanenet.perception.lane_memory import LaneMemory

#: Frames of less confidence teach no width.
_WIDTH_CONFIDENCE = 0.5


class ControlSettings(Settings):
    """From what is seen to what the car does.

    Attributes:
        steering: Law, look-ahead, wheelbase and lock.
        smoothing: Over time; can be switched off.
        speed: On straights and in bends.
        own_target: Follow the detector's own steering target instead of a law, for detectors that know no
            centimetres.
        width_memory: Remember the lane's width where none is given, so that one line is enough where the
            other is not seen.
    """

    steering: SteeringSettings
    smoothing: SmoothingSettings = SmoothingSettings()
    speed: SpeedSettings = Field(default_factory=SpeedSettings)
    own_target: bool = False
    width_memory: bool = True


@dataclass(frozen=True)
class Wish:
    """What the lane asks for, before any limit.

    Attributes:
        steering_rad: Steering, positive left; NaN when the lane is unknown.
        speed_cm_s: Speed for the bend ahead.
        estimate: The lane that it follows from, smoothed.
    """

    steering_rad: float
    speed_cm_s: float
    estimate: LaneEstimate = field(repr=False)


class LaneController:
    """Turns the lane of each frame into steering and speed."""

    def __init__(self, settings: ControlSettings) -> None:
        """Take the settings; nothing is known of the lane yet."""
        self._settings = settings
        self._smoother = LaneSmoother(settings.smoothing, settings.steering.wheelbase_cm)
        self._steering = settings.steering
        self._memory = LaneMemory(settings.steering.lane_width_cm)
        self._t_s = math.nan

    @property
    def lane_width_cm(self) -> float | None:
        """Width of the lane: given, or learnt from frames with both lines; None when neither is there."""
        return self._memory.width_cm

    def reset(self) -> None:
        """Forget earlier frames; the lane's width stays, since the road is the same."""
        self._smoother.reset()
        self._t_s = math.nan

    def wish(
        self, estimate: LaneEstimate, t_s: float, speed_cm_s: float = 0.0, steering_rad: float = 0.0
    ) -> Wish:
        """Answer to a frame.

        Args:
            estimate: Its lane.
            t_s: Its time, after the one before.
            speed_cm_s: How fast the car went since then, as far as that is known; 0 when it stands.
            steering_rad: How it steered, positive left.

        Returns:
            Steering and speed; NaN steering when the lane is unknown at the look-ahead distance.
        """
        dt_s = t_s - self._t_s if math.isfinite(self._t_s) else 0.0
        self._t_s = t_s
        smooth = self._smoother.update(estimate, dt_s, speed_cm_s * dt_s, steering_rad)
        # Points of the frame itself: a line that is only carried on knows nothing new.
        if self._settings.width_memory and estimate.confidence >= _WIDTH_CONFIDENCE:
            self._memory.learn(estimate.points_cm, estimate.presence)
        steering = self._target_rad(estimate, smooth)
        curvature = lane_curvature_per_cm(smooth, self._steering.look_ahead_cm)
        if math.isfinite(steering):
            # A car that turns back into a straight lane is in a bend of its own.
            own = abs(math.tan(steering)) / self._steering.wheelbase_cm
            curvature = own if not math.isfinite(curvature) else max(curvature, own)
        return Wish(steering, curve_speed_cm_s(curvature, self._settings.speed), smooth)

    def _target_rad(self, estimate: LaneEstimate, smooth: LaneEstimate) -> float:
        if self._settings.own_target:
            limit, wished = self._steering.max_steering_rad, estimate.steering_rad
            return min(max(wished, -limit), limit) if math.isfinite(wished) else math.nan
        # Smoothing carries one line on, and never a frame that shows none.
        if not any(map(math.isfinite, estimate.points_cm.tolist())):
            return math.nan
        # The width counts only where a line is missing.
        complete = all(map(math.isfinite, smooth.points_cm.tolist()))
        width_cm = None if complete else self._memory.width_cm
        return steering_target_rad(smooth, self._steering, width_cm)
