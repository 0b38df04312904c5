"""The guard's process: owns the actuator and goes to neutral when commands stay away.

:mod:`lanenet.onboard.guard` starts it with the arguments ``LINE PULSE SETTINGS FIRST WATCHDOG_S GIVE_UP_S``:
the numbers of an open socket and of a pipe, the actuator's settings and its first writes as JSON. The loop
sends messages of fixed size; the guard answers with lines of text: ``ready``, ``ok NUMBER`` for each message,
``neutral STATE: REASON``, ``failed REASON``, ``stopped`` if it was asked to end, and at its end ``closed``
with the fields of a :class:`lanenet.onboard.neutral.Neutral` as JSON, null if the actuator was not reached.
Into the pipe goes a byte at every turn, so that the loop's process sees at once that the guard is stopped or
gone.

At its end the guard repeats neutral until the actuator confirms it (:mod:`lanenet.onboard.neutral`).

What needs time to import is imported after the first neutral.
"""

from __future__ import annotations

import contextlib
import gc
import json
import logging
import math
import os
import select
import signal
import socket
import struct
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from types import FrameType
from typing import TYPE_CHECKING, NoReturn

from lanenet.errors import LanenetError, MotorMayRunError
from lanenet.onboard.i2c import I2CChip
from lanenet.onboard.neutral import HOLD_S, Neutral, reach_neutral, settle

if TYPE_CHECKING:
    from lanenet.onboard.actuators.actuator import Actuator

log = logging.getLogger("lanenet.onboard.guard")

#: Kind of message, its number, steering, throttle, and the time at which it expires.
MESSAGE = struct.Struct("<cxxxIddd")
DRIVE, NEUTRAL, QUIT = b"D", b"N", b"Q"
#: What the guard says if it was asked to end.
STOPPED = "asked to end"
#: What holds is sent again this often, in case it was lost on the wire; chosen: half of the time for which a
#: command holds on the Arduino board, which must not run out between two frames of a slow camera.
_REFRESH_S = 0.04
#: A sign of life at least this often: several within the loop's patience.
_TURN_S = 0.015
#: A driver needs a few milliseconds; after the first time it counts as hanging, checked at the second.
_SLOW_S, _LOOK_S = 0.05, 0.02
#: Lines of the log that wait for a terminal, after which the oldest are lost, and how long the end waits.
_LOG_LINES, _LOG_S = 100, 0.2


