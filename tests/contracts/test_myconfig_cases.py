"""Donkeycars whose outputs stand in other places: the guard and the car's loop agree on them."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from lanenet.errors import ConfigError
from lanenet.onboard.actuators import first_writes, make_actuator
from lanenet.onboard.actuators.myconfig import with_myconfig
from lanenet.onboard.actuators.pca9685 import LED0_ON_L, PCA9685Settings, neutral_writes

CASES = Path(__file__).resolve().parents[1] / "support/cases"


@pytest.fixture
def car(tmp_path):
    def car(case):
        shutil.copytree(CASES / case, tmp_path / case)
        return PCA9685Settings(kind="pca9685", myconfig=tmp_path / case / "myconfig.py")

    return car


@pytest.mark.parametrize(
    ("case", "chip", "steering", "throttle", "middle"),
    [
        ("myconfig_pins_toplevel", (1, 0x40), 0, 1, 375),
        ("myconfig_servo_esc", (1, 0x40), 1, 0, 360),
        ("myconfig_channels_4_2", (0, 0x41), 0, 1, 375),
        ("myconfig_no_reverse", (1, 0x40), 1, 0, 375),
    ],
)
def test_pulses_go_where_the_file_says(car, case, chip, steering, throttle, middle):
    settings = car(case)
    full = with_myconfig(settings)
    assert (full.bus, full.address) == chip
    neutral = [
        bytes([LED0_ON_L + 4 * channel, 0, 0, count & 0xFF, count >> 8])
        for channel, count in ((throttle, 370), (steering, middle))
    ]
    assert neutral_writes(full) == neutral
    first = first_writes(settings)
    assert first is not None and (first["bus"], first["address"]) == chip
    assert [data.hex() for data in neutral] == first["writes"][3:5]


def test_half_a_dictionary_is_refused_in_plain_words(car):
    settings = car("myconfig_half_dictionary")
    for use in (make_actuator, first_writes):
        with pytest.raises(ConfigError) as caught:
            use(settings)
        text = str(caught.value)
        assert "myconfig.py, line 2: PWM_STEERING_THROTTLE without PWM_STEERING_SCALE" in text
        assert "THROTTLE_REVERSE_PWM; expected" in text and "add what is missing" in text
