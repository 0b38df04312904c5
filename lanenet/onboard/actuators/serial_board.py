"""Servo and speed controller on an Arduino, or another microcontroller, over a serial line.

The board has a watchdog of its own, so the motor stops even when this computer is frozen or unplugged. The
lines are those of :mod:`lanenet.onboard.actuators.line_protocol`, the sketch is ``firmware/lanenet_uno``.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from typing import Any, Literal

from pydantic import Field

from lanenet.data.files import require
from lanenet.errors import HardwareError
from lanenet.onboard.actuators.brief_lock import brief_lock
from lanenet.onboard.actuators.line_protocol import BAUD, VERSION, Line, LineReader, encode
from lanenet.onboard.actuators.pulses import Pulses, PulseSettings, command_pulses, neutral_pulses

_log = logging.getLogger(__name__)
#: A line takes 2 ms; a port that takes none of it for so long is dead.
_WRITE_TIMEOUT_S = 0.05


class SerialBoardSettings(PulseSettings):
    """Settings of :class:`SerialBoard`.

    Attributes:
        kind: Chooses this actuator.
        port: Device of the serial line. The names under ``/dev/serial/by-id`` stay the same.
        start_s: How long to wait for the board to answer; an Uno restarts when its port is opened, which
            takes two seconds.
        silence_s: The board reports 20 times per second; after so long without a report it counts as gone.
    """

    kind: Literal["serial"] = "serial"
    port: str = "/dev/ttyACM0"
    start_s: float = Field(default=5.0, gt=0.0)
    silence_s: float = Field(default=0.3, ge=0.1)


class SerialBoard:
    """Steering servo and motor on a microcontroller; an ``Actuator``."""

    def __init__(self, settings: SerialBoardSettings) -> None:
        self._settings = settings
        self._port: Any = None
        self._lock = threading.Lock()
        self._reader = LineReader()
        self._heard_s = 0.0
        #: The board's newest report: lines taken, lines dropped, driving, the two pulses.
        self._report: tuple[int, ...] | None = None

    @property
    def rejected_lines(self) -> int:
        """Lines that the board dropped since it started, as far as it has reported."""
        return 0 if self._report is None else self._report[1]

    def open(self) -> None:
        """Wait for the board, tell it the neutral pulses, and see that it took them.

        Raises:
            HardwareError: If the port or the board do not answer, or the sketch is of another version.
            MissingExtraError: If pyserial is not installed.
        """
        serial = require("serial", "car")
        settings = self._settings
        try:
            self._port = serial.Serial(
                settings.port, BAUD, timeout=0.0, write_timeout=_WRITE_TIMEOUT_S, exclusive=True
            )
        except (OSError, ValueError) as error:
            raise HardwareError(
                f"{settings.port}: cannot be opened ({error}); is the board plugged in (ls "
                "/dev/serial/by-id), and are you in its group (sudo usermod -aG dialout $USER)?"
            ) from None
        self._reader, self._report = LineReader(), None
        try:
            self._greet()
        except OSError as error:
            self._release()
            raise HardwareError(f"{settings.port}: the board was lost while it started ({error})") from None
        except HardwareError:
            self._release()
            raise

    def _greet(self) -> None:
        neutral = neutral_pulses(self._settings)
        pulses = (round(neutral.steering_us), round(neutral.throttle_us))
        end_s = time.monotonic() + self._settings.start_s
        version: int | None = None
        while time.monotonic() < end_s:
            # Lines that come while the board's boot loader listens are lost, so they are said again.
            self._port.write(encode("V") if version is None else encode("N", *pulses))
            wait_s = time.monotonic() + 0.1
            while time.monotonic() < wait_s:
                for line in self._receive():
                    if line.letter == "V" and len(line.numbers) == 1:
                        version = line.numbers[0]
                if version not in (None, VERSION):
                    raise HardwareError(
                        f"{self._settings.port}: the board speaks version {version} of the protocol, "
                        f"expected {VERSION}; load the sketch firmware/lanenet_uno"
                    )
                if version is not None and self._report is not None and self._report[3:] == pulses:
                    return
                time.sleep(0.005)
        what = "no answer" if version is None else f"neutral pulses {pulses} not taken over"
        raise HardwareError(
            f"{self._settings.port}: {what} within {self._settings.start_s:g} s; is the sketch "
            "firmware/lanenet_uno on the board?"
        )

    def send(self, steering_rad: float, throttle: float) -> None:
        """Set both outputs; see :class:`lanenet.onboard.hardware.Actuator`.

        Raises:
            HardwareError: If it is not open, a value is not a number, or the board is gone, silent or has
                started again.
        """
        pulses = command_pulses(self._settings, steering_rad, throttle)
        if self._port is None:
            raise HardwareError(f"{self._settings.port}: not open")
        with self._lock:
            try:
                self._write(pulses)
                lines = self._receive()
            except OSError as error:
                raise HardwareError(f"{self._settings.port}: the board is gone ({error})") from None
        if any(line.letter == "V" for line in lines):
            raise HardwareError(
                f"{self._settings.port}: the board has started again by itself, and stands in neutral; check "
                "its supply"
            )
        silent_s = time.monotonic() - self._heard_s
        if silent_s > self._settings.silence_s:
            raise HardwareError(
                f"{self._settings.port}: the board has been silent for {silent_s:.2f} s, expected a report "
                "every 0.05 s; check its cable and supply"
            )

    def neutral(self) -> None:
        """Stop the motor and straighten the wheels; never raises."""
        if self._port is None:
            return
        with brief_lock(self._lock):
            try:
                self._write(neutral_pulses(self._settings))
            except Exception as error:
                _log.error(
                    "%s: neutral could not be sent, the board's watchdog stops: %s",
                    self._settings.port,
                    error,
                )

    def close(self) -> None:
        """Go to neutral and release the port; the board stays in neutral."""
        self.neutral()
        self._release()

    def _release(self) -> None:
        port, self._port = self._port, None
        if port is not None:
            with contextlib.suppress(OSError):
                port.flush()
            with contextlib.suppress(OSError):
                port.close()

    def _write(self, pulses: Pulses) -> None:
        self._port.write(encode("S", round(pulses.steering_us), round(pulses.throttle_us)))

    def _receive(self) -> list[Line]:
        lines = self._reader.feed(self._port.read(4096))
        for line in lines:
            if line.letter == "A" and len(line.numbers) == 5:
                self._report, self._heard_s = line.numbers, time.monotonic()
        return lines
