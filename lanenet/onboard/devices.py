"""What the drive loop needs of a camera."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8


class SourceEnded(Exception):  # noqa: N818 (an end, like StopIteration, and not an error)
    """A recording has ended: there will be no more frames."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One image of a camera.

    Attributes:
        image_bgr: The image; the source does not change it any more.
        t_s: Time of exposure on the clock of :func:`time.monotonic`; the time of arrival if that is unknown.
        number: Counts all frames of the source, also those that were not read.
        age_known: Whether ``t_s`` is the time of exposure.
        lap: Repetition of a recording in a loop, whose images come again; 0 of a camera.
    """

    image_bgr: UInt8[np.ndarray, "h w 3"] = field(repr=False)
    t_s: float
    number: int
    age_known: bool = True
    lap: int = 0


@runtime_checkable
class FrameSource(Protocol):
    """A camera, or a recording in its place; used by one thread."""

    def open(self) -> None:
        """Start the device.

        Raises:
            HardwareError: If it is missing or does not answer; the message names it and what to check.
            MissingExtraError: If its driver is not installed.
        """
        ...

    def read(self, timeout_s: float) -> Frame | None:
        """Return the newest frame that was not returned before; waits for one if there is none.

        Args:
            timeout_s: The longest wait, [s]; the call may not last noticeably longer.

        Returns:
            The frame, or None if there is no new one: the device is late, or lost and being restarted.

        Raises:
            SourceEnded: If a recording is over.
            HardwareError: If the device is gone for good.
        """
        ...

    def close(self) -> None:
        """Release the device; harmless if it is not open."""
        ...
