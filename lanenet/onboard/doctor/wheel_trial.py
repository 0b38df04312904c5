"""Signs and trim of a car whose wheels are off the ground, found by asking who stands beside it."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from lanenet.errors import ConfigError, LanenetError
from lanenet.onboard.actuators.myconfig import with_myconfig
from lanenet.onboard.actuators.pca9685 import PCA9685Settings
from lanenet.onboard.actuators.pulses import PulseSettings
from lanenet.onboard.drive_settings import DriveSettings
from lanenet.onboard.guard import CommandSink

_log = logging.getLogger(__name__)

#: Asks a question; the answer is one of the letters.
Ask = Callable[[str, str], str]

_REPEAT_S = 0.03
_TRIM_STEP_RAD = 0.01
_MAX_TRIM_RAD = 0.3
_THROTTLE_STEP = 0.02


@dataclass(frozen=True)
class TrialResult:
    """What the trial found.

    Attributes:
        changes: New values of the car's file by their dotted key; empty if all was right.
        lines: What was found, a sentence each.
    """

    changes: dict[str, float] = field(default_factory=dict)
    lines: list[str] = field(default_factory=list)


class _Holder:
    """Repeats a command in a thread while a person thinks: actuators stop by themselves otherwise."""

    def __init__(self, sink: CommandSink, watchdog_s: float) -> None:
        self._sink, self._watchdog_s = sink, watchdog_s
        self._command = (0.0, 0.0)
        self._failure: LanenetError | None = None
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, name="wheel trial", daemon=True)

    def __enter__(self) -> _Holder:
        self._sink.open()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join(1.0)
        self._sink.close()

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


def pulses_of(settings: DriveSettings) -> PulseSettings:
    """Return the pulses that the car's actuator works with.

    Raises:
        ConfigError: If the car has no actuator with wheels, or its ``myconfig.py`` cannot be used.
    """
    actuator = settings.actuator
    if not isinstance(actuator, PulseSettings):
        found = "none" if actuator is None else f"kind: {actuator.kind}"
        raise ConfigError(f"key 'actuator': found {found}, expected one with wheels (pca9685, serial)")
    return with_myconfig(actuator) if isinstance(actuator, PCA9685Settings) else actuator


def try_wheels(settings: DriveSettings, sink: CommandSink, ask: Ask) -> TrialResult:
    """Turn the wheels and the motor, and ask what they did.

    The motor is in neutral before and after, whatever happens in between.

    Args:
        settings: Of the car.
        sink: Its actuator behind the guard, which stops it when this process hangs.
        ask: Asks a person; gets the question and the letters that are answers.

    Returns:
        Values for the car's file.

    Raises:
        ConfigError: If the car has no actuator with wheels.
        HardwareError: If the actuator does not answer, or fails meanwhile.
    """
    pulses = pulses_of(settings)
    result = TrialResult()
    if ask("Are all wheels off the ground, and nothing near them?", "yn") != "y":
        result.lines.append("nothing was tried: put the car on a box first")
        return result
    with _Holder(sink, settings.safety.watchdog_s) as holder:
        sign = _try_sides(pulses, holder, ask, result)
        _try_trim(pulses, holder, ask, result, sign)
        _try_motor(settings, pulses, holder, ask, result)
    return result


def _try_sides(pulses: PulseSettings, holder: _Holder, ask: Ask, result: TrialResult) -> float:
    """Return 1 if left is left, -1 if the servo turns the other way."""
    holder.hold(0.7 * pulses.max_steering_rad, 0.0)
    answer = ask("To which side do the front wheels point, seen from behind: left or right?", "lr")
    holder.hold(0.0, 0.0)
    if answer == "l":
        result.lines.append("steering: left is left")
        return 1.0
    result.changes["actuator.steering_left_us"] = pulses.steering_right_us
    result.changes["actuator.steering_right_us"] = pulses.steering_left_us
    result.lines.append("steering: the servo turned the wrong way, its two pulses are exchanged")
    return -1.0


def _try_trim(pulses: PulseSettings, holder: _Holder, ask: Ask, result: TrialResult, sign: float) -> None:
    """Move the wheels in small steps until they are straight."""
    turn_rad = 0.0
    while True:
        holder.hold(sign * turn_rad, 0.0)
        answer = ask("Where do the front wheels point now: left, right, or straight ahead?", "lrs")
        if answer == "s":
            break
        turn_rad += _TRIM_STEP_RAD if answer == "r" else -_TRIM_STEP_RAD
        if abs(sign * pulses.steering_trim_rad + turn_rad) > _MAX_TRIM_RAD:
            result.lines.append("trim: more than 17 degrees would be needed; set the servo's horn anew")
            return
    trim_rad = round(sign * pulses.steering_trim_rad + turn_rad, 4)
    if trim_rad != pulses.steering_trim_rad:
        result.changes["actuator.steering_trim_rad"] = trim_rad
    result.lines.append(f"trim: {trim_rad:+.3f} rad")


def _try_motor(
    settings: DriveSettings, pulses: PulseSettings, holder: _Holder, ask: Ask, result: TrialResult
) -> None:
    """Open the throttle in small steps until the wheels turn."""
    throttle = 0.0
    while throttle < settings.limits.max_throttle - 1e-9:
        throttle = round(min(throttle + _THROTTLE_STEP, settings.limits.max_throttle), 4)
        holder.hold(0.0, throttle)
        answer = ask(f"Throttle {throttle:.2f}: do the wheels turn: not yet, forward, or backward?", "nfb")
        if answer == "n":
            continue
        holder.hold(0.0, 0.0)
        result.changes["control.speed.throttle_at_rest"] = throttle
        if answer == "b":
            result.changes["actuator.throttle_forward_us"] = pulses.throttle_reverse_us
            result.changes["actuator.throttle_reverse_us"] = pulses.throttle_forward_us
            result.lines.append("motor: it turned backward, its two pulses are exchanged")
        result.lines.append(f"motor: it turns from a throttle of {throttle:.2f} on, in the air")
        return
    holder.hold(0.0, 0.0)
    result.lines.append(
        f"motor: stood up to a throttle of {settings.limits.max_throttle:g} (limits.max_throttle); is the "
        "speed controller switched on, and does it know this neutral (throttle_stopped_us)?"
    )
