"""The wire of the emulated I2C bus in ``car_bus``, and what a motor behind a watchdog makes of it."""

from __future__ import annotations

import time
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from lanenet.onboard.actuators.heartbeat import HeartbeatSettings
from lanenet.onboard.actuators.pca9685 import PCA9685Settings, neutral_writes

#: In front of the path of processes that are to find the bus.
BUS = Path(__file__).resolve().parent / "car_bus"
#: Any file is a GPIO device to the emulated kernel.
SETTINGS = PCA9685Settings(kind="pca9685", heartbeat=HeartbeatSettings(line=4, chip="/dev/null"))
#: Of the monostable in docs/driving.md.
MONOSTABLE_S = 0.15


@dataclass(frozen=True)
class Write:
    """A line of the wire; ``register`` is None for a beat."""

    t_s: float
    process: int
    register: int | None
    data: bytes


class Wire:
    """The wire of a folder (``LANENET_TEST_BUS``)."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / "wire"
        stopped = neutral_writes(SETTINGS)[0]
        self._throttle, self._neutral = stopped[0], stopped[1:]

    def writes(self) -> list[Write]:
        lines = self._path.read_text().splitlines(True) if self._path.exists() else []
        found = []
        for t_s, process, *words in (line.split() for line in lines if line.endswith("\n")):
            beat = words == ["beat"]
            register, data = (None, b"") if beat else (int(words[0], 16), bytes.fromhex(words[1]))
            found.append(Write(float(t_s), int(process), register, data))
        return found

    def throttles(self, driving: bool) -> list[Write]:
        written = [w for w in self.writes() if w.register == self._throttle]
        return [w for w in written if driving != (w.data == self._neutral)]

    def wait(self, driving: bool, after_s: float, timeout_s: float = 30.0) -> Write:
        end_s = time.monotonic() + timeout_s
        while time.monotonic() < end_s:
            if found := [w for w in self.throttles(driving) if w.t_s >= after_s]:
                return found[0]
            time.sleep(0.005)
        raise AssertionError(f"not {'driving' if driving else 'neutral'} within {timeout_s} s")

    def motor(self) -> list[tuple[float, bool]]:
        """When the motor was switched on or off: by the throttle, and by beats that stayed away.

        Without any beat there is no watchdog.
        """
        story: list[tuple[float, bool]] = []
        beats = [w.t_s for w in self.writes() if w.register is None]
        throttle, powered = False, not beats
        gaps = pairwise([*beats, time.monotonic()] if beats else [])
        late = [early_s + MONOSTABLE_S for early_s, next_s in gaps if next_s - early_s > MONOSTABLE_S]
        events = [(t_s, "off") for t_s in late] + [(t_s, "on") for t_s in beats]
        events += [(w.t_s, "drive") for w in self.throttles(driving=True)]
        events += [(w.t_s, "neutral") for w in self.throttles(driving=False)]
        for t_s, what in sorted(events):
            throttle = what == "drive" or (throttle and what != "neutral")
            powered = what == "on" or (powered and what != "off")
            if not story or story[-1][1] != (throttle and powered):
                story.append((t_s, throttle and powered))
        return story
