"""What the drive loop needs of an actuator: steering, throttle and neutral."""

from __future__ import annotations

from typing import Protocol, runtime_checkable


@runtime_checkable
class Actuator(Protocol):
    """Steering servo and motor controller."""

    def open(self) -> None:
        """Connect, and put the motor into neutral before anything else.

        Raises:
            HardwareError: If the device is missing or does not answer; names it and what to check.
            MissingExtraError: If its driver is not installed.
        """
        ...

    def send(self, steering_rad: float, throttle: float) -> None:
        """Set both outputs.

        Args:
            steering_rad: Angle of the front wheels, positive left; clipped to the car's largest.
            throttle: -1 (full reverse) to 1 (full ahead).

        Raises:
            HardwareError: If the device did not take it.
        """
        ...

    def neutral(self) -> None:
        """Put the motor into neutral and the wheels straight, at any time; never raises."""
        ...

    def close(self) -> None:
        """Go to neutral, then release the device; harmless if it is not open, never raises."""
        ...