class Guard:
    """Owns the actuator: neutral, unless there is a valid command."""

    def __init__(
        self, line: socket.socket, pulse: int, actuator: Actuator, watchdog_s: float, give_up_s: float
    ) -> None:
        self._line, self._pulse, self._actuator = line, pulse, actuator
        self._watchdog_s, self._give_up_s = watchdog_s, give_up_s
        self._until_s = -math.inf
        self._heard_s = time.monotonic()
        self._logged_s = -math.inf
        self._driving = False
        self._command = (0.0, 0.0)
        #: When the actuator was last told something.
        self._told_s = -math.inf
        #: Since when the actuator does not confirm neutral; infinite while it does.
        self._doubt_s = math.inf
        #: Why no command is accepted any more; empty while they are.
        self._over = ""
        #: When the present call of the driver began; infinite if there is none.
        self._busy_s = math.inf
        self.asked_to_end = False

    def run(self) -> str:
        """Serve until the loop is gone or ends; returns why it ended."""
        ended = threading.Event()
        threading.Thread(target=self._oversee, args=(ended,), name="driver hangs", daemon=True).start()
        try:
            return self._serve()
        finally:
            ended.set()

    def _oversee(self, ended: threading.Event) -> None:
        """Send neutral while a driver hangs in a command, until it continues."""
        while not ended.wait(_LOOK_S):
            begun_s = self._busy_s
            if time.monotonic() - begun_s <= _SLOW_S:
                continue
            log.warning("the actuator's driver hangs in a command: neutral is tried past it")
            settle(self._actuator.neutral, partial(self._is_past, begun_s))
            if not self._is_past(begun_s):
                # The loop would have killed this process: it is gone, and so is every way to neutral.
                give_up(Neutral(False, "the actuator's driver does not return"))

    def _is_past(self, begun_s: float) -> bool:
        return self._busy_s != begun_s

    @contextmanager
    def _busy(self) -> Iterator[None]:
        self._busy_s = time.monotonic()
        try:
            yield
        finally:
            self._busy_s = math.inf

    def _serve(self) -> str:
        buffer = b""
        while True:
            beat(self._pulse)
            left_s = self._until_s - time.monotonic() if self._driving else _TURN_S
            wait_s = min(_TURN_S, max(0.0, left_s))
            readable, _, _ = select.select([self._line], [], [], wait_s)
            if self.asked_to_end:
                return STOPPED
            if readable:
                try:
                    data = self._line.recv(65536)
                except OSError:
                    data = b""
                if not data:
                    return "the drive loop is gone"
                buffer += data
                whole = len(buffer) - len(buffer) % MESSAGE.size
                messages = list(MESSAGE.iter_unpack(buffer[:whole]))
                buffer = buffer[whole:]
                if any(kind == QUIT for kind, *_ in messages):
                    return "the drive loop has ended"
                if messages:
                    # Of several waiting messages only the newest counts.
                    self._obey(*messages[-1])
            self._expire(readable=bool(readable))

    def _obey(self, kind: bytes, number: int, steering_rad: float, throttle: float, until_s: float) -> None:
        now_s = time.monotonic()
        self._heard_s = now_s
        # No command is valid for longer than the watchdog, whatever it says.
        until_s = min(until_s, now_s + self._watchdog_s)
        sane = math.isfinite(steering_rad) and math.isfinite(throttle) and abs(throttle) <= 1.0
        if kind == DRIVE and sane and until_s > now_s and not self._over:
            self._driving, self._until_s = True, until_s
            self._command = (steering_rad, throttle)
            if not self._drive():
                return
        else:
            self._neutral()
            if kind == DRIVE and not sane:
                self._say(f"neutral the command is not finite: steering {steering_rad}, throttle {throttle}")
            if self._over:
                self._say(f"failed {self._over}")
                return
        self._say(f"ok {number}")

    def _drive(self) -> bool:
        """Send the present command; False if the actuator failed."""
        try:
            with self._busy():
                self._actuator.send(*self._command)
            self._told_s = time.monotonic()
        except Exception as error:
            self._neutral()
            self._over = f"the actuator failed: {error}"
            self._say(f"failed {self._over}")
            return False
        return True

    def _expire(self, readable: bool) -> None:
        now_s = time.monotonic()
        if self._driving and now_s >= self._until_s:
            text = self._neutral()
            reason = f"no command from the drive loop for {1e3 * (now_s - self._heard_s):.0f} ms"
            self._say(f"neutral {text}: {reason}")
            # A loop that hangs cannot log it. Once a second at most: a slow camera lets every command expire.
            if now_s - self._logged_s > 1.0:
                self._logged_s = now_s
                log.warning("%s: %s", text, reason)
        elif not readable and now_s - self._told_s >= _REFRESH_S:
            if self._driving:
                self._drive()
            else:
                self._neutral()
        if not self._over and now_s - self._heard_s > self._give_up_s and math.isfinite(self._until_s):
            self._over = f"the drive loop was silent for {self._give_up_s:g} s"

    def _neutral(self) -> str:
        """Send neutral; returns what is known of it, in words."""
        with self._busy():
            left = self._actuator.neutral()
        beat(self._pulse)
        now_s = time.monotonic()
        self._driving, self._told_s = False, now_s
        if left is None or left.confirmed is not False:
            self._doubt_s = math.inf
        elif now_s - self._doubt_s > self._give_up_s and not self._over:
            self._over = f"the actuator does not confirm neutral: {left.why}"
            self._say(f"failed {self._over}")
        else:
            self._doubt_s = min(self._doubt_s, now_s)
        return "not open" if left is None else left.text

    def _say(self, text: str) -> None:
        _say(self._line, text)


def give_up(left: Neutral) -> NoReturn:
    """Say that the motor may run, and end the process although a thread of it hangs in the driver."""
    log.critical(left.may_run)
    logging.shutdown()
    os._exit(MotorMayRunError.exit_code)


def beat(pulse: int) -> None:
    """Give the loop's process a sign of life."""
    # The process, not its loop, reads it: if it is full, nobody does.
    with contextlib.suppress(OSError):
        os.write(pulse, b".")


def _say(line: socket.socket, text: str) -> None:
    # A loop that does not read must not block the guard.
    with contextlib.suppress(OSError):
        line.send((text.replace("\n", " ") + "\n").encode(), socket.MSG_DONTWAIT)


