"""An actuator whose wire is a file: each command with its time, to be read when all processes are gone.

Run as a program it is a guard that owns such an actuator.
"""

from __future__ import annotations

import json
import os
import sys
import termios
import time
from dataclasses import dataclass
from pathlib import Path

from lanenet.errors import HardwareError
from lanenet.onboard.guard import GuardedActuator
from lanenet.onboard.guard_process import main
from lanenet.onboard.neutral import CONFIRMED, SENT, Neutral


class WireLog:
    """Appends ``time process kind steering throttle`` for every command; fails or hangs when told to."""

    def __init__(self, settings_json: str) -> None:
        settings = json.loads(settings_json)
        self._path = settings["path"]
        self._fail_at, self._hang_at = settings.get("fail_at"), settings.get("hang_at")
        self._is_open = False
        #: Whether neutral is not confirmed.
        self._doubtful = settings.get("doubtful", False)
        #: Whether neutral can be read back.
        self._readable = settings.get("readable", True)
        self._refuse, self._unplugged = settings.get("refuse", ""), settings.get("unplugged", False)
        self._sent = 0

    def _write(self, kind: str, steering_rad: float = 0.0, throttle: float = 0.0) -> None:
        note(Path(self._path), kind, steering_rad, throttle)

    def open(self) -> None:
        if self._refuse:
            raise HardwareError(self._refuse)
        self._write("open")
        self._is_open = True

    def send(self, steering_rad: float, throttle: float) -> None:
        self._sent += 1
        if self._sent == self._fail_at:
            self._write("fault")
            raise OSError("Remote I/O error")
        if self._sent == self._hang_at:
            self._write("fault")
            time.sleep(3600.0)
        self._write("send", steering_rad, throttle)

    def neutral(self) -> Neutral | None:
        if not self._is_open:
            return None
        self._write("neutral")
        if self._doubtful and self._sent == 0:
            return Neutral(False, "no answer")
        return CONFIRMED if self._readable else SENT

    def close(self) -> None:
        self._write("close")
        self._is_open = False
        if self._unplugged:
            # As pyserial does; it is no OSError.
            raise termios.error(5, "Input/output error")


@dataclass(frozen=True)
class Line:
    t_s: float
    process: int
    kind: str
    steering_rad: float
    throttle: float


def note(path: Path, kind: str, steering_rad: float = 0.0, throttle: float = 0.0) -> None:
    """Append a line, whole or not at all."""
    text = f"{time.monotonic()!r} {os.getpid()} {kind} {steering_rad!r} {throttle!r}\n"
    handle = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    try:
        os.write(handle, text.encode())
    finally:
        os.close(handle)


def read_wire(path: Path) -> list[Line]:
    lines = [line.split() for line in path.read_text().splitlines()]
    return [Line(float(t), int(p), kind, float(s), float(v)) for t, p, kind, s, v in lines]


def settings_of(path: Path, **more: object) -> str:
    return json.dumps({"path": str(path), **more})


def guarded_wire(settings_json: str, watchdog_s: float) -> GuardedActuator:
    """The loop's end of a guard that owns a wire."""
    program = (sys.executable, str(Path(__file__)))
    return GuardedActuator(settings_json, lambda: WireLog(settings_json), watchdog_s, 1.0, program)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:], WireLog))
