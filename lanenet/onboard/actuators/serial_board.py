"""Servo and speed controller on an Arduino, or another microcontroller, over a serial line.

The board has its own watchdog, so the motor stops even when this computer hangs or is unplugged. Its sketch
is ``firmware/lanenet_uno``, whose ``protocol.h`` has the same protocol in C++; tests connect the two.

Protocol, version 1: ASCII at 115200 baud, 8N1. A line is a letter, whole numbers separated by commas, ``*``,
a checksum and a line feed: ``S1500,1500*49``. The checksum is the CRC-8 of everything before the ``*``
(CRC-8/SMBUS) as two upper-case hexadecimal digits. A line with a wrong checksum, form or number is dropped
and counted.

From the computer:

    V                               asks for the version
    N<steering_us>,<throttle_us>    sets the pulses of straight wheels and neutral, and goes there
    S<steering_us>,<throttle_us>    sets the pulses now

From the board:

    V<version>                      answers V; also sent once after the board has started
    A<accepted>,<rejected>,<driving>,<steering_us>,<throttle_us>
                                    every 50 ms: counts of lines modulo 65536, 1 while commands arrive and 0
                                    in neutral, and the present pulses

The board goes to its neutral pulses after 100 ms without a valid ``S``. After a start it drives only once it
got an ``N``, so that a board that restarted stays in neutral until the computer has noticed.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from dataclasses import dataclass
from typing import Any, Literal

from pydantic import Field

from lanenet.data.files import require
from lanenet.errors import HardwareError
from lanenet.onboard.actuators.pulses import Pulses, PulseSettings, brief_lock, command_pulses, neutral_pulses

VERSION = 1
BAUD = 115200
#: After this time without a valid command the board goes to neutral.
WATCHDOG_S = 0.1
#: Time between two reports of the board.
REPORT_S = 0.05
#: The longest line, with its end.
MAX_LINE = 40
_POLYNOMIAL = 0x07
#: A line takes 2 ms; a port that takes none of it for this long is dead.
_WRITE_TIMEOUT_S = 0.05

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Line:
    """One valid line.

    Attributes:
        letter: Its kind.
        numbers: Its numbers.
    """

    letter: str
    numbers: tuple[int, ...]


def crc8(data: bytes) -> int:
    """Return the CRC-8 of bytes: x^8 + x^2 + x + 1, start 0, not reflected (CRC-8/SMBUS)."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = ((crc << 1) ^ _POLYNOMIAL if crc & 0x80 else crc << 1) & 0xFF
    return crc


def encode(letter: str, *numbers: int) -> bytes:
    """Return a line with its checksum and its end."""
    text = (letter + ",".join(str(n) for n in numbers)).encode("ascii")
    return text + f"*{crc8(text):02X}\n".encode("ascii")


def decode(line: bytes) -> Line | None:
    """Read a line without its end; None if its form or checksum is wrong."""
    text, star, checksum = line.rstrip(b"\r").rpartition(b"*")
    if not star or len(checksum) != 2 or checksum != f"{crc8(text):02X}".encode("ascii"):
        return None
    letter, fields = text[:1], text[1:].split(b",") if len(text) > 1 else []
    if not (letter.isalpha() and all(field.isdigit() and len(field) <= 5 for field in fields)):
        return None
    return Line(letter.decode("ascii"), tuple(int(field) for field in fields))


class LineReader:
    """Splits a stream of bytes into lines."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[Line]:
        """Return the valid lines that end in ``data``; invalid ones are dropped."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        # Noise without a line end must not pile up.
        self._rest = self._rest[-MAX_LINE:]
        return [line for line in map(decode, lines) if line is not None]


class SerialBoardSettings(PulseSettings):
    """Settings of :class:`SerialBoard`.

    Attributes:
        kind: Chooses this actuator.
        port: Device of the serial line; names under ``/dev/serial/by-id`` do not change between boots.
        start_s: Longest wait for the board's answer; an Uno restarts when its port is opened, which takes two
            seconds.
        silence_s: A board that sends no report for this long counts as gone; it reports every 0.05 s.
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
        #: The board's newest report: lines accepted, lines rejected, driving, the two pulses.
        self._report: tuple[int, ...] | None = None

    @property
    def rejected_lines(self) -> int:
        """Lines that the board has rejected since it started, by its last report."""
        return 0 if self._report is None else self._report[1]

    def open(self) -> None:
        """Wait for the board, send it the neutral pulses, and wait until it reports them.

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
            # Repeated, since lines are lost while the board's boot loader runs.
            self._port.write(encode("V") if version is None else encode("N", *pulses))
            wait_s = time.monotonic() + 0.1
            while time.monotonic() < wait_s:
                for line in self._receive():
                    if line.letter == "V" and len(line.numbers) == 1:
                        version = line.numbers[0]
                if version not in (None, VERSION):
                    raise HardwareError(
                        f"{self._settings.port}: the board uses version {version} of the protocol, "
                        f"expected {VERSION}; load the sketch firmware/lanenet_uno"
                    )
                if version is not None and self._report is not None and self._report[3:] == pulses:
                    return
                time.sleep(0.005)
        what = "no answer" if version is None else f"neutral pulses {pulses} not accepted"
        raise HardwareError(
            f"{self._settings.port}: {what} within {self._settings.start_s:g} s; is the sketch "
            "firmware/lanenet_uno on the board?"
        )

    def send(self, steering_rad: float, throttle: float) -> None:
        """Set both outputs; see :class:`lanenet.onboard.devices.Actuator`.

        Raises:
            HardwareError: If it is not open, a value is not finite, or the board is gone, silent or has
                restarted.
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
                f"{self._settings.port}: the board has restarted and is in neutral; check its supply"
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
                    "%s: neutral could not be sent, the board's watchdog stops the motor: %s",
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