class PatientLog(logging.Handler):
    """Writes lines from a thread: a terminal that takes nothing (Ctrl-S) must not hold up the guard."""

    def __init__(self) -> None:
        """Start the thread."""
        super().__init__()
        # On a terminal the drive's live line may stand where it writes.
        clear = "\r\033[K" if os.isatty(2) else ""
        self.setFormatter(logging.Formatter(f"{clear}lanenet guard: %(message)s"))
        self._lines: deque[bytes] = deque(maxlen=_LOG_LINES)
        self._waiting, self._written = threading.Event(), threading.Event()
        threading.Thread(target=self._run, name="log", daemon=True).start()

    def emit(self, record: logging.LogRecord) -> None:
        """Leave a line to the thread."""
        self._written.clear()
        self._lines.append(f"{self.format(record)}\n".encode())
        self._waiting.set()

    def _run(self) -> None:
        while self._waiting.wait():
            self._waiting.clear()
            while self._lines:
                # Past sys.stderr, whose lock a blocked writer would keep until after the end.
                with contextlib.suppress(OSError, IndexError):
                    os.write(2, self._lines.popleft())
            self._written.set()

    def close(self) -> None:
        """Wait a moment for what is left."""
        if self._lines or self._waiting.is_set():
            self._written.wait(_LOG_S)
        super().close()


def actuator_from_json(text: str) -> Actuator:
    """Build an actuator from its settings as JSON; the device is not touched.

    Raises:
        ConfigError: If the settings name a file that cannot be used.
    """
    from lanenet.onboard.actuators import actuator_from_json

    return actuator_from_json(text)


def first_neutral(text: str) -> I2CChip | None:
    """Put the actuator into neutral with what was prepared for it.

    Args:
        text: Of :func:`lanenet.onboard.actuators.first_writes`, as JSON.

    Returns:
        The chip, which stays owned until it is closed; None for an actuator without first writes.

    Raises:
        HardwareError: If its bus cannot be opened, or another process owns it.
    """
    first = json.loads(text)
    if first is None:
        return None
    chip = I2CChip(first["bus"], first["address"])
    chip.open()
    chip.own()
    # What does not answer is named when the actuator is opened.
    with contextlib.suppress(OSError):
        for data in first["writes"]:
            chip.write(bytes.fromhex(data))
            time.sleep(first["pause_s"])
    return chip


def main(arguments: list[str], build: Callable[[str], Actuator] = actuator_from_json) -> int:
    """Open the actuator, serve, close it.

    Args:
        arguments: As above, six texts.
        build: Makes the actuator from its settings.

    Returns:
        The exit code: 0 after a normal end, 1 after a fault, that of :class:`MotorMayRunError` if neutral was
        not confirmed.
    """
    line_number, pulse, settings_json, first, watchdog_s, give_up_s = arguments
    line = socket.socket(fileno=int(line_number))
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    os.set_blocking(int(pulse), False)
    logging.basicConfig(level=logging.INFO, handlers=[PatientLog()])
    actuator: Actuator | None = None
    chip: I2CChip | None = None
    ended = False
    try:
        chip = first_neutral(first)
        actuator = build(settings_json)
        guard = Guard(line, int(pulse), actuator, float(watchdog_s), float(give_up_s))

        def end(_number: int, _frame: FrameType | None) -> None:
            guard.asked_to_end = True

        signal.signal(signal.SIGTERM, end)
        actuator.open()
        actuator.neutral()
        # The guard has little to do, but has to do it in time.
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, 0, -10)
        # A garbage collection would be a pause.
        gc.collect()
        gc.disable()
        _say(line, "ready")
        reason, ended = guard.run(), True
        if reason == STOPPED:
            _say(line, "stopped")
    except LanenetError as error:
        reason = str(error)
        _say(line, f"failed {reason}")
    except Exception as error:
        reason = f"the guard of the actuator failed: {type(error).__name__}: {error}"
        _say(line, f"failed {reason}")
    finally:
        left = None if actuator is None else _leave(actuator, int(pulse))
        _say(line, f"closed {json.dumps(left)}")
        line.close()
        os.close(int(pulse))
    if left is not None and left.confirmed is False:
        log.critical("%s: %s", left.may_run, reason)
        return MotorMayRunError.exit_code
    if chip is not None:
        chip.close()
    log.info("%s: %s", "ended" if left is None else left.text, reason)
    return 0 if ended else 1


def _leave(actuator: Actuator, pulse: int) -> Neutral | None:
    """Bring the actuator into neutral and release it; one that hangs is released with the process."""
    attempt: Callable[[], Neutral | None] = actuator.neutral

    def neutral() -> Neutral | None:
        nonlocal attempt
        left = attempt()
        # A board whose plug slipped is opened again; one that could not be opened at all is left alone.
        attempt = partial(reach_neutral, actuator)
        return left

    def turn() -> bool:
        beat(pulse)
        return True

    # The first attempt may hang as well.
    left = settle(neutral, turn, hold_s=HOLD_S)
    if left is None or left.confirmed is not False:
        _close(actuator)
    return left


def _close(actuator: Actuator) -> None:
    try:
        actuator.close()
    except Exception as error:
        # A board that was unplugged: its driver's errors are not all of them OSError (termios.error).
        log.error("the actuator was not closed: %s: %s", type(error).__name__, error)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
