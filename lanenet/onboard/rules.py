"""Settings of different sections that constrain each other; those of one section stand in its schema.

``docs/driving.md`` lists them all.
"""

from __future__ import annotations

from typing import Any

from lanenet.config import Rule
from lanenet.onboard.cameras.live import CameraSettings
from lanenet.perception.registry import KINDS

#: Rounding error of a throttle: a speed that takes just the largest one can be reached.
_ROUNDING = 1e-9


def _only_for(key: str, takes: str) -> Rule:
    """Return the rule by which a detector gets only what it uses, by a field of its ``DetectorKind``."""
    return Rule(
        ("kind", key),
        lambda s: not getattr(s, key) or getattr(KINDS[s.kind], takes),
        lambda s: f"{s.kind} does not use it; leave it out, or choose the kind that it was meant for",
    )


#: Of the section ``detector``.
DETECTOR_RULES = (
    _only_for("model", "needs_model"),
    _only_for("any_camera", "needs_model"),
    _only_for("mask", "takes_mask"),
    _only_for("lane_width_cm", "takes_lane_width"),
)


def _reaches_cruise(settings: Any) -> bool:
    limits, speed = settings.limits, settings.control.speed
    # A car that cannot even roll has a rule of its own.
    return bool(speed.cruise_throttle <= max(limits.max_throttle, speed.throttle_at_rest) + _ROUNDING)


def _how_to_reach_cruise(settings: Any) -> str:
    limits, speed = settings.limits, settings.control.speed
    fastest_cm_s = (limits.max_throttle - speed.throttle_at_rest) * speed.cm_s_per_throttle
    text = (
        f"the cruise speed takes a throttle of {speed.cruise_throttle:.3g}; expected "
        f"control.speed.cruise_cm_s at most {fastest_cm_s:.3g} cm/s"
    )
    if speed.cruise_throttle > 1.0:
        return text
    return f"{text}, or limits.max_throttle at least {speed.cruise_throttle:.3g}"


def _one_width(settings: Any) -> bool:
    widths_cm = {settings.detector.lane_width_cm, settings.control.steering.lane_width_cm}
    return len(widths_cm - {None}) <= 1


#: Of a car, and of the pilot of a Donkeycar.
PILOT_RULES = (
    Rule(
        ("limits.max_throttle", "control.speed.throttle_at_rest"),
        lambda s: s.limits.max_throttle > s.control.speed.throttle_at_rest,
        lambda s: f"expected limits.max_throttle above {s.control.speed.throttle_at_rest:g}, at which the "
        "car just begins to roll",
    ),
    Rule(
        (
            "control.speed.cruise_cm_s", "limits.max_throttle", "control.speed.throttle_at_rest",
            "control.speed.cm_s_per_throttle",
        ),
        _reaches_cruise,
        _how_to_reach_cruise,
    ),
    Rule(
        ("control.steering.max_steering_rad", "limits.max_steering_rad"),
        lambda s: s.control.steering.max_steering_rad <= s.limits.max_steering_rad,
        lambda s: f"expected control.steering.max_steering_rad at most {s.limits.max_steering_rad:g} rad, "
        "the tightest bend that the car may drive",
    ),
    Rule(
        ("detector.lane_width_cm", "control.steering.lane_width_cm"),
        _one_width,
        lambda _: "expected one width; control.steering.lane_width_cm alone is enough",
    ),
    Rule(
        ("detector.kind", "camera", "control.own_target"),
        lambda s: s.control.own_target or s.camera is not None or KINDS[s.detector.kind].needs_camera,
        lambda s: f"{s.detector.kind} without a camera file gives no points in cm: the car never has a lane; "
        "expected a camera file, or control.own_target=true",
    ),
)  # fmt: skip


def _until_the_next_frame(key: str) -> Rule:
    return Rule(
        (f"safety.{key}", "source.rate_hz"),
        # Who replays a drive slowly wants to look at it.
        lambda s: not isinstance(s.source, CameraSettings) or getattr(s.safety, key) * s.source.rate_hz > 1.0,
        lambda s: (
            f"expected safety.{key} above {1.0 / s.source.rate_hz:.3g} s, the time between two frames, "
            "or the motor stops after each; raise safety.max_age_s and safety.watchdog_s together, or "
            "source.rate_hz"
        ),
    )


#: Of a car.
CAR_RULES = (
    *PILOT_RULES,
    Rule(
        ("limits.max_steering_rad", "actuator.max_steering_rad"),
        lambda s: s.limits.max_steering_rad <= s.actuator.max_steering_rad,
        lambda s: (
            f"expected limits.max_steering_rad at most {s.actuator.max_steering_rad:g} rad, the wheels' "
            "angle at the end of the servo's travel"
        ),
    ),
    _until_the_next_frame("watchdog_s"),
    _until_the_next_frame("max_age_s"),
    Rule(
        ("source.delay_s", "source.rate_hz", "safety.max_age_s"),
        lambda s: s.source.delay_s is None or s.source.delay_s + 1.0 / s.source.rate_hz < s.safety.max_age_s,
        lambda s: (
            f"expected source.delay_s and the {1.0 / s.source.rate_hz:.3g} s between two frames together "
            f"below {s.safety.max_age_s:g} s, or each command runs out before the next; raise "
            "safety.max_age_s, or take a camera with less delay"
        ),
    ),
)
