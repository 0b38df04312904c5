"""Signs and trim of a car whose wheels are off the ground, found by asking a person; changes its YAML."""

from __future__ import annotations

import copy
import logging
import math
import re
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from lanenet.config import parse_yaml
from lanenet.errors import ConfigError, LanenetError, MotorMayRunError
from lanenet.onboard.actuators.myconfig import with_myconfig
from lanenet.onboard.actuators.pca9685 import PCA9685Settings
from lanenet.onboard.actuators.pulses import LEAST_TRAVEL_US, MOST_TRIM, PulseSettings
from lanenet.onboard.drive import DriveSettings
from lanenet.onboard.guard import CommandSink
from lanenet.onboard.neutral import undisturbed

_log = logging.getLogger(__name__)

#: Asks a question; returns one of the letters.
Ask = Callable[[str, str], str]

#: A command is repeated this often: well within the watchdog's 80 ms.
_REPEAT_S = 0.03
#: Share of the largest angle that shows the side clearly without reaching the end of the travel.
_SIDE_SHARE = 0.7
#: Half a degree, about what an eye sees at a wheel.
_TRIM_STEP_RAD = 0.01
#: Limit of ``steering_trim_rad``.
_MAX_TRIM_RAD = 0.3
#: Chosen: a fifth of the default ``throttle_at_rest``.
_THROTTLE_STEP = 0.02


@dataclass(frozen=True)
class TrialResult:
    """What the trial found.

    Attributes:
        changes: New values of the car's file by their dotted key; empty if nothing has to change.
        lines: What was found, a sentence each.
    """

    changes: dict[str, float] = field(default_factory=dict)
    lines: list[str] = field(default_factory=list)


def try_wheels(settings: DriveSettings, sink: CommandSink, ask: Ask) -> TrialResult:
    """Turn the wheels and the motor, and ask what they did.

    Neutral is repeated until it is confirmed, whatever happens in between.

    Args:
        settings: The car's settings.
        sink: Its actuator behind the guard, which stops it if this process hangs.
        ask: Asks a person; gets the question and the letters of the answers.

    Returns:
        Values for the car's file.

    Raises:
        ConfigError: If the car has no actuator with wheels.
        HardwareError: If the actuator does not answer, or fails meanwhile.
        MotorMayRunError: If the actuator did not confirm neutral at the end.
    """
    pulses = pulses_of(settings)
    if ask("Are all wheels off the ground, and nothing near them?", "yn") != "y":
        return TrialResult(lines=["nothing was tried: put the car on a stand first"])
    with _Holder(sink, settings.safety.watchdog_s) as holder:
        trial = _Trial(pulses, holder, ask)
        sign = trial.sides()
        trial.trim(sign)
        trial.motor(settings.limits.max_throttle)
    return trial.result


def pulses_of(settings: DriveSettings) -> PulseSettings:
    """Return the pulses of the car's actuator.

    Raises:
        ConfigError: If the car has no actuator with wheels, or its ``myconfig.py`` cannot be used.
    """
    actuator = settings.actuator
    if not isinstance(actuator, PulseSettings):
        found = "none" if actuator is None else f"kind: {actuator.kind}"
        raise ConfigError(f"key 'actuator': found {found}, expected one with wheels (pca9685, serial)")
    return with_myconfig(actuator) if isinstance(actuator, PCA9685Settings) else actuator


class _Holder:
    """Repeats a command in a thread while a person thinks, since the guard would stop the car."""

    def __init__(self, sink: CommandSink, watchdog_s: float) -> None:
        self._sink, self._watchdog_s = sink, watchdog_s
        self._command = (0.0, 0.0)
        self._failure: LanenetError | None = None
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, name="wheel trial", daemon=True)

    def __enter__(self) -> _Holder:
        try:
            self._sink.open()
        except BaseException:
            self.__exit__()
            raise
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        with undisturbed():
            self._end.set()
            if self._thread.is_alive():
                self._thread.join(1.0)
            left = self._sink.close()
        if left is not None and left.confirmed is False:
            raise MotorMayRunError(left.may_run)
        if left is not None and not left.confirmed:
            _log.warning("%s", left.text)

    def hold(self, steering_rad: float, throttle: float) -> None:
        if self._failure is not None:
            raise self._failure
        self._command = (steering_rad, throttle)
        time.sleep(2.0 * _REPEAT_S)

    def _run(self) -> None:
        while not self._end.wait(_REPEAT_S):
            try:
                self._sink.send(*self._command, time.monotonic() + self._watchdog_s)
            except LanenetError as error:
                _log.error("%s", error)
                self._failure = error
                return


