"""From steering angle and throttle to the pulses of a servo and of an electronic speed controller."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from pydantic import Field, model_validator

from lanenet.config import Settings
from lanenet.errors import HardwareError

#: Servos and speed controllers take pulses of 1 to 2 ms; some take half a millisecond more.
SHORTEST_US, LONGEST_US = 500.0, 2500.0


class PulseSettings(Settings):
    """Pulses of this car's steering and motor.

    If the wheels or the motor turn the wrong way, exchange the two pulses. The defaults are Donkeycar's
    counts at the true rate of its PCA9685.

    Attributes:
        max_steering_rad: Angle of the front wheels at the ends of the servo's travel; others are clipped.
        steering_trim_rad: Added to every angle, so that the car runs straight at 0; positive left.
        steering_left_us: Pulse at the left end.
        steering_right_us: Pulse at the right end.
        throttle_forward_us: Pulse of throttle 1.
        throttle_stopped_us: Pulse of throttle 0: neutral.
        throttle_reverse_us: Pulse of throttle -1.
    """

    max_steering_rad: float = Field(default=0.45, gt=0.0, lt=math.pi / 2.0)
    steering_trim_rad: float = Field(default=0.0, ge=-0.3, le=0.3)
    steering_left_us: float = Field(default=1876.8, ge=SHORTEST_US, le=LONGEST_US)
    steering_right_us: float = Field(default=1183.2, ge=SHORTEST_US, le=LONGEST_US)
    throttle_forward_us: float = Field(default=2040.0, ge=SHORTEST_US, le=LONGEST_US)
    throttle_stopped_us: float = Field(default=1509.6, ge=SHORTEST_US, le=LONGEST_US)
    throttle_reverse_us: float = Field(default=897.6, ge=SHORTEST_US, le=LONGEST_US)

    @model_validator(mode="after")
    def _check_order(self) -> PulseSettings:
        if self.steering_left_us == self.steering_right_us:
            raise ValueError("steering_left_us and steering_right_us are equal, so the wheels cannot turn")
        low, high = sorted((self.throttle_forward_us, self.throttle_reverse_us))
        if not low < self.throttle_stopped_us < high:
            raise ValueError(
                f"throttle_stopped_us {self.throttle_stopped_us:g} does not lie between throttle_forward_us "
                f"{self.throttle_forward_us:g} and throttle_reverse_us {self.throttle_reverse_us:g}"
            )
        return self


@dataclass(frozen=True)
class Pulses:
    """The two pulses of a command.

    Attributes:
        steering_us: Pulse of the steering servo.
        throttle_us: Pulse of the speed controller.
    """

    steering_us: float
    throttle_us: float


def command_pulses(settings: PulseSettings, steering_rad: float, throttle: float) -> Pulses:
    """Return the pulses of a command.

    Linear between the ends of the steering, and from neutral to either end of the throttle; clipped beyond.

    Args:
        settings: The car's pulses.
        steering_rad: Angle of the front wheels, positive left.
        throttle: -1 (full reverse) to 1 (full ahead).

    Raises:
        HardwareError: If a value is not finite.
    """
    if not (math.isfinite(steering_rad) and math.isfinite(throttle)):
        raise HardwareError(
            f"actuator: found steering {steering_rad} rad and throttle {throttle}, expected finite numbers"
        )
    left = _clip((steering_rad + settings.steering_trim_rad) / settings.max_steering_rad)
    middle_us = 0.5 * (settings.steering_left_us + settings.steering_right_us)
    ahead = _clip(throttle)
    end_us = settings.throttle_forward_us if ahead >= 0.0 else settings.throttle_reverse_us
    return Pulses(
        steering_us=middle_us + left * (settings.steering_left_us - middle_us),
        throttle_us=settings.throttle_stopped_us + abs(ahead) * (end_us - settings.throttle_stopped_us),
    )


def neutral_pulses(settings: PulseSettings) -> Pulses:
    """Return the pulses of neutral and of straight wheels."""
    return command_pulses(settings, 0.0, 0.0)


def _clip(share: float) -> float:
    return min(max(share, -1.0), 1.0)


#: Longest wait of neutral for a command in progress, which takes a few milliseconds.
_LONGEST_WAIT_S = 0.02


@contextmanager
def brief_lock(lock: threading.Lock) -> Iterator[bool]:
    """Take a lock, but go on without it if it is not free soon: a hanging command must not block neutral.

    Args:
        lock: Held by commands while they are sent.

    Yields:
        Whether the lock was free.
    """
    locked = lock.acquire(timeout=_LONGEST_WAIT_S)
    try:
        yield locked
    finally:
        if locked:
            lock.release()
