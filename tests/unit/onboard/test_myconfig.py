from __future__ import annotations

import pytest

from lanenet.config import check_settings
from lanenet.errors import ConfigError
from lanenet.onboard.actuators.myconfig import read_assignments, settings_from_myconfig, with_myconfig
from lanenet.onboard.actuators.pca9685 import PCA9685Settings, counts_of, prescale_of

NEW = """
import os
raise SystemExit("this file was run")
CAR_PATH = os.path.join("a", "b")
DRIVE_TRAIN_TYPE = "PWM_STEERING_THROTTLE"
PWM_STEERING_THROTTLE = {
    "PWM_STEERING_PIN": "PCA9685.1:41.3",   # Pin for steering servo
    "PWM_STEERING_SCALE": 1.0,
    "PWM_STEERING_INVERTED": False,
    "PWM_THROTTLE_PIN": "PCA9685.1:41.2",
    "PWM_THROTTLE_SCALE": 0.5,
    "PWM_THROTTLE_INVERTED": False,
    "STEERING_LEFT_PWM": 440,
    "STEERING_RIGHT_PWM": 310,
    "THROTTLE_FORWARD_PWM": 900,
    "THROTTLE_STOPPED_PWM": 740,
    "THROTTLE_REVERSE_PWM": 600,
}
"""
OLD = """
# DRIVE_TRAIN_TYPE = "MOCK"
DRIVE_TRAIN_TYPE = "I2C_SERVO"
PCA9685_I2C_ADDR = 0x60
PCA9685_I2C_BUSNUM = None
STEERING_CHANNEL = 5
STEERING_LEFT_PWM: int = 300
STEERING_RIGHT_PWM = 450
THROTTLE_FORWARD_PWM = 400
THROTTLE_STOPPED_PWM = 360
THROTTLE_REVERSE_PWM = 310
"""


@pytest.fixture
def write(tmp_path):
    def write(text, name="myconfig.py"):
        path = tmp_path / name
        path.write_text(text)
        return path

    return write


def test_dictionary_of_donkeycar_5(write):
    found = settings_from_myconfig(write(NEW))
    assert (found["bus"], found["address"], found["steering_channel"], found["throttle_channel"]) == (
        1,
        0x41,
        3,
        2,
    )
    prescale = prescale_of(60.0)
    pulses = ("steering_left_us", "steering_right_us", "throttle_forward_us", "throttle_stopped_us")
    assert [counts_of(found[key], prescale) for key in pulses] == [440, 310, 450, 370]


def test_old_names_at_the_top_level(write):
    found = settings_from_myconfig(write(OLD))
    assert found["address"] == 0x60 and found["steering_channel"] == 5
    assert "bus" not in found and "throttle_channel" not in found
    assert counts_of(found["steering_left_us"], prescale_of(60.0)) == 300


def test_every_count_survives(write):
    prescale = prescale_of(60.0)
    for count in range(130, 500):
        text = f"STEERING_LEFT_PWM = {count}"
        assert counts_of(settings_from_myconfig(write(text))["steering_left_us"], prescale) == count


def test_config_beside_it_holds_what_it_leaves_out(write):
    write(OLD, "config.py")
    found = settings_from_myconfig(write("STEERING_LEFT_PWM = 310"))
    assert found["address"] == 0x60
    assert counts_of(found["steering_left_us"], prescale_of(60.0)) == 310


def test_settings_in_the_yaml_win(write):
    data = {"kind": "pca9685", "myconfig": str(write(NEW)), "throttle_channel": 9, "steering_trim_rad": 0.02}
    settings = with_myconfig(check_settings(PCA9685Settings, data, "car.yaml"))
    assert (settings.throttle_channel, settings.steering_channel, settings.address) == (9, 3, 0x41)
    assert settings.steering_trim_rad == 0.02


