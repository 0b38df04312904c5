"""What the guard needs of an actuator."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from lanenet.onboard.neutral import Neutral


@runtime_checkable
class Actuator(Protocol):
    """Steering servo and motor controller."""

    def open(self) -> None:
        """Connect, and put the motor into neutral before anything else.

        A device that is there and does not answer stays connected for further attempts at neutral, until it
        is closed.

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

    def neutral(self) -> Neutral | None:
        """Put the motor into neutral and the wheels straight, at any time; never raises.

        Returns:
            Whether the hardware holds it, as read back from there; None if the device is not open.
        """
        ...

    def close(self) -> None:
        """Go to neutral, then release the device; harmless if it is not open, never raises."""
        ...


@runtime_checkable
class Spare(Protocol):
    """An actuator that a second process can put into neutral beside its owner."""

    def attach(self) -> None:
        """Open the device without touching it or owning it.

        Raises:
            HardwareError: If it cannot be opened.
            MissingExtraError: If its driver is not installed.
        """
        ...

    def neutral(self) -> Neutral | None:
        """Put the motor into neutral, at any time; never raises. See :meth:`Actuator.neutral`."""
        ...

    def release(self) -> None:
        """Release the device and leave it as it is; never raises."""
        ...
