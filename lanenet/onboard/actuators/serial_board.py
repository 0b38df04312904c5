"""Servo and speed controller on an Arduino, or another microcontroller, over a serial line.

The board has its own watchdog, so the motor stops even when this computer hangs or is unplugged. Its sketch
is ``firmware/lanenet_uno``, whose ``protocol.h`` has the same protocol in C++; tests connect the two.

Protocol, version 2: ASCII at 115200 baud, 8N1. A line is a letter, whole numbers separated by commas, ``*``,
a checksum and a line feed: ``N1500,1500*39``. The checksum is the CRC-8 of everything before the ``*``
(CRC-8/SMBUS) as two upper-case hexadecimal digits. A line with a wrong checksum, form or number is refused.

From the computer:

    V                               asks for the version
    N<steering_us>,<throttle_us>    sets the pulses of straight wheels and neutral, and goes there
    S<steering_us>,<throttle_us>,<sequence>,<time_ms>
                                    sets the pulses; <sequence> counts commands modulo 65536, <time_ms> is the
                                    board's, from its newest report

From the board:

    V<version>                      answers V
    B<version>                      sent once after the board has started
    A<time_ms>,<sequence>,<refused>,<driving>,<steering_us>,<throttle_us>
                                    every 10 ms: its clock (32 bits), the last command that it accepted, lines
                                    refused modulo 65536, 1 while a command is good and 0 in neutral, and the
                                    present pulses

A command is good until 80 ms after the report that it answers, by the board's own clock; then the board is in
neutral. A line that waited somewhere is refused: it cannot name a later time of the board than was known when
it was written. So the motor stops when either direction of the line fails, and no two clocks are compared.
Neutral always counts. After a start the board drives only once it got an ``N``, so that a board that
restarted stays in neutral until the computer has noticed.
"""

from __future__ import annotations

import errno
import logging
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

from pydantic import Field

from lanenet.data.files import require
from lanenet.errors import HardwareError
from lanenet.onboard.actuators.pulses import PulseSettings, brief_lock, command_pulses, neutral_pulses
from lanenet.onboard.i2c import driven_already, lock_owners
from lanenet.onboard.neutral import CONFIRMED, Neutral

VERSION = 2
BAUD = 115200
#: A command is good until this long after the report that it answers. Chosen: with the 20 ms of a pulse's
#: period the motor's pulse is neutral within 100 ms; commands come every 40 ms or faster.
COMMAND_S = 0.08
#: Time between two reports of the board.
REPORT_S = 0.01
#: ``neutral`` waits this long for the report that confirms it: two reports, and the lines on the way.
_CONFIRM_S = 0.03
#: The longest line, with its end.
MAX_LINE = 40
#: A line takes 3 ms; a port that takes none of it for this long is dead.
_WRITE_TIMEOUT_S = 0.05
#: The greeting is repeated this often; lines are lost while an Uno's boot loader runs.
_AGAIN_S = 0.1
#: The line's losses are counted over so many commands, and told from this share on. Chosen: three seconds at
#: 30 commands per second, and far more than single errors.
_COUNTED, _TOLD_SHARE = 100, 0.1
#: At most so many reads for the reports that wait; the kernel keeps less than this many times 4096 bytes.
_READS = 32

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


class Report(NamedTuple):
    """A report of the board.

    Attributes:
        time_ms: The board's clock, modulo 2^32.
        sequence: Number of the last command that it accepted.
        refused: Lines that it has refused since it started, modulo 65536: damaged or late.
        driving: 1 while a command is good, 0 in neutral.
        steering_us: Present pulse of the steering.
        throttle_us: Present pulse of the motor.
    """

    time_ms: int
    sequence: int
    refused: int
    driving: int
    steering_us: int
    throttle_us: int


def _remainder(byte: int) -> int:
    for _ in range(8):
        byte = (byte << 1 ^ 0x07 if byte & 0x80 else byte << 1) & 0xFF
    return byte


_REMAINDERS = bytes(map(_remainder, range(256)))


def crc8(data: bytes) -> int:
    """Return the CRC-8 of bytes: x^8 + x^2 + x + 1, start 0, not reflected (CRC-8/SMBUS)."""
    crc = 0
    for byte in data:
        crc = _REMAINDERS[crc ^ byte]
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
    if not (letter.isalpha() and all(field.isdigit() and len(field) <= 10 for field in fields)):
        return None
    return Line(letter.decode("ascii"), tuple(int(field) for field in fields))


