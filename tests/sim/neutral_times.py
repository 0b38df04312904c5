"""How long a motor runs on when processes of a drive are killed or stopped, many times over, on any wire.

Run as a program, ``python neutral_times.py SETTINGS``, it is the smallest drive: full throttle, 30 times per
second, through the real guard to the actuator of these settings (JSON), until that fails.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from lanenet.errors import HardwareError
from lanenet.onboard.guard import GuardedActuator
from lanenet.onboard.guard_process import actuator_from_json
from lanenet.onboard.safety import SafetySettings

#: Which signal the loop's process and its guard get; None for none.
FAULTS: dict[str, tuple[signal.Signals | None, signal.Signals | None]] = {
    "main killed": (signal.SIGKILL, None),
    "main stopped": (signal.SIGSTOP, None),
    "guard killed": (None, signal.SIGKILL),
    "guard stopped": (None, signal.SIGSTOP),
    "both killed": (signal.SIGKILL, signal.SIGKILL),
    "both stopped": (signal.SIGSTOP, signal.SIGSTOP),
}
#: From a fault to neutral.
ALLOWED_S = 0.1
#: After a fault the wire is watched for this long, for a motor that starts again; longer than it takes the
#: loop to give up a guard that hangs, and to open the actuator itself.
WATCHED_S = 0.7
RATE_HZ = 30.0

Motor = Callable[[], list[tuple[float, bool]]]


class Start(Protocol):
    """Starts a drive; the guard is the only child of its process."""

    def __call__(self) -> subprocess.Popen[bytes]: ...


def sender(settings_json: str, log: Path) -> Start:
    """The smallest drive."""

    def start() -> subprocess.Popen[bytes]:
        with log.open("ab") as stream:
            words = [sys.executable, __file__, settings_json]
            return subprocess.Popen(words, stdout=stream, stderr=stream)

    return start


def seconds_to_neutral(fault: str, start: Start, motor: Motor, moment: float) -> float:
    """Drive into a fault.

    Args:
        fault: One of ``FAULTS``.
        start: Starts the drive.
        motor: The wire's whole story: when the motor was switched on (True) or into neutral (False).
        moment: When in the time between two commands the fault comes, 0 to 1.

    Returns:
        From the first signal until the motor is in neutral for good.
    """
    process = start()
    guard = 0
    begun_s = time.monotonic()
    try:
        while not (story := motor()) or not story[-1][1] or time.monotonic() - story[-1][0] < 0.1:
            assert process.poll() is None and time.monotonic() - begun_s < 60.0, "the car does not drive"
            time.sleep(0.01)
        guard = int(Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()[0])
        time.sleep(moment / RATE_HZ)
        to_main, to_guard = FAULTS[fault]
        struck_s = time.monotonic()
        if to_guard is not None:
            # The loop must not act between the two signals.
            if to_main is not None:
                process.send_signal(signal.SIGSTOP)
            os.kill(guard, to_guard)
        if to_main is not None:
            process.send_signal(to_main)
        time.sleep(WATCHED_S)
        stopped_s, driving = motor()[-1]
        assert not driving, f"{fault}: the motor still runs {WATCHED_S} s later"
        return max(0.0, stopped_s - struck_s)
    finally:
        for pid in (process.pid, guard):
            with contextlib.suppress(ProcessLookupError):
                if pid:
                    os.kill(pid, signal.SIGKILL)
        process.wait()


def table(times_s: dict[str, list[float]]) -> str:
    """Median and worst of each fault."""
    lines = [
        f"{fault:14} median {1e3 * sorted(times)[len(times) // 2]:6.1f} ms  worst {1e3 * max(times):6.1f} ms"
        f"  ({len(times)} times)"
        for fault, times in times_s.items()
    ]
    return "\n".join(lines)


def main(settings_json: str) -> int:
    safety = SafetySettings()
    sink = GuardedActuator(
        settings_json, lambda: actuator_from_json(settings_json), safety.watchdog_s, safety.end_after_s
    )
    try:
        sink.open()
        while True:
            sink.send(0.1, 1.0, time.monotonic() + safety.watchdog_s)
            time.sleep(1.0 / RATE_HZ)
    except HardwareError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    finally:
        sink.close()


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1]))