def test_only_literals_are_read_and_nothing_is_run(write, tmp_path):
    mark = tmp_path / "mark"
    path = write(f"A = 1\nB = open({str(mark)!r}, 'w')\nA = A + 1\nC = D = -2.5\nif True:\n    E = 3\n")
    assert read_assignments(path) == {"A": 2, "C": -2.5, "D": -2.5}
    assert not mark.exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('DRIVE_TRAIN_TYPE = "VESC"', "DRIVE_TRAIN_TYPE 'VESC', expected"),
        ('PWM_STEERING_THROTTLE = "x"', "expected a dictionary"),
        (
            'PWM_STEERING_THROTTLE = {"PWM_STEERING_PIN": "RPI_GPIO.BOARD.33"}',
            "expected for example 'PCA9685.1:40",
        ),
        ('PWM_STEERING_THROTTLE = {"PWM_THROTTLE_INVERTED": True}', "PWM_THROTTLE_INVERTED: found True"),
        ('STEERING_LEFT_PWM = "460"', "STEERING_LEFT_PWM: expected a number, found '460'"),
        (
            'PWM_STEERING_THROTTLE = {"PWM_STEERING_PIN": "PCA9685.1:40.1", '
            '"PWM_THROTTLE_PIN": "PCA9685.1:41.0"}',
            "two chips",
        ),
        (
            'DRIVE_TRAIN_TYPE = "I2C_SERVO"\nSTEERING_CHANNEL = "1"',
            "STEERING_CHANNEL: expected a whole number",
        ),
        ("STEERING_LEFT_PWM = 1e999", "STEERING_LEFT_PWM: expected a number, found inf"),
        ("THIS IS NOT PYTHON", "not Python"),
    ],
)
def test_what_cannot_be_taken_over_is_named(write, text, message):
    with pytest.raises(ConfigError, match=message):
        settings_from_myconfig(write(text))


@pytest.mark.parametrize(
    ("line", "name"),
    [
        ("THROTTLE_STOPPED_PWM += 20", "THROTTLE_STOPPED_PWM"),
        ("THROTTLE_STOPPED_PWM, A = 390, 1", "THROTTLE_STOPPED_PWM"),
        ("print(THROTTLE_STOPPED_PWM := 390)", "THROTTLE_STOPPED_PWM"),
        ("A = (THROTTLE_STOPPED_PWM := 390)", "THROTTLE_STOPPED_PWM"),
        ("if A: THROTTLE_STOPPED_PWM = 390", "THROTTLE_STOPPED_PWM"),
        ("for THROTTLE_STOPPED_PWM in (390,): pass", "THROTTLE_STOPPED_PWM"),
        ("try: A()\nexcept E as THROTTLE_STOPPED_PWM: pass", "THROTTLE_STOPPED_PWM"),
        ("with open(A) as THROTTLE_STOPPED_PWM: pass", "THROTTLE_STOPPED_PWM"),
        ("def f():\n    global THROTTLE_STOPPED_PWM\n    THROTTLE_STOPPED_PWM = 390\nf()", "STOPPED_PWM"),
        ("def THROTTLE_STOPPED_PWM(): pass", "THROTTLE_STOPPED_PWM"),
        ("match 390:\n    case THROTTLE_STOPPED_PWM: pass", "THROTTLE_STOPPED_PWM"),
        ("del THROTTLE_STOPPED_PWM", "THROTTLE_STOPPED_PWM"),
        ("from pulses import *", r"\*"),
        ("from pulses import STOP as THROTTLE_STOPPED_PWM", "THROTTLE_STOPPED_PWM"),
        ("globals()['THROTTLE_STOPPED_PWM'] = 390", "globals"),
        ("import sys\nsys.modules[__name__].THROTTLE_STOPPED_PWM = 390", "THROTTLE_STOPPED_PWM"),
        ("setattr(A, B, 390)", "setattr"),
        ("exec('THROTTLE_STOPPED_PWM = 390')", "exec"),
        ("THROTTLE_STOPPED_PWM = int(390.5)", "THROTTLE_STOPPED_PWM"),
        ("A = 390\nA += 1\nTHROTTLE_STOPPED_PWM = A", "THROTTLE_STOPPED_PWM"),
        ("DRIVE_TRAIN_TYPE = A", "DRIVE_TRAIN_TYPE"),
        ("PWM_STEERING_THROTTLE['THROTTLE_STOPPED_PWM'] = 390", "PWM_STEERING_THROTTLE"),
        ("PWM_STEERING_THROTTLE.update(THROTTLE_STOPPED_PWM=390)", "PWM_STEERING_THROTTLE"),
        ("A = PWM_STEERING_THROTTLE\nA['THROTTLE_STOPPED_PWM'] = 390", "PWM_STEERING_THROTTLE"),
        ("A = {}\nPWM_STEERING_THROTTLE = A\nA['THROTTLE_STOPPED_PWM'] = 390", "PWM_STEERING_THROTTLE"),
        ("A = PWM_STEERING_THROTTLE = {}\nA['THROTTLE_STOPPED_PWM'] = 390", "PWM_STEERING_THROTTLE"),
        ("PWM_STEERING_THROTTLE = {**A}", "PWM_STEERING_THROTTLE"),
        ("PWM_STEERING_THROTTLE |= {'THROTTLE_STOPPED_PWM': 390}", "PWM_STEERING_THROTTLE"),
        ("A.f_globals['THROTTLE_STOPPED_PWM'] = 390", "f_globals"),
        ("(lambda: 0).__globals__['THROTTLE_STOPPED_PWM'] = 390", "__globals__"),
        ("getattr(A, 'ex' + 'ec')('THROTTLE_STOPPED_PWM = 390')", "getattr"),
        ("import builtins", "builtins"),
    ],
)
@pytest.mark.parametrize("name_of_file", ["myconfig.py", "config.py"])
def test_a_pulse_that_changes_in_another_way_is_refused_by_its_line(write, line, name, name_of_file):
    files = {"myconfig.py": NEW, "config.py": NEW}
    files[name_of_file] += line
    first = NEW.count("\n") + 1
    for file, text in files.items():
        path = write(text, file)
    with pytest.raises(
        ConfigError, match=rf"{name_of_file}, line ({first}|{first + 1}|{first + 2}): .*{name}"
    ):
        settings_from_myconfig(path.with_name("myconfig.py"))


