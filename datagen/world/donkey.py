"""Commands as Donkeycar records them: angle and throttle from -1 to 1, with gains that nobody wrote down."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from pydantic import Field

from lanenet.config import Settings

_RANGES: dict[str, tuple[float, float]] = {
    "full_steering_rad": (0.3, 0.45),
    "angle_deadband": (0.0, 0.06),
    "angle_exponent": (0.85, 1.3),
    "full_speed_cm_s": (150.0, 400.0),
    "throttle_deadband": (0.05, 0.2),
    "throttle_exponent": (0.8, 1.5),
}


class DonkeySettings(Settings):
    """How a Donkeycar turns its commands into motion; what is None is drawn for each drive.

    Attributes:
        full_steering_rad: Steering at the angle -1.
        angle_deadband: Angles up to this do nothing.
        angle_exponent: 1: proportional beyond the deadband; more: softer around the middle.
        full_speed_cm_s: Speed at full throttle.
        throttle_deadband: Throttle up to this does not move the car.
        throttle_exponent: As for the angle.
    """

    full_steering_rad: float | None = Field(default=None, gt=0.0, lt=1.5)
    angle_deadband: float | None = Field(default=None, ge=0.0, lt=1.0)
    angle_exponent: float | None = Field(default=None, gt=0.0)
    full_speed_cm_s: float | None = Field(default=None, gt=0.0)
    throttle_deadband: float | None = Field(default=None, ge=0.0, lt=1.0)
    throttle_exponent: float | None = Field(default=None, gt=0.0)


def draw_donkey(
    settings: DonkeySettings, rng: np.random.Generator, needed_steering_rad: float = 0.0
) -> DonkeySettings:
    """Fill in what is None; all values are drawn, so that fixing one does not move another.

    Args:
        settings: Values that are set stay.
        rng: Source of randomness.
        needed_steering_rad: What the road asks for; a drawn full lock is no less.
    """
    values: dict[str, Any] = {}
    for name, (low, high) in _RANGES.items():
        drawn, fixed = float(rng.uniform(low, high)), getattr(settings, name)
        values[name] = drawn if fixed is None else fixed
    if settings.full_steering_rad is None:
        values["full_steering_rad"] = max(values["full_steering_rad"], needed_steering_rad)
    return DonkeySettings(**values)


class DonkeyCommands:
    """Both directions between angle and throttle, and steering and speed, of one car."""

    def __init__(self, settings: DonkeySettings) -> None:
        """Take a car whose values are all drawn.

        Raises:
            ValueError: If one is None.
        """
        values = [getattr(settings, name) for name in _RANGES]
        if None in values:
            raise ValueError("draw_donkey has to fill in the settings first")
        self._full_rad, angle_dead, angle_exponent, self._full_cm_s, dead, exponent = values
        self._angle, self._throttle = (angle_dead, angle_exponent), (dead, exponent)

    def angle(self, steering_rad: float) -> float:
        """Return the angle (-1 = left) that asks for a steering; at the stop for more than the car can."""
        return -_asked(steering_rad / self._full_rad, *self._angle)

    def throttle(self, speed_cm_s: float) -> float:
        """Return the throttle that asks for a speed."""
        return _asked(speed_cm_s / self._full_cm_s, *self._throttle)

    def steering_rad(self, angle: float) -> float:
        """Return the steering that an angle (-1 = left) asks for, [rad], positive left."""
        return self._full_rad * _obeyed(-angle, *self._angle)

    def speed_cm_s(self, throttle: float) -> float:
        """Return the speed that a throttle asks for."""
        return self._full_cm_s * _obeyed(throttle, *self._throttle)


def _asked(share: float, deadband: float, exponent: float) -> float:
    """Command for a share of the full effect."""
    if share == 0.0:
        return 0.0
    size = min(abs(share), 1.0) ** (1.0 / exponent)
    return math.copysign(deadband + (1.0 - deadband) * size, share)


def _obeyed(command: float, deadband: float, exponent: float) -> float:
    """Share of the full effect that a command has."""
    size = max(0.0, min(abs(command), 1.0) - deadband) / (1.0 - deadband)
    return math.copysign(size**exponent, command)
