"""From steering angle and throttle to the pulses of a servo and of an electronic speed controller."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import ClassVar

from pydantic import Field

from lanenet.config import Rule, Settings
from lanenet.errors import HardwareError

#: Servos and speed controllers take pulses of 1 to 2 ms; some take half a millisecond more.
SHORTEST_US, LONGEST_US = 500.0, 2500.0
#: From a pulse in the middle to one at an end. Chosen: a tenth of the 500 us that servos and speed
#: controllers take; a speed controller holds neutral for about that.
LEAST_TRAVEL_US = 50.0
#: Largest trim as a share of ``max_steering_rad``. Chosen: to the side of the trim the wheels still turn by
#: half of the angle; beyond it, the servo's horn has to be refitted.
MOST_TRIM = 0.5


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
        throttle_reverse_us: Pulse of throttle -1, which no drive commands; equal to ``throttle_stopped_us``
            for a speed controller without reverse.
    """

    rules: ClassVar[tuple[Rule, ...]] = (
        Rule(
            ("steering_left_us", "steering_right_us"),
            lambda s: abs(s.steering_left_us - s.steering_right_us) >= 2.0 * LEAST_TRAVEL_US,
            lambda _: (
                f"expected them {2.0 * LEAST_TRAVEL_US:g} us apart or more, else the wheels cannot turn"
            ),
        ),
        Rule(
            ("throttle_stopped_us", "throttle_forward_us", "throttle_reverse_us"),
            lambda s: _has_sides(s.throttle_reverse_us, s.throttle_stopped_us, s.throttle_forward_us),
            lambda _: (
                "expected throttle_stopped_us between the two others, or equal to throttle_reverse_us if "
                "the speed controller has no reverse"
            ),
        ),
        Rule(
            ("throttle_stopped_us", "throttle_forward_us"),
            lambda s: abs(s.throttle_forward_us - s.throttle_stopped_us) >= LEAST_TRAVEL_US,
            lambda _: (
                f"expected them {LEAST_TRAVEL_US:g} us apart or more: closer, every throttle is neutral, "
                "or none is"
            ),
        ),
        Rule(
            ("steering_trim_rad", "max_steering_rad"),
            lambda s: abs(s.steering_trim_rad) <= MOST_TRIM * s.max_steering_rad,
            lambda s: (
                f"expected a trim of {MOST_TRIM * s.max_steering_rad:g} rad at most, half of the servo's "
                "travel to a side: refit the servo's horn"
            ),
        ),
    )

    max_steering_rad: float = Field(default=0.45, gt=0.0, lt=math.pi / 2.0)
    steering_trim_rad: float = Field(default=0.0, ge=-0.3, le=0.3)
    steering_left_us: float = Field(default=1876.8, ge=SHORTEST_US, le=LONGEST_US)
    steering_right_us: float = Field(default=1183.2, ge=SHORTEST_US, le=LONGEST_US)
    throttle_forward_us: float = Field(default=2040.0, ge=SHORTEST_US, le=LONGEST_US)
    throttle_stopped_us: float = Field(default=1509.6, ge=SHORTEST_US, le=LONGEST_US)
    throttle_reverse_us: float = Field(default=897.6, ge=SHORTEST_US, le=LONGEST_US)


def _has_sides(reverse_us: float, stopped_us: float, forward_us: float) -> bool:
    """Tell whether neutral lies between the two ends; that of reverse may be neutral."""
    low_us, high_us = sorted((reverse_us, forward_us))
    return low_us <= stopped_us <= high_us


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