class _Trial:
    """The questions, and what their answers change."""

    def __init__(self, pulses: PulseSettings, holder: _Holder, ask: Ask) -> None:
        self.result = TrialResult()
        self._pulses, self._holder, self._ask = pulses, holder, ask

    def sides(self) -> float:
        """Return 1 if left is left, -1 if the servo turns the other way."""
        self._holder.hold(_SIDE_SHARE * self._pulses.max_steering_rad, 0.0)
        answer = self._ask("To which side do the front wheels point, seen from behind: left or right?", "lr")
        self._holder.hold(0.0, 0.0)
        if answer == "l":
            self.result.lines.append("steering: left is left")
            return 1.0
        self.result.changes["actuator.steering_left_us"] = self._pulses.steering_right_us
        self.result.changes["actuator.steering_right_us"] = self._pulses.steering_left_us
        self.result.lines.append("steering: the servo turned the wrong way, its two pulses are exchanged")
        return -1.0

    def trim(self, sign: float) -> None:
        """Move the wheels in small steps until they are straight; ``sign`` as of :meth:`sides`."""
        before_rad = self._pulses.steering_trim_rad
        turn_rad = 0.0
        most_rad = min(_MAX_TRIM_RAD, MOST_TRIM * self._pulses.max_steering_rad)
        while True:
            self._holder.hold(sign * turn_rad, 0.0)
            answer = self._ask("Where do the front wheels point now: left, right, or straight ahead?", "lrs")
            if answer == "s":
                break
            turn_rad += _TRIM_STEP_RAD if answer == "r" else -_TRIM_STEP_RAD
            if abs(sign * before_rad + turn_rad) > most_rad:
                most = f"{math.degrees(most_rad):.0f} degrees"
                self.result.lines.append(f"trim: more than {most} would be needed; refit the servo's horn")
                return
        trim_rad = round(sign * before_rad + turn_rad, 4)
        if trim_rad != before_rad:
            self.result.changes["actuator.steering_trim_rad"] = trim_rad
        self.result.lines.append(f"trim: {trim_rad:+.3f} rad")

    def motor(self, max_throttle: float) -> None:
        """Open the throttle in small steps until the wheels turn."""
        throttle = 0.0
        while throttle < max_throttle - 1e-9:
            throttle = round(min(throttle + _THROTTLE_STEP, max_throttle), 4)
            self._holder.hold(0.0, throttle)
            question = f"Throttle {throttle:.2f}: do the wheels turn: not yet, forward, or backward?"
            answer = self._ask(question, "nfb")
            if answer == "n":
                continue
            self._holder.hold(0.0, 0.0)
            self.result.changes["control.speed.throttle_at_rest"] = throttle
            if answer == "b":
                self._turn_round()
            self.result.lines.append(f"motor: in the air it turns from a throttle of {throttle:.2f} on")
            return
        self._holder.hold(0.0, 0.0)
        self.result.lines.append(
            f"motor: did not turn up to a throttle of {max_throttle:g} (limits.max_throttle); is the speed "
            "controller switched on, and does it know this neutral (throttle_stopped_us)?"
        )

    def _turn_round(self) -> None:
        """Exchange the motor's pulses, if that of reverse is far enough from neutral to be the other."""
        pulses = self._pulses
        if abs(pulses.throttle_reverse_us - pulses.throttle_stopped_us) < LEAST_TRAVEL_US:
            self.result.lines.append(
                "motor: it turned backward, and the speed controller has no reverse (throttle_reverse_us) to "
                "exchange with; set the direction at the speed controller, or exchange two wires of the motor"
            )
            return
        self.result.changes["actuator.throttle_forward_us"] = pulses.throttle_reverse_us
        self.result.changes["actuator.throttle_reverse_us"] = pulses.throttle_forward_us
        self.result.lines.append("motor: it turned backward, its two pulses are exchanged")


def set_values(text: str, changes: Mapping[str, float], where: str) -> str:
    """Return a YAML text with some numbers changed or added.

    Args:
        text: Nested sections in block style, as in the configs that ship.
        changes: Numbers by their dotted key, as ``control.speed.throttle_at_rest``.
        where: The file, for the error.

    Raises:
        ConfigError: If the file is not in block style; it has to be changed by hand.
    """
    try:
        expected = copy.deepcopy(parse_yaml(text, where)) or {}
        lines = text.splitlines()
        for key, value in changes.items():
            path = key.split(".")
            _set_plain(expected, path, value)
            lines = _set_line(lines, path, f"{value:g}")
        changed = "\n".join(lines) + "\n"
        done = parse_yaml(changed, where) == expected
    except (ConfigError, TypeError, AttributeError):
        done = False
    if not done:
        values = ", ".join(f"{key}={value:g}" for key, value in changes.items())
        raise ConfigError(f"{where}: cannot be changed automatically; change these values yourself: {values}")
    return changed


def _set_plain(data: dict[str, Any], path: list[str], value: float) -> None:
    *parents, last = path
    for parent in parents:
        data = data.setdefault(parent, {})
    # As YAML will read it.
    data[last] = parse_yaml(f"{value:g}", last)


def _set_line(lines: list[str], path: list[str], value: str) -> list[str]:
    start, end, indent = 0, len(lines), 0
    for depth, name in enumerate(path):
        at = _find(lines, start, end, indent, name)
        if at is None:
            new = [
                f"{' ' * (indent + 2 * i)}{key}:{' ' + value if depth + i == len(path) - 1 else ''}"
                for i, key in enumerate(path[depth:])
            ]
            return [*lines[:end], *new, *lines[end:]]
        if depth == len(path) - 1:
            tail = re.search(r"\s+#.*$", lines[at])
            changed = f"{' ' * indent}{name}: {value}{tail.group() if tail else ''}"
            return [*lines[:at], changed, *lines[at + 1 :]]
        start, end = at + 1, _end_of_block(lines, at + 1, end, indent)
        indent = next((_indent(line) for line in lines[start:end] if _has_content(line)), indent + 2)
    raise AssertionError("a path has at least one part")


def _find(lines: list[str], start: int, end: int, indent: int, name: str) -> int | None:
    pattern = re.compile(rf" {{{indent}}}{re.escape(name)}\s*:(\s|$)")
    return next((i for i in range(start, end) if pattern.match(lines[i])), None)


def _end_of_block(lines: list[str], start: int, end: int, indent: int) -> int:
    """Return the line after the last one that is indented deeper; later comments belong to what follows."""
    last = start
    for i in range(start, end):
        if _has_content(lines[i]):
            if _indent(lines[i]) <= indent:
                break
            last = i + 1
    return last


def _has_content(line: str) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith("#")


def _indent(line: str) -> int:
    return len(line) - len(line.lstrip(" "))
