"""A car that does not quite do what it is told: kinematic bicycle with a servo and errors."""

from __future__ import annotations

from collections import deque

import numpy as np
from jaxtyping import Float
from pydantic import Field

from lanenet.config import Settings

_NOISE_TIME_S = 0.7  # how long a deviation of speed or steering lasts


class CarSettings(Settings):
    """The car and its errors.

    Attributes:
        wheelbase_cm: Distance between the axles.
        max_steering_rad: Where the servo stops.
        steering_gain: Angle of the wheels per commanded angle.
        steering_trim_rad: Angle of the wheels when told to go straight.
        servo_rate_rad_s: How fast the servo turns.
        delay_frames: Frames between a command and its effect.
        speed_gain: Speed per commanded speed.
        speed_noise: Standard deviation of the relative deviation of speed, which varies slowly.
        steering_noise_rad: Standard deviation of the deviation of the wheels, which varies slowly.
    """

    wheelbase_cm: float = Field(default=26.0, gt=0.0)
    max_steering_rad: float = Field(default=0.45, gt=0.0, lt=1.5)
    steering_gain: float = Field(default=0.95, gt=0.0)
    steering_trim_rad: float = 0.015
    servo_rate_rad_s: float = Field(default=4.0, gt=0.0)
    delay_frames: int = Field(default=1, ge=0)
    speed_gain: float = Field(default=0.94, gt=0.0)
    speed_noise: float = Field(default=0.03, ge=0.0)
    steering_noise_rad: float = Field(default=0.005, ge=0.0)


def advance(
    pose: Float[np.ndarray, "3"], distance_cm: float, steering_rad: float, wheelbase_cm: float
) -> Float[np.ndarray, "3"]:
    """Move the rear axle along the circle that the front wheels set.

    Args:
        pose: Rear-axle centre x, y and heading, [cm], [cm], [rad], frame map.
        distance_cm: Way of the rear axle, positive forwards.
        steering_rad: Angle of the front wheels, positive left.
        wheelbase_cm: Distance between the axles.

    Returns:
        The new pose; the heading is not wrapped.

    Source:
        Kozlowski et al. 2024, eq. 4-6, integrated exactly over the step instead of by Euler's rule.
    """
    turn = distance_cm * np.tan(steering_rad) / wheelbase_cm
    # The chord of the arc, half the turn away from the old heading; sinc(0) = 1 covers the straight.
    chord_cm = distance_cm * np.sinc(0.5 * turn / np.pi)
    direction = pose[2] + 0.5 * turn
    return pose + np.array([chord_cm * np.cos(direction), chord_cm * np.sin(direction), turn])


class Car:
    """State of a simulated car."""

    def __init__(self, settings: CarSettings, pose: Float[np.ndarray, "3"], rng: np.random.Generator) -> None:
        """Put the car at a pose (rear axle, frame map), wheels as trimmed."""
        self.settings, self.pose = settings, np.array(pose, dtype=np.float64)
        self.wheels_rad = settings.steering_trim_rad
        self._pending: deque[tuple[float, float]] = deque()
        self._speed_rng, self._steering_rng = rng.spawn(2)
        self._speed_noise = self._speed_rng.standard_normal()
        self._steering_noise = self._steering_rng.standard_normal()

    def step(self, speed_cm_s: float, steering_rad: float, interval_s: float) -> Float[np.ndarray, "3"]:
        """Give a command and let time pass.

        Args:
            speed_cm_s: Commanded speed.
            steering_rad: Commanded steering, positive left.
            interval_s: Time until the next frame.

        Returns:
            The new pose.
        """
        car = self.settings
        self._pending.append((speed_cm_s, steering_rad))
        # Until the first command arrives, the car rolls as it would with that command, wheels ahead.
        arrived = len(self._pending) > car.delay_frames
        speed_cm_s, steering_rad = self._pending.popleft() if arrived else (speed_cm_s, 0.0)
        wanted = car.steering_gain * steering_rad + car.steering_trim_rad
        wanted = float(np.clip(wanted, -car.max_steering_rad, car.max_steering_rad))
        swing = car.servo_rate_rad_s * interval_s
        before = self.wheels_rad
        self.wheels_rad = before + float(np.clip(wanted - before, -swing, swing))
        self._drift(interval_s)
        speed = speed_cm_s * car.speed_gain * (1.0 + car.speed_noise * self._speed_noise)
        wheels = self.wheels_rad + car.steering_noise_rad * self._steering_noise
        self.pose = advance(self.pose, speed * interval_s, wheels, car.wheelbase_cm)
        return self.pose

    def _drift(self, interval_s: float) -> None:
        """Let both deviations wander with unit variance (Ornstein-Uhlenbeck)."""
        keep = float(np.exp(-interval_s / _NOISE_TIME_S))
        fresh = float(np.sqrt(1.0 - keep * keep))
        self._speed_noise = keep * self._speed_noise + fresh * self._speed_rng.standard_normal()
        self._steering_noise = keep * self._steering_noise + fresh * self._steering_rng.standard_normal()
