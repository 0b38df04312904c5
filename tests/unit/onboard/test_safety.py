from __future__ import annotations

import math

import pytest

from lanenet.config import check_settings
from lanenet.errors import ConfigError
from lanenet.onboard.safety import (
    CommandLimiter,
    LimitSettings,
    SafetyJudge,
    SafetySettings,
    State,
)

NAN = float("nan")


def judge(armed: bool = True, **changes: float) -> SafetyJudge:
    return SafetyJudge(SafetySettings(**{"countdown_s": 0.0, **changes}), armed)


def test_an_unarmed_car_never_drives() -> None:
    unarmed = judge(armed=False)
    for t_s in range(20):
        verdict = unarmed.judge(float(t_s), "", 1.0)
        assert verdict.state is State.DISARMED and verdict.speed_share == 0.0 and verdict.steers
    # Nor does it give up: it is on the bench, and somebody covers the lens.
    assert [unarmed.judge(20.0 + t, "no frame", NAN).state for t in range(5)] == [State.DISARMED] * 5


def test_the_countdown_needs_the_lane_without_a_break() -> None:
    armed = judge(countdown_s=3.0)
    assert armed.judge(0.0, "", 1.0).state is State.COUNTDOWN
    assert armed.judge(2.9, "", 1.0).reason == "starts in 1 s"
    assert armed.judge(2.95, "no lane", 1.0).state is State.STOPPED
    assert armed.judge(3.1, "", 1.0).state is State.COUNTDOWN
    assert armed.judge(6.0, "", 1.0).state is State.COUNTDOWN
    verdict = armed.judge(6.1, "", 1.0)
    assert (verdict.state, verdict.speed_share) == (State.DRIVING, 1.0)


def test_little_confidence_slows_then_stops() -> None:
    armed = judge(slow_below=0.5, stop_below=0.2, slow_share=0.5, slow_for_s=1.0)
    assert armed.judge(0.0, "", 0.5).state is State.DRIVING
    slow = armed.judge(0.1, "", 0.35)
    assert slow.state is State.SLOW and slow.speed_share == pytest.approx(0.75) and slow.steers
    assert armed.judge(0.2, "", 0.19).state is State.STOPPED
    assert armed.judge(0.3, "", NAN).state is State.STOPPED
    assert armed.judge(0.4, "", 0.4).state is State.SLOW
    # Slow since 0.1: the short stop between does not make it fresh.
    stopped = armed.judge(1.1, "", 0.4)
    assert stopped.state is State.STOPPED and not stopped.steers and "for 1 s" in stopped.reason
    assert armed.judge(1.2, "", 0.9).state is State.DRIVING


def test_a_car_that_had_to_stop_for_long_does_not_start_again() -> None:
    armed = judge(end_after_s=1.0)
    armed.judge(0.0, "", 1.0)
    assert armed.judge(0.1, "no frame", NAN).state is State.STOPPED
    assert armed.judge(1.0, "", 1.0).state is State.DRIVING
    assert armed.judge(2.0, "no frame", NAN).state is State.STOPPED
    ended = armed.judge(3.0, "no frame", NAN)
    assert ended.state is State.ENDED and ended.reason == "no frame; stopped for 1 s"
    assert armed.judge(3.1, "", 1.0).state is State.ENDED


def test_an_armed_car_waits_for_its_first_lane() -> None:
    armed = judge()
    assert [armed.judge(float(t), "no lane", NAN).state for t in range(10)] == [State.STOPPED] * 10
    assert armed.judge(10.0, "", 1.0).state is State.DRIVING


def test_stopping_before_slowing_is_refused() -> None:
    with pytest.raises(ConfigError, match="stop_below at or below slow_below"):
        check_settings(SafetySettings, {"slow_below": 0.1, "stop_below": 0.3}, "test")


def test_limits_of_angle_throttle_and_their_rates() -> None:
    limiter = CommandLimiter(
        LimitSettings(max_steering_rad=0.4, steering_rate_rad_s=2.0, max_throttle=0.3, throttle_rate_s=1.0)
    )
    assert limiter.limit(1.0, 1.0, 0.0) == (0.0, 0.0)
    assert limiter.limit(1.0, 1.0, 0.1) == (pytest.approx(0.2), pytest.approx(0.1))
    assert limiter.limit(1.0, 1.0, 0.5) == (pytest.approx(0.4), pytest.approx(0.3))
    # Down at once, and never into reverse.
    assert limiter.limit(-1.0, -0.5, 0.6) == (pytest.approx(0.2), 0.0)
    # NaN keeps the steering and is neutral.
    assert limiter.limit(NAN, NAN, 0.7) == (pytest.approx(0.2), 0.0)
    limiter.limit(0.0, 0.3, 5.0)
    limiter.neutral(5.0)
    assert limiter.limit(0.0, 0.3, 5.1)[1] == pytest.approx(0.1)
    # A clock that goes back moves nothing.
    assert limiter.limit(0.4, 0.3, 4.0) == (limiter.steering_rad, limiter.throttle)
    assert math.isfinite(limiter.throttle)
