"""What the drive loop asks of a camera and of an actuator; every driver answers to one of these protocols.

Each driver has a strict settings class with ``kind``. :mod:`lanenet.onboard.cameras` unites those of the
sources as ``SourceSettings`` and builds one with ``open_source(settings)``;
:mod:`lanenet.onboard.actuators` has ``ActuatorSettings`` and ``make_actuator(settings)``. Neither function
touches the device: :meth:`FrameSource.open` and :meth:`Actuator.open` do.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8


class SourceEnded(Exception):  # noqa: N818 (an end, like StopIteration, and not an error)
    """A recording has come to its end: there will never be another frame."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One image of a camera.

    Attributes:
        image_bgr: The image. The source does not write to the array once it is handed out.
        t_s: When it was exposed, on the clock of :func:`time.monotonic`: the sensor's own time where the
            driver tells it, else when it arrived.
        number: Counts the frames of the source, those that nobody read included.
    """

    image_bgr: UInt8[np.ndarray, "h w 3"] = field(repr=False)
    t_s: float
    number: int


@runtime_checkable
class FrameSource(Protocol):
    """A camera, or a recording that plays one; used by one thread."""

    def open(self) -> None:
        """Start the device.

        Raises:
            HardwareError: If it is not there or does not answer; the message names it and what to check.
            MissingExtraError: If its driver is not installed.
        """
        ...

    def read(self, timeout_s: float) -> Frame | None:
        """Return the newest frame that was not returned before, waiting for it if need be.

        Args:
            timeout_s: The longest wait, [s]; the call may not last noticeably longer.

        Returns:
            The frame, or None if there was nothing new: the device is late, or gone and being looked for.

        Raises:
            SourceEnded: If a recording is over.
            HardwareError: If the device is gone for good.
        """
        ...

    def close(self) -> None:
        """Release the device; harmless when it is not open."""
        ...


@runtime_checkable
class Actuator(Protocol):
    """Steering servo and motor controller."""

    def open(self) -> None:
        """Connect, and put the motor into neutral before anything else.

        Raises:
            HardwareError: If the device is not there or does not answer; names it and what to check.
            MissingExtraError: If its driver is not installed.
        """
        ...

    def send(self, steering_rad: float, throttle: float) -> None:
        """Set both outputs.

        Args:
            steering_rad: Angle of the front wheels, positive left; more than the car's lock is cut off.
            throttle: -1 (full reverse) to 1 (full ahead).

        Raises:
            HardwareError: If the device did not take it.
        """
        ...

    def neutral(self) -> None:
        """Put the motor into neutral and the wheels straight; may be called at any time, never raises."""
        ...

    def close(self) -> None:
        """Go to neutral, then release the device; harmless when it is not open, never raises."""
        ...