def test_arithmetic_of_earlier_names_as_in_many_cars(write):
    text = """
import os
CAR_PATH = PACKAGE_PATH = os.path.dirname(os.path.realpath(__file__))
DATA_PATH, RATE = os.path.join(CAR_PATH, "data"), 20
AUGMENTATIONS = []          # or ["MULTIPLY"]
AUGMENTATIONS.append("BLUR")
if RATE > 10:
    MODEL = "linear"
STEERING_CENTER_PWM = 370
STEERING_WIDTH_PWM = 80
STEERING_LEFT_PWM = STEERING_CENTER_PWM + STEERING_WIDTH_PWM
STEERING_RIGHT_PWM = STEERING_CENTER_PWM - 2 * STEERING_WIDTH_PWM // 2
PWM_STEERING_THROTTLE = {"THROTTLE_STOPPED_PWM": STEERING_CENTER_PWM - 10}
print(STEERING_LEFT_PWM)
"""
    found, prescale = settings_from_myconfig(write(text)), prescale_of(60.0)
    pulses = ("steering_left_us", "steering_right_us", "throttle_stopped_us")
    assert [counts_of(found[key], prescale) for key in pulses] == [450, 290, 360]


def test_values_out_of_range_name_the_file(write):
    path = write("STEERING_LEFT_PWM = 4000")
    with pytest.raises(ConfigError, match=r"myconfig\.py: key 'steering_left_us'.*2500"):
        with_myconfig(PCA9685Settings(myconfig=path))


def test_the_old_names_have_no_scale(write):
    found = settings_from_myconfig(write(OLD + "PWM_STEERING_SCALE = 0.5\n"))
    assert counts_of(found["steering_left_us"], prescale_of(60.0)) == 300


def test_an_encoding_that_hides_a_line_is_refused(write):
    path = write("# coding: utf-7\n#+AAo-THROTTLE_STOPPED_PWM = 390\n")
    with pytest.raises(ConfigError, match="utf-7"):
        settings_from_myconfig(path)
    assert settings_from_myconfig(write("# coding: latin-1\nSTEERING_LEFT_PWM = 300\n"))


def test_missing_file(tmp_path):
    with pytest.raises(ConfigError, match="no such file"):
        settings_from_myconfig(tmp_path / "myconfig.py")
