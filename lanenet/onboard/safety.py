"""When the car may drive: arming, faults, slowing down, and the limits of every command.

A command is valid until its frame is ``max_age_s`` old. Whatever goes wrong, no new command appears, the last
one expires, and the guard (:mod:`lanenet.onboard.guard`) puts the motor into neutral. Nothing has to detect
the fault for that.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import ClassVar

from pydantic import Field

from lanenet.config import Rule, Settings


class LimitSettings(Settings):
    """Limits of every command.

    Attributes:
        max_steering_rad: Largest steering angle to either side; the default is a common 1:10 car's.
        steering_rate_rad_s: Fastest change of the steering; the default is about a standard servo's, which
            needs 0.15 s for 60 degrees of its horn.
        max_throttle: The throttle stays between 0 and this: the car does not reverse. The default is chosen
            low, for a first drive.
        throttle_rate_s: Fastest rise of the throttle, per second; it may fall at once.
    """

    max_steering_rad: float = Field(default=0.45, gt=0.0, lt=0.5 * math.pi)
    steering_rate_rad_s: float = Field(default=8.0, gt=0.0)
    max_throttle: float = Field(default=0.4, gt=0.0, le=1.0)
    throttle_rate_s: float = Field(default=1.0, gt=0.0)


class SafetySettings(Settings):
    """When the car slows down, stops and gives up.

    Attributes:
        watchdog_s: Without a new command for this long the motor goes to neutral. The default is 100 ms less
            a fifth, for waking the guard and for the wire.
        max_age_s: A command is valid until its frame is this old; at the default and 1 m/s the car has moved
            10 cm.
        countdown_s: An armed car starts after it has seen the lane for this long without interruption.
        slow_below: Below this confidence the car slows down. Not 0, which an image without a lane has.
        slow_share: Share of the speed that remains at ``stop_below``.
        stop_below: Below this confidence the car stops.
        slow_for_s: A car that has been slow for this long stops.
        end_after_s: If an armed car had to stop for this long, the drive ends: it does not start again.
        allow_repeated_frames: Accept a frame that repeats an earlier one, or its road. A camera sends such
            frames only when it hangs; a simulator without noise sends them while the car stands.
        camera_check: Compare what the driving car sees with the camera file; warn, slow down and stop when
            the camera seems to have moved.
    """

    rules: ClassVar[tuple[Rule, ...]] = (
        Rule(
            ("stop_below", "slow_below"),
            lambda s: s.stop_below <= s.slow_below,
            lambda _: "expected stop_below at or below slow_below: the car slows down before it stops",
        ),
        Rule(
            ("end_after_s", "watchdog_s"),
            lambda s: s.end_after_s > s.watchdog_s,
            lambda s: (
                f"expected end_after_s above {s.watchdog_s:g} s: a command that is still valid must not "
                "end the drive"
            ),
        ),
    )

    watchdog_s: float = Field(default=0.08, gt=0.0, le=0.5)
    max_age_s: float = Field(default=0.1, gt=0.0, le=0.5)
    countdown_s: float = Field(default=3.0, ge=0.0)
    slow_below: float = Field(default=0.5, gt=0.0, le=1.0)
    slow_share: float = Field(default=0.5, gt=0.0, le=1.0)
    stop_below: float = Field(default=0.2, gt=0.0, le=1.0)
    slow_for_s: float = Field(default=3.0, gt=0.0)
    end_after_s: float = Field(default=1.0, ge=0.2)
    allow_repeated_frames: bool = False
    camera_check: bool = True


class State(StrEnum):
    """What the car may do now."""

    DISARMED = "disarmed"
    COUNTDOWN = "countdown"
    DRIVING = "driving"
    SLOW = "slow"
    STOPPED = "stopped"
    ENDED = "ended"


@dataclass(frozen=True)
class Verdict:
    """The judgement of one step of the loop.

    Attributes:
        state: What the car may do.
        speed_share: Allowed share of the wanted speed; 0 is neutral.
        steers: Whether the steering of this frame may be used.
        reason: Why the car is slow or stopped; empty when it drives.
    """

    state: State
    speed_share: float
    steers: bool
    reason: str = ""


class SafetyJudge:
    """State machine that decides in each turn whether the car drives, slows down, stops or gives up."""

    def __init__(self, settings: SafetySettings, armed: bool) -> None:
        """Start disarmed; ``armed`` allows the countdown to begin once the lane is seen."""
        self._settings, self._armed = settings, armed
        self._counting_since_s = math.nan
        self._slow_since_s = math.nan
        self._fault_since_s = math.nan
        self._started = False
        self._ended = ""

    def judge(self, now_s: float, fault: str, confidence: float = math.nan, caution: str = "") -> Verdict:
        """Judge one turn of the loop.

        Args:
            now_s: Time on the monotonic clock.
            fault: Why this turn gives no command; empty if it does.
            confidence: Of the estimate; NaN counts as 0.
            caution: Why the car goes no faster than ``slow_share``; empty if it may.

        Returns:
            The verdict; the state ``ended`` is final.
        """
        s = self._settings
        confidence = confidence if math.isfinite(confidence) else 0.0
        if not fault and confidence < s.stop_below:
            fault = f"confidence {confidence:.2f}, below {s.stop_below:g}"
        if not fault and confidence < s.slow_below:
            self._slow_since_s = now_s if math.isnan(self._slow_since_s) else self._slow_since_s
            if now_s - self._slow_since_s >= s.slow_for_s:
                fault = f"confidence below {s.slow_below:g} for {s.slow_for_s:g} s"
        elif not fault:
            self._slow_since_s = math.nan
        if self._ended:
            return Verdict(State.ENDED, 0.0, False, self._ended)
        if fault:
            return self._faulty(now_s, fault)
        self._fault_since_s = math.nan
        if not self._armed:
            return Verdict(State.DISARMED, 0.0, True)
        if not self._started:
            self._counting_since_s = now_s if math.isnan(self._counting_since_s) else self._counting_since_s
            left_s = self._counting_since_s + s.countdown_s - now_s
            if left_s > 0.0:
                return Verdict(State.COUNTDOWN, 0.0, True, f"starts in {math.ceil(left_s)} s")
            self._started = True
        if confidence < s.slow_below:
            part = (confidence - s.stop_below) / (s.slow_below - s.stop_below)
            share = s.slow_share + (1.0 - s.slow_share) * part
            return Verdict(State.SLOW, share, True, f"confidence {confidence:.2f}, below {s.slow_below:g}")
        if caution:
            return Verdict(State.SLOW, s.slow_share, True, caution)
        return Verdict(State.DRIVING, 1.0, True)

    def _faulty(self, now_s: float, fault: str) -> Verdict:
        self._counting_since_s = math.nan
        if math.isnan(self._fault_since_s):
            self._fault_since_s = now_s
        if self._started and now_s - self._fault_since_s >= self._settings.end_after_s:
            self._ended = f"{fault}; stopped for {self._settings.end_after_s:g} s"
            return Verdict(State.ENDED, 0.0, False, self._ended)
        state = State.STOPPED if self._armed else State.DISARMED
        return Verdict(state, 0.0, False, fault)


class CommandLimiter:
    """Limits steering and throttle, and how fast they change."""

    def __init__(self, settings: LimitSettings) -> None:
        """Start straight ahead and in neutral."""
        self._settings = settings
        self._steered_s = self._throttled_s = math.nan
        self.steering_rad = 0.0
        self.throttle = 0.0

    def limit(self, steering_rad: float, throttle: float, now_s: float) -> tuple[float, float]:
        """Return the nearest allowed command.

        Args:
            steering_rad: Wanted steering, positive left; NaN keeps the present one.
            throttle: Wanted throttle; NaN is neutral.
            now_s: Time of the command on the monotonic clock.
        """
        s = self._settings
        if math.isfinite(steering_rad):
            step = s.steering_rate_rad_s * _since(self._steered_s, now_s)
            aim = min(max(steering_rad, -s.max_steering_rad), s.max_steering_rad)
            self.steering_rad = min(max(aim, self.steering_rad - step), self.steering_rad + step)
        aim = min(max(throttle, 0.0), s.max_throttle) if math.isfinite(throttle) else 0.0
        self.throttle = min(aim, self.throttle + s.throttle_rate_s * _since(self._throttled_s, now_s))
        self._steered_s = self._throttled_s = now_s
        return self.steering_rad, self.throttle

    def neutral(self, now_s: float) -> None:
        """Note that the motor is in neutral: from now the throttle rises from 0 again."""
        self.throttle, self._throttled_s = 0.0, now_s

    def start_from(self, steering_rad: float, throttle: float) -> None:
        """Take what is in force in place of the last command, as when a person drives."""
        s = self._settings
        self.steering_rad = min(max(steering_rad, -s.max_steering_rad), s.max_steering_rad)
        self.throttle = min(max(throttle, 0.0), s.max_throttle)


def _since(before_s: float, now_s: float) -> float:
    return max(0.0, now_s - before_s) if math.isfinite(before_s) else 0.0
