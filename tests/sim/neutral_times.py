"""How long a motor runs on when processes of a drive are killed or stopped, many times over, on any wire.

Run as a program, ``python neutral_times.py SETTINGS``, it is the smallest drive: the drive loop with a camera
of noise, 30 times per second, through the real guard to the actuator of these settings (JSON), until it ends.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import numpy as np
from pydantic import TypeAdapter

from lanenet.errors import LanenetError
from lanenet.onboard.actuators import ActuatorSettings, first_writes
from lanenet.onboard.devices import Frame
from lanenet.onboard.guard import GuardedActuator
from lanenet.onboard.guard_process import actuator_from_json
from lanenet.onboard.safety import SafetySettings
from lanenet.perception.estimate import LaneEstimate

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


def sender(settings_json: str, log: Path, environment: dict[str, str] | None = None) -> Start:
    """The smallest drive."""

    def start() -> subprocess.Popen[bytes]:
        with log.open("ab") as stream:
            words = [sys.executable, __file__, settings_json]
            return subprocess.Popen(words, stdout=stream, stderr=stream, env=environment)

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
    """Drive at a constant throttle by a lane that never changes; returns the code of ``lanenet drive``."""
    from lanenet.control.controller import ControlSettings, LaneController
    from lanenet.control.steering import SteeringSettings
    from lanenet.onboard.loop import CarParts, DriveLoop, DriveMode
    from lanenet.onboard.safety import LimitSettings

    logging.basicConfig(level=logging.INFO, format="%(message)s")
    safety = SafetySettings(countdown_s=0.0)
    actuator = TypeAdapter(ActuatorSettings).validate_json(settings_json)
    sink = GuardedActuator(
        settings_json,
        lambda: actuator_from_json(settings_json),
        safety.watchdog_s,
        safety.end_after_s,
        first_json=json.dumps(first_writes(actuator)),
    )
    control = ControlSettings(steering=SteeringSettings(wheelbase_cm=26.0))
    parts = CarParts(Camera(), Eye(), LaneController(control), sink)
    # The throttle is there with the first command.
    limits = LimitSettings(throttle_rate_s=100.0)
    loop = DriveLoop(parts, safety, limits, control.speed, DriveMode(armed=True))
    try:
        return 1 if loop.run().by_fault else 0
    except LanenetError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_code


class Camera:
    """A camera of noise, 30 frames per second."""

    def __init__(self) -> None:
        self._number = -1
        self._noise = np.random.default_rng(0)

    def open(self) -> None:
        self._begin_s = time.monotonic()

    def read(self, timeout_s: float) -> Frame:
        self._number += 1
        time.sleep(max(0.0, self._begin_s + self._number / RATE_HZ - time.monotonic()))
        image = self._noise.integers(0, 256, (24, 32, 3), np.uint8)
        return Frame(image, time.monotonic(), self._number)

    def close(self) -> None:
        pass


class Eye:
    """Sees a straight lane."""

    def detect(self, frame_bgr: np.ndarray) -> LaneEstimate:
        return LaneEstimate(np.array([-20.0, -20.0, -20.0, 20.0, 20.0, 20.0]), confidence=1.0)

    def reset(self) -> None:
        pass


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1]))
