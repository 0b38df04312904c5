"""A car that does not quite follow its commands: bicycle model with servo, motor, slip and errors.

Also Donkeycar's commands: angle and throttle from -1 to 1, with gains that nobody wrote down.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import numpy as np
from jaxtyping import Float
from pydantic import Field

from lanenet.config import Settings

#: Correlation time of the deviations of speed and steering; chosen: uneven floor and play, over half a metre.
_NOISE_TIME_S = 0.7
#: Longest step of the motion; the deviations are drawn once per step.
_STEP_S = 0.01
_SAME_TIME_S = 1e-9
#: Largest sine of the front wheels' angle, in bends that no car could turn.
_MOST_TURNED = 0.9


class CarSettings(Settings):
    """The car and its errors.

    Attributes:
        wheelbase_cm: Distance between the axles.
        max_steering_rad: Where the servo stops.
        steering_gain: Angle of the wheels per commanded angle.
        steering_trim_rad: Angle of the wheels at the command 0.
        servo_rate_rad_s: How fast the servo turns.
        delay_s: Time between a command and its effect.
        speed_gain: Speed per commanded speed.
        speed_lag_s: Time constant with which the speed follows.
        speed_noise: Standard deviation of the relative deviation of speed, which varies slowly.
        steering_noise_rad: Standard deviation of the deviation of the wheels, which varies slowly.
        understeer_speed_cm_s: Characteristic speed, at which the curvature is half of the kinematic one.
            None: no understeer.
        grip_cm_s2: Largest lateral acceleration; beyond it the car slides along a wider circle.
        rear_slip_rad_s2_per_cm: Angle by which the rear axle slides outwards, per lateral acceleration.
    """

    wheelbase_cm: float = Field(default=26.0, gt=0.0)
    max_steering_rad: float = Field(default=0.45, gt=0.0, lt=1.5)
    steering_gain: float = Field(default=0.95, gt=0.0)
    steering_trim_rad: float = 0.015
    servo_rate_rad_s: float = Field(default=4.0, gt=0.0)
    delay_s: float = Field(default=0.05, ge=0.0)
    speed_gain: float = Field(default=0.94, gt=0.0)
    speed_lag_s: float = Field(default=0.15, ge=0.0)
    speed_noise: float = Field(default=0.03, ge=0.0)
    steering_noise_rad: float = Field(default=0.005, ge=0.0)
    understeer_speed_cm_s: float | None = Field(default=400.0, gt=0.0)
    grip_cm_s2: float = Field(default=500.0, gt=0.0)
    rear_slip_rad_s2_per_cm: float = Field(default=1e-4, ge=0.0)


def advance(
    pose: Float[np.ndarray, "3"], distance_cm: float, steering_rad: float, wheelbase_cm: float
) -> Float[np.ndarray, "3"]:
    """Move the rear axle along the circle that the front wheels set.

    Args:
        pose: Rear-axle centre x, y and heading, [cm], [cm], [rad], frame map.
        distance_cm: Of the rear axle, positive forwards.
        steering_rad: Angle of the front wheels, positive left.
        wheelbase_cm: Distance between the axles.

    Returns:
        The new pose; the heading is not wrapped.

    Source:
        Kozlowski et al. 2024, eq. 4-6, integrated exactly over the step instead of by Euler's rule.
    """
    return advance_along(pose, distance_cm, math.tan(steering_rad) / wheelbase_cm)


def advance_along(
    pose: Float[np.ndarray, "3"], distance_cm: float, curvature_per_cm: float, slip_rad: float = 0.0
) -> Float[np.ndarray, "3"]:
    """Move the rear axle along a circle.

    Args:
        pose: Rear-axle centre x, y and heading, [cm], [cm], [rad], frame map.
        distance_cm: Of the rear axle, positive forwards.
        curvature_per_cm: Positive left.
        slip_rad: From the direction of motion to the heading: positive if the rear axle slides to the right.

    Returns:
        The new pose; the heading is not wrapped.
    """
    turn = distance_cm * curvature_per_cm
    # The chord of the arc, half the turn away from the old heading.
    chord_cm = distance_cm * (math.sin(0.5 * turn) / (0.5 * turn) if turn else 1.0)
    direction = float(pose[2]) + 0.5 * turn - slip_rad
    return pose + np.array([chord_cm * math.cos(direction), chord_cm * math.sin(direction), turn])


def front_wheels_in_bend_rad(curvature_per_cm: float, wheelbase_cm: float) -> float:
    """Return the angle of the front wheels of a car whose front axle follows a bend.

    The rear axle runs further inside, so that the heading points outwards of the bend at the front axle.

    Args:
        curvature_per_cm: Of the front axle's path, positive left.
        wheelbase_cm: Distance between the axles.

    Returns:
        The angle, [rad], positive left; never more than 64 degrees, however tight the bend.
    """
    return math.asin(min(max(wheelbase_cm * curvature_per_cm, -_MOST_TURNED), _MOST_TURNED))


def driven_curvature_per_cm(wheels_rad: float, speed_cm_s: float, settings: CarSettings) -> float:
    """Return the curvature that a car drives, [1/cm], positive left.

    The kinematic tan(wheels) / wheelbase, lowered by understeer to the share 1 / (1 + (v / v_ch)^2), and
    limited to what the tyres hold.

    Args:
        wheels_rad: Angle of the front wheels, positive left.
        speed_cm_s: Speed.
        settings: The car.

    Source:
        Characteristic speed: Gillespie 1992, "Fundamentals of Vehicle Dynamics", ch. 6 (steady cornering).
    """
    curvature = math.tan(wheels_rad) / settings.wheelbase_cm
    if settings.understeer_speed_cm_s is not None:
        curvature /= 1.0 + (speed_cm_s / settings.understeer_speed_cm_s) ** 2
    if abs(curvature) * speed_cm_s**2 > settings.grip_cm_s2:
        curvature = math.copysign(settings.grip_cm_s2 / speed_cm_s**2, curvature)
    return curvature


class Car:
    """State of a simulated car.

    It moves in steps of at most 10 ms, and its deviations are drawn once per step: the frame rate decides
    nothing but when commands arrive.

    Attributes:
        settings: The car.
        pose: True rear-axle centre x, y and heading (unwrapped), frame map.
        wheels_rad: Angle to which the servo has turned the wheels, without their deviation.
    """

    def __init__(self, settings: CarSettings, pose: Float[np.ndarray, "3"], rng: np.random.Generator) -> None:
        """Put the car at a pose (rear axle, frame map), wheels as trimmed."""
        self.settings = settings
        self._speed_rng, self._steering_rng = rng.spawn(2)
        self._speed_noise = float(self._speed_rng.standard_normal())
        self._steering_noise = float(self._steering_rng.standard_normal())
        self._ticks, self._t_s = 0, 0.0
        self.place(pose)

    def place(self, pose: Float[np.ndarray, "3"], commanded_cm_s: float | None = None) -> None:
        """Put the car at a pose; earlier commands are forgotten.

        Args:
            pose: Rear-axle centre x, y and heading, frame map.
            commanded_cm_s: Speed command that it follows, wheels straight, until a command arrives; None:
                that of the next command.
        """
        self.pose = np.array(pose, dtype=np.float64)
        self.wheels_rad = self.settings.steering_trim_rad
        self._pending: deque[tuple[float, float, float]] = deque()
        self._command: tuple[float, float] | None = None if commanded_cm_s is None else (commanded_cm_s, 0.0)
        self._motor_cm_s = 0.0 if commanded_cm_s is None else commanded_cm_s * self.settings.speed_gain

    @property
    def speed_cm_s(self) -> float:
        """True speed at this moment."""
        return self._motor_cm_s * (1.0 + self.settings.speed_noise * self._speed_noise)

    @property
    def yaw_rate_rad_s(self) -> float:
        """True yaw rate at this moment, positive left."""
        return self.speed_cm_s * self._curvature_per_cm(self.wheels_rad)

    def step(self, speed_cm_s: float, steering_rad: float, interval_s: float) -> Float[np.ndarray, "3"]:
        """Give a command and let time pass.

        Args:
            speed_cm_s: Commanded speed.
            steering_rad: Commanded steering, positive left.
            interval_s: Time until the next command.

        Returns:
            The new pose.
        """
        if self._command is None:
            # Until the first command takes effect, the car keeps the speed of that command.
            self._command = (speed_cm_s, 0.0)
            self._motor_cm_s = speed_cm_s * self.settings.speed_gain
        self._pending.append((self._t_s + self.settings.delay_s, speed_cm_s, steering_rad))
        end_s = self._t_s + interval_s
        while self._t_s < end_s - _SAME_TIME_S:
            while self._pending and self._pending[0][0] <= self._t_s + _SAME_TIME_S:
                self._command = self._pending.popleft()[1:]
            if self._ticks * _STEP_S <= self._t_s + _SAME_TIME_S:
                self._drift()
                self._ticks += 1
            until_s = min(end_s, self._ticks * _STEP_S)
            if self._pending:
                until_s = min(until_s, self._pending[0][0])
            self._move(*self._command, until_s - self._t_s)
            self._t_s = until_s
        return self.pose

    def _move(self, speed_cm_s: float, steering_rad: float, step_s: float) -> None:
        """Move servo, motor and car by one step."""
        car = self.settings
        wanted = car.steering_gain * steering_rad + car.steering_trim_rad
        wanted = min(max(wanted, -car.max_steering_rad), car.max_steering_rad)
        swing = car.servo_rate_rad_s * step_s
        before_rad = self.wheels_rad
        self.wheels_rad += min(max(wanted - before_rad, -swing), swing)
        # The servo turns at a constant rate and may arrive before the step ends.
        turned_rad = self.wheels_rad - before_rad
        mean_rad = self.wheels_rad - 0.5 * turned_rad * abs(turned_rad) / swing
        target_cm_s, before_cm_s = speed_cm_s * car.speed_gain, self._motor_cm_s
        kept = math.exp(-step_s / car.speed_lag_s) if car.speed_lag_s > 0.0 else 0.0
        self._motor_cm_s = target_cm_s + kept * (before_cm_s - target_cm_s)
        # The integral of the exponential over the step.
        distance_cm = target_cm_s * step_s + (before_cm_s - target_cm_s) * car.speed_lag_s * (1.0 - kept)
        distance_cm *= 1.0 + car.speed_noise * self._speed_noise
        speed = distance_cm / step_s
        curvature = self._curvature_per_cm(mean_rad, speed)
        slip_rad = car.rear_slip_rad_s2_per_cm * speed * speed * curvature
        self.pose = advance_along(self.pose, distance_cm, curvature, slip_rad)

    def _curvature_per_cm(self, wheels_rad: float, speed_cm_s: float | None = None) -> float:
        wheels_rad += self.settings.steering_noise_rad * self._steering_noise
        speed_cm_s = self.speed_cm_s if speed_cm_s is None else speed_cm_s
        return driven_curvature_per_cm(wheels_rad, speed_cm_s, self.settings)

    def _drift(self) -> None:
        """Draw both deviations anew, as Ornstein-Uhlenbeck processes of unit variance."""
        keep = math.exp(-_STEP_S / _NOISE_TIME_S)
        fresh = math.sqrt(1.0 - keep * keep)
        speed, steering = (float(rng.standard_normal()) for rng in (self._speed_rng, self._steering_rng))
        self._speed_noise = keep * self._speed_noise + fresh * speed
        self._steering_noise = keep * self._steering_noise + fresh * steering


#: Of the drawn values; chosen: from a linear to a clearly bent curve.
_RANGES: dict[str, tuple[float, float]] = {
    "full_steering_rad": (0.3, 0.45),
    "angle_deadband": (0.0, 0.06),
    "angle_exponent": (0.85, 1.3),
    "full_speed_cm_s": (150.0, 400.0),
    "throttle_deadband": (0.05, 0.2),
    "throttle_exponent": (0.8, 1.5),
}


class DonkeySettings(Settings):
    """How a Donkeycar turns its commands into motion; values that are None are drawn for each drive.

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
    """Draw the values that are None. All are drawn, so that setting one does not change another.

    Args:
        settings: Values that are set stay.
        rng: Source of randomness.
        needed_steering_rad: For the tightest bend of the road; a drawn full lock is no less.
    """
    values: dict[str, Any] = {}
    for name, (low, high) in _RANGES.items():
        drawn, fixed = float(rng.uniform(low, high)), getattr(settings, name)
        values[name] = drawn if fixed is None else fixed
    if settings.full_steering_rad is None:
        values["full_steering_rad"] = max(values["full_steering_rad"], needed_steering_rad)
    return DonkeySettings(**values)


class DonkeyCommands:
    """Conversion between angle and throttle, and steering and speed, of one car, both ways."""

    def __init__(self, settings: DonkeySettings) -> None:
        """Take settings without None.

        Raises:
            ValueError: If one is None.
        """
        values = [getattr(settings, name) for name in _RANGES]
        if None in values:
            raise ValueError("draw_donkey has to fill in the settings first")
        self._full_rad, angle_dead, angle_exponent, self._full_cm_s, dead, exponent = values
        self._angle, self._throttle = (angle_dead, angle_exponent), (dead, exponent)

    def angle(self, steering_rad: float) -> float:
        """Return the angle (-1 = left) that asks for a steering; limited to -1 to 1."""
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
