from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lanenet.config import check_settings
from lanenet.errors import ConfigError, HardwareError
from lanenet.onboard.actuators.pulses import PulseSettings, command_pulses, neutral_pulses

CAR = PulseSettings(
    max_steering_rad=0.4,
    steering_left_us=1900,
    steering_right_us=1100,
    throttle_forward_us=2000,
    throttle_stopped_us=1480,
    throttle_reverse_us=1000,
)


@pytest.mark.parametrize(
    ("steering_rad", "throttle", "steering_us", "throttle_us"),
    [
        (0.0, 0.0, 1500, 1480),
        (0.4, 1.0, 1900, 2000),
        (-0.4, -1.0, 1100, 1000),
        (0.1, 0.5, 1600, 1740),
        (-9.0, -0.25, 1100, 1360),
        (9.0, 7.0, 1900, 2000),
    ],
)
def test_known_pulses(steering_rad, throttle, steering_us, throttle_us):
    pulses = command_pulses(CAR, steering_rad, throttle)
    assert (pulses.steering_us, pulses.throttle_us) == pytest.approx((steering_us, throttle_us))


@given(st.floats(-10, 10), st.floats(-10, 10), st.floats(-0.3, 0.3))
def test_no_command_leaves_the_limits(steering_rad, throttle, trim_rad):
    pulses = command_pulses(CAR.model_copy(update={"steering_trim_rad": trim_rad}), steering_rad, throttle)
    assert 1100 <= pulses.steering_us <= 1900 and 1000 <= pulses.throttle_us <= 2000
    assert (pulses.throttle_us - 1480) * throttle >= 0.0, "the motor turns the wrong way"


def test_trim_moves_the_middle_and_not_the_ends():
    trimmed = CAR.model_copy(update={"steering_trim_rad": 0.05})
    assert neutral_pulses(trimmed).steering_us == pytest.approx(1550)
    assert neutral_pulses(trimmed).throttle_us == 1480
    assert command_pulses(trimmed, 0.4, 0.0).steering_us == pytest.approx(1900)


def test_reversed_servo_has_its_pulses_exchanged():
    turned = CAR.model_copy(update={"steering_left_us": 1100.0, "steering_right_us": 1900.0})
    assert command_pulses(turned, 0.1, 0.0).steering_us == pytest.approx(1400)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_what_is_no_number_makes_no_pulse(bad):
    with pytest.raises(HardwareError, match="expected finite numbers"):
        command_pulses(CAR, bad, 0.0)
    with pytest.raises(HardwareError, match="expected finite numbers"):
        command_pulses(CAR, 0.0, bad)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"throttle_stopped_us": 2100}, "throttle_stopped_us=2100, .*expected throttle_stopped_us between"),
        ({"steering_left_us": 1500, "steering_right_us": 1500}, "wheels cannot turn"),
        ({"throttle_forward_us": 3000}, "less than or equal to 2500"),
        ({"stering_trim_rad": 0.1}, "did you mean 'steering_trim_rad'"),
    ],
)
def test_impossible_pulses_are_named(data, message):
    with pytest.raises(ConfigError, match=message):
        check_settings(PulseSettings, data, "car.yaml")
