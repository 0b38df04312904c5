"""A heartbeat on a GPIO line, for a watchdog of hardware that switches the PCA9685's outputs off without it.

Source: Linux, ``include/uapi/linux/gpio.h``, version 2 of the interface (since 5.10).
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import struct

from pydantic import Field

from lanenet.config import Settings
from lanenet.errors import HardwareError

#: offsets, consumer, flags, number of attributes, their space, number of lines, space, file descriptor.
_REQUEST = struct.Struct("=64I32sQI260xI24xi")
_VALUES = struct.Struct("=QQ")
#: _IOWR(0xB4, 0x07, _REQUEST) and _IOWR(0xB4, 0x0F, _VALUES).
GET_LINE, SET_VALUES = 0xC000B407 | _REQUEST.size << 16, 0xC000B40F | _VALUES.size << 16
_OUTPUT = 1 << 3
#: Device of the lines on a Raspberry Pi's header.
HEADER = "/dev/gpiochip0"
_HIGH, _LOW = _VALUES.pack(1, 1), _VALUES.pack(0, 1)


class HeartbeatSettings(Settings):
    """Settings of :class:`Heartbeat`.

    Attributes:
        line: Number of the line; on a Raspberry Pi that of the GPIO: 4 is pin 7 of the header.
        chip: Device of the GPIO lines; ``gpioinfo`` lists them.
    """

    line: int = Field(ge=0, le=1023)
    chip: str = HEADER


class Heartbeat:
    """Makes a short pulse on a line."""

    def __init__(self, settings: HeartbeatSettings) -> None:
        """Prepare; nothing is opened."""
        self._settings = settings
        self._line = -1

    def open(self) -> None:
        """Take the line, low.

        Raises:
            HardwareError: If there is no such line, or another program has it.
        """
        chip, number = self._settings.chip, self._settings.line
        request = bytearray(_REQUEST.pack(number, *[0] * 63, b"lanenet", _OUTPUT, 0, 1, -1))
        try:
            handle = os.open(chip, os.O_RDWR | os.O_CLOEXEC)
            try:
                fcntl.ioctl(handle, GET_LINE, request)
            finally:
                os.close(handle)
        except OSError as error:
            raise HardwareError(
                f"{chip}: line {number} cannot be had for the heartbeat ({error.strerror or error}); "
                "gpioinfo shows who has it, and the group is gpio (sudo usermod -aG gpio $USER)"
            ) from None
        self._line = _REQUEST.unpack(request)[-1]

    def beat(self) -> None:
        """Make one pulse of some microseconds; if that fails, the watchdog stops the car."""
        if self._line >= 0:
            with contextlib.suppress(OSError):
                fcntl.ioctl(self._line, SET_VALUES, _HIGH)
                fcntl.ioctl(self._line, SET_VALUES, _LOW)

    def close(self) -> None:
        """Release the line; harmless if it is not open."""
        line, self._line = self._line, -1
        if line >= 0:
            os.close(line)