class LineReader:
    """Splits a stream of bytes into lines.

    Attributes:
        valid: Valid lines so far.
        dropped: Invalid ones.
    """

    def __init__(self) -> None:
        self._rest = b""
        self.valid = self.dropped = 0

    def feed(self, data: bytes) -> list[Line]:
        """Return the valid lines that end in ``data``; invalid ones are dropped."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        # Noise without a line end must not pile up.
        self._rest = self._rest[-MAX_LINE:]
        good = [line for line in map(decode, lines) if line is not None]
        self.valid += len(good)
        self.dropped += len(lines) - len(good)
        return good


class SerialBoardSettings(PulseSettings):
    """Settings of :class:`SerialBoard`.

    Attributes:
        kind: Chooses this actuator.
        port: Device of the serial line; names under ``/dev/serial/by-id`` do not change between boots.
        start_s: Longest wait for the board's answer; an Uno restarts when its port is opened, which takes two
            seconds.
        silence_s: A board that sends no report for this long, or accepts no command, counts as gone; it
            reports every 0.01 s.
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
        self._report: Report | None = None
        self._version: int | None = None
        self._restarted = False
        #: Number of the last command, and since when the board has accepted none of those that were sent;
        #: None while none is due.
        self._sequence = 0
        #: The board's clock in the report that the last command answers, [ms].
        self._answered_ms = 0
        self._unaccepted_s: float | None = None
        #: Where the count of losses began: command, refused, valid and dropped lines; whether it was told.
        self._counts = (0, 0, 0, 0)
        self._told = False

    @property
    def port(self) -> str:
        """Device of the serial line."""
        return self._settings.port

    @property
    def refused_lines(self) -> int:
        """Lines that the board has refused since it started, by its last report: damaged or late."""
        return 0 if self._report is None else self._report.refused

    def open(self) -> None:
        """Send the neutral pulses, and wait until the board reports them.

        Raises:
            HardwareError: If the port or the board do not answer, another process drives it (named), or the
                sketch is of another version.
            MissingExtraError: If pyserial is not installed.
        """
        serial, termios = require("serial", "car"), require("termios", "car")
        settings = self._settings
        try:
            self._port = serial.Serial(
                settings.port, BAUD, timeout=0.0, write_timeout=_WRITE_TIMEOUT_S, exclusive=True
            )
            # Else the kernel lets go of DTR when the last program closes the port, and an Uno restarts,
            # without pulses, when the loop opens it again because the guard was killed.
            attributes = termios.tcgetattr(self._port.fd)
            attributes[2] &= ~termios.HUPCL
            termios.tcsetattr(self._port.fd, termios.TCSANOW, attributes)
        except (OSError, ValueError, termios.error) as error:
            self._release()
            if getattr(error, "errno", None) == errno.EAGAIN:
                # The port is locked.
                owner = next(iter(lock_owners(Path(settings.port).stat())), 0)
                raise driven_already(settings.port, owner) from None
            raise HardwareError(
                f"{settings.port}: cannot be opened ({error}); is the board plugged in (ls "
                "/dev/serial/by-id), and are you in its group (sudo usermod -aG dialout $USER)?"
            ) from None
        self._reader, self._report, self._version = LineReader(), None, None
        try:
            self._greet()
        except OSError as error:
            self._release()
            raise HardwareError(f"{settings.port}: the board was lost while it started ({error})") from None
        except HardwareError:
            self._release()
            raise

    def _greet(self) -> None:
        neutral = self._neutral_pulses()
        # The first line feed ends what somebody who was killed has left unfinished.
        greeting = b"\n" + encode("N", *neutral) + encode("V")
        end_s, again_s = time.monotonic() + self._settings.start_s, 0.0
        while (now_s := time.monotonic()) < end_s:
            if now_s >= again_s:
                self._port.write(greeting)
                again_s = now_s + _AGAIN_S
            self._receive()
            if self._version not in (None, VERSION):
                raise HardwareError(
                    f"{self._settings.port}: the sketch on the board uses version {self._version} of the "
                    f"protocol, expected {VERSION}; upload firmware/lanenet_uno of this lanenet "
                    "(firmware/README.md)"
                )
            report = self._report
            if self._version is not None and report is not None and report[-3:] == (0, *neutral):
                self._sequence, self._unaccepted_s, self._restarted = report.sequence, None, False
                self._counts = (self._sequence, report.refused, self._reader.valid, self._reader.dropped)
                return
            time.sleep(0.002)
        what = "no answer" if self._version is None else f"neutral pulses {neutral} not accepted"
        raise HardwareError(
            f"{self._settings.port}: {what} within {self._settings.start_s:g} s; is the sketch "
            "firmware/lanenet_uno on the board?"
        )

    def send(self, steering_rad: float, throttle: float) -> None:
        """Set both outputs; see :class:`lanenet.onboard.actuators.actuator.Actuator`.

        Raises:
            HardwareError: If it is not open, a value is not finite, or the board is gone, silent, accepts no
                commands or has restarted.
        """
        pulses = command_pulses(self._settings, steering_rad, throttle)
        if self._port is None:
            raise HardwareError(f"{self._settings.port}: not open")
        with self._lock:
            try:
                # First, as a command carries the newest time of the board.
                self._receive()
                self._check()
                self._tell_losses()
                self._command(round(pulses.steering_us), round(pulses.throttle_us))
            except OSError as error:
                raise HardwareError(
                    f"{self._settings.port}: the board is gone, or this computer is overloaded ({error})"
                ) from None

    def _check(self) -> None:
        """Compare the newest report with what was sent."""
        port, now_s, allowed_s = self._settings.port, time.monotonic(), self._settings.silence_s
        if self._restarted:
            raise HardwareError(f"{port}: the board has restarted and is in neutral; check its supply")
        if now_s - self._heard_s > allowed_s:
            raise HardwareError(
                f"{port}: the board has been silent for {now_s - self._heard_s:.2f} s, expected a report "
                f"every {REPORT_S:g} s; check its cable and supply"
            )
        if self._unaccepted_s is not None and now_s - self._unaccepted_s > allowed_s:
            raise HardwareError(
                f"{port}: the board reports, but has accepted no command for "
                f"{now_s - self._unaccepted_s:.2f} s: the last was {self._sequence}, it accepted "
                f"{self._accepted}, and has refused {self.refused_lines} lines as damaged or late; it is in "
                "neutral; check the cable from the computer to the board"
            )

    def _tell_losses(self) -> None:
        """Warn of a line that loses much, but not all, once until it is good again."""
        now = (self._sequence, self.refused_lines, self._reader.valid, self._reader.dropped)
        sent, refused, valid, dropped = (
            (after - before) & 0xFFFF for after, before in zip(now, self._counts, strict=True)
        )
        if sent < _COUNTED:
            return
        self._counts = now
        much = refused > _TOLD_SHARE * sent or dropped > _TOLD_SHARE * (valid + dropped)
        if much and not self._told:
            _log.warning(
                "%s: the board refused %d of the last %d commands as damaged or late, and %d of its %d lines "
                "came damaged; check the cable",
                self._settings.port, refused, sent, dropped, valid + dropped,
            )  # fmt: skip
        self._told = much

    def _command(self, steering_us: int, throttle_us: int) -> None:
        if self._unaccepted_s is None:
            self._unaccepted_s = time.monotonic()
        self._sequence = (self._sequence + 1) & 0xFFFF
        self._answered_ms = 0 if self._report is None else self._report.time_ms
        self._port.write(encode("S", steering_us, throttle_us, self._sequence, self._answered_ms))

    def neutral(self) -> Neutral | None:
        """Stop the motor and straighten the wheels; never raises.

        Returns:
            Confirmed if the board reports neutral and can accept none of the commands that were sent any
            more; None if it is not open.
        """
        if self._port is None:
            return None
        with brief_lock(self._lock) as locked:
            try:
                self._port.write(encode("N", *self._neutral_pulses()))
                if not locked:
                    return Neutral(False, f"{self._settings.port}: a command hangs")
                self._unaccepted_s = None
                # Unread reports would fill the line, and the next command would answer an old one.
                self._receive()
                end_s = time.monotonic() + _CONFIRM_S
                while not self._is_neutral() and time.monotonic() < end_s:
                    time.sleep(0.1 * REPORT_S)
                    self._receive()
            except Exception as error:
                if locked:
                    # A plug that slipped: the port is another one when it is back.
                    self._release()
                return Neutral(False, f"{self._settings.port}: {error}")
        if self._is_neutral():
            return CONFIRMED
        return Neutral(False, f"{self._settings.port}: the board does not report neutral")

    def _is_neutral(self) -> bool:
        """Tell whether the newest report shows neutral, and no command on the way can end it.

        The last command is over if the board has accepted it, has run out of its time, or has restarted.
        """
        report = self._report
        if report is None or time.monotonic() - self._heard_s > self._settings.silence_s:
            return False
        passed_ms = (report.time_ms - self._answered_ms) % (1 << 32)
        over = report.sequence == self._sequence or self._restarted or passed_ms > 1e3 * COMMAND_S
        return over and report[-3:] == (0, *self._neutral_pulses())

    def close(self) -> None:
        """Go to neutral and release the port; the board stays in neutral."""
        self.neutral()
        self._release()

    def _release(self) -> None:
        port, self._port = self._port, None
        if port is None:
            return
        # pyserial waits without end for a line that takes nothing, and reports a lost one by several errors.
        end_s = time.monotonic() + _WRITE_TIMEOUT_S
        try:
            while port.out_waiting and time.monotonic() < end_s:
                time.sleep(0.001)
            port.close()
        except Exception as error:
            _log.debug("%s: while it was closed: %s", self._settings.port, error)

    def _neutral_pulses(self) -> tuple[int, int]:
        pulses = neutral_pulses(self._settings)
        return round(pulses.steering_us), round(pulses.throttle_us)

    @property
    def _accepted(self) -> int:
        return 0 if self._report is None else self._report.sequence

    def _receive(self) -> None:
        """Read everything that the board has sent."""
        for _ in range(_READS):
            data = self._port.read(4096)
            for line in self._reader.feed(data):
                self._take(line)
            if len(data) < 4096:
                return

    def _take(self, line: Line) -> None:
        if line.letter == "A" and len(line.numbers) == len(Report._fields):
            before, self._report, self._heard_s = self._accepted, Report(*line.numbers), time.monotonic()
            if self._accepted == self._sequence:
                self._unaccepted_s = None
            elif self._accepted != before and self._unaccepted_s is not None:
                self._unaccepted_s = self._heard_s
        elif line.letter in "VB" and len(line.numbers) == 1:
            self._version = line.numbers[0]
            self._restarted |= line.letter == "B"
