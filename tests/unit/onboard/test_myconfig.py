from __future__ import annotations

import re

import pytest

from lanenet.config import check_settings
from lanenet.errors import ConfigError
from lanenet.onboard.actuators.assignments import read_assignments
from lanenet.onboard.actuators.heartbeat import HeartbeatSettings
from lanenet.onboard.actuators.myconfig import settings_from_myconfig, with_myconfig
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
    path = write(
        f"A = 1\nB = open({str(mark)!r}, 'w')\nA = A + 1\nC = D = -2.5\nif True:\n    E = 3\nF = {{'G': 4}}"
    )
    found = read_assignments(path, lambda name: name == "A", "F")
    assert {name: (given.value, given.line) for name, given in found.items()} == {
        "A": (2, 3),
        "C": (-2.5, 4),
        "D": (-2.5, 4),
        "F": ({"G": 4}, 7),
    }
    assert found["F"].entries["G"].where == f"{path}, line 7"
    assert not mark.exists()


def entry(name, value):
    """Return the dictionary of ``NEW`` with another value."""
    return re.sub(rf'("{name}"): [^,]+,', rf"\1: {value},", NEW)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('DRIVE_TRAIN_TYPE = "VESC"', "line 1: DRIVE_TRAIN_TYPE: found 'VESC', expected .*SERVO_ESC.* pilot"),
        ("\nDRIVE_TRAIN_TYPE = None", "line 2: DRIVE_TRAIN_TYPE: found None"),
        ('PWM_STEERING_THROTTLE = "x"', "line 1: PWM_STEERING_THROTTLE: found 'x', expected a dictionary"),
        (
            entry("PWM_STEERING_PIN", '"RPI_GPIO.BOARD.33"'),
            "line 7: PWM_STEERING_PIN: found 'RPI_GPIO.*40.1'",
        ),
        (entry("PWM_THROTTLE_PIN", '"PIGPIO.BCM.13"'), "line 10: PWM_THROTTLE_PIN: found 'PIGPIO.BCM.13'"),
        (entry("PWM_THROTTLE_PIN", '"PCA9685.1:41.16"'), "line 10: .*expected a channel from 0 to 15"),
        (
            entry("PWM_STEERING_PIN", '"PCA9685.1:80.1"'),
            "line 7: .*expected an I2C address from 0x03 to 0x77",
        ),
        (entry("PWM_THROTTLE_PIN", '"PCA9685.1:40.2"'), "line 10: .*two chips"),
        (entry("PWM_THROTTLE_INVERTED", True), "line 12: PWM_THROTTLE_INVERTED: found True, expected False"),
        (entry("PWM_STEERING_SCALE", 0), "line 8: PWM_STEERING_SCALE: found 0, expected a positive number"),
        (entry("PWM_STEERING_SCALE", 2), "STEERING_LEFT_PWM: found 440, expected 123 to 612, .*its scale 2"),
        ('STEERING_LEFT_PWM = "460"', "line 1: STEERING_LEFT_PWM: found '460', expected a number"),
        ("STEERING_LEFT_PWM = 4000", "line 1: STEERING_LEFT_PWM: found 4000, expected 123 to 612, .*2.5 ms"),
        ("STEERING_LEFT_PWM = 1e999", "STEERING_LEFT_PWM: found inf, expected a number"),
        ("A = 1e200\nSTEERING_LEFT_PWM = A * A", "line 2: STEERING_LEFT_PWM: found inf, expected a number"),
        ('STEERING_CHANNEL = "1"', "line 1: STEERING_CHANNEL: found '1', expected a whole number"),
        ("THROTTLE_CHANNEL = 16", "line 1: THROTTLE_CHANNEL: found 16, expected a channel from 0 to 15"),
        ("PCA9685_I2C_ADDR = None", "line 1: PCA9685_I2C_ADDR: found None, expected a whole number"),
        ("PCA9685_I2C_BUSNUM = -1", "line 1: PCA9685_I2C_BUSNUM: found -1, expected an I2C bus"),
        ("PCA9685_I2C_ADDR1 = 0x60", "line 1: PCA9685_I2C_ADDR1: found a name of other outputs"),
        ("STEERING_ARDUINO_PIN = 6", "line 1: STEERING_ARDUINO_PIN: found a name of other outputs"),
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
THROTTLE_STOPPED_PWM = STEERING_CENTER_PWM - 10
print(STEERING_LEFT_PWM)
"""
    found, prescale = settings_from_myconfig(write(text)), prescale_of(60.0)
    pulses = ("steering_left_us", "steering_right_us", "throttle_stopped_us")
    assert [counts_of(found[key], prescale) for key in pulses] == [450, 290, 360]


def test_values_out_of_range_name_the_file(write):
    path = write("STEERING_LEFT_PWM = 4000")
    with pytest.raises(ConfigError, match=r"myconfig\.py, line 1: STEERING_LEFT_PWM"):
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


PINS = """
PWM_STEERING_PIN = "PCA9685.0:41.3"
PWM_THROTTLE_PIN = "PCA9685.0:41.2"
PWM_STEERING_SCALE = 0.5
"""


def places(found):
    return found.get("bus"), found.get("address"), found["steering_channel"], found.get("throttle_channel")


def test_the_drive_train_type_decides_between_the_forms_of_one_file(write):
    # As in Donkeycar's own templates, where all forms stand.
    assert places(settings_from_myconfig(write(NEW + OLD))) == (None, 0x60, 5, None)
    found = settings_from_myconfig(write(OLD + NEW))
    assert places(found) == (1, 0x41, 3, 2)
    assert counts_of(found["steering_left_us"], prescale_of(60.0)) == 440


def test_pins_at_the_top_level(write):
    for kind in ("", 'DRIVE_TRAIN_TYPE = "PWM_STEERING_THROTTLE"'):
        found = settings_from_myconfig(write(PINS + "STEERING_LEFT_PWM = 900\n" + kind))
        assert places(found) == (0, 0x41, 3, 2)
        assert counts_of(found["steering_left_us"], prescale_of(60.0)) == 450


@pytest.mark.parametrize("kind", ["", 'DRIVE_TRAIN_TYPE = "I2C_SERVO"', 'DRIVE_TRAIN_TYPE = "SERVO_ESC"'])
def test_channels_with_and_without_their_type(write, kind):
    text = "STEERING_CHANNEL = 0\nTHROTTLE_CHANNEL = 1\nPCA9685_I2C_ADDR = 0x41\nPCA9685_I2C_BUSNUM = 0\n"
    assert places(settings_from_myconfig(write(text + kind))) == (0, 0x41, 0, 1)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            re.sub('"(PWM_THROTTLE_PIN|THROTTLE_REVERSE_PWM)".*', "", NEW),
            "without PWM_THROTTLE_PIN, THROTTLE_R",
        ),
        (
            'DRIVE_TRAIN_TYPE = "PWM_STEERING_THROTTLE"',
            "line 1: .*without PWM_STEERING_PIN, PWM_THROTTLE_PIN",
        ),
        (PINS.replace("PWM_THROTTLE_PIN", "# "), "line 2: PWM_STEERING_THROTTLE without PWM_THROTTLE_PIN;"),
        (
            '# none\nPWM_THROTTLE_PIN = "PCA9685.1:40.0"',
            "line 2: PWM_STEERING_THROTTLE without PWM_STEERING_PIN;",
        ),
    ],
)
def test_half_of_a_form_names_what_is_missing(write, text, message):
    with pytest.raises(ConfigError, match=message):
        settings_from_myconfig(write(text))


@pytest.mark.parametrize(
    ("config", "mine", "words"),
    [
        # Versions differ in which form they read, and the files do not tell the version.
        (
            "",
            NEW + PINS,
            ["line 20", "PWM_STEERING_PIN 'PCA9685.0:41.3'", "PCA9685.1:41.3' (myconfig.py, line 7)"],
        ),
        (
            "",
            NEW.replace("DRIVE_TRAIN_TYPE", "OTHER") + "THROTTLE_CHANNEL = 3",
            ["line 19", "THROTTLE_CHANNEL 3"],
        ),
        ("", PINS + "STEERING_CHANNEL = 4", ["line 5", "STEERING_CHANNEL 4", "PCA9685.0:41.3"]),
        # What a person wrote does not give way to Donkeycar's default.
        (
            NEW,
            "\nTHROTTLE_CHANNEL = 3",
            ["line 2", "THROTTLE_CHANNEL 3", "PCA9685.1:41.2' (config.py, line 10)"],
        ),
        (NEW, "STEERING_LEFT_PWM = 430", ["line 1", "STEERING_LEFT_PWM 430", "440 (config.py, line 13)"]),
        (NEW, PINS, ["line 2", "PCA9685.0:41.3"]),
        (
            OLD + "THROTTLE_CHANNEL = 1",
            PINS,
            ["line 2", "PCA9685.0:41.3", "PCA9685_I2C_ADDR 96 (config.py, line 4)"],
        ),
    ],
)
def test_lines_that_disagree_are_refused(write, config, mine, words):
    write(config, "config.py")
    with pytest.raises(ConfigError) as caught:
        settings_from_myconfig(write(mine))
    for word in ("myconfig.py", *words):
        assert word in str(caught.value)


def test_lines_that_agree_or_are_not_read_are_taken(write):
    write(NEW + OLD.replace("DRIVE_TRAIN_TYPE", "OTHER"), "config.py")
    agreeing = "PCA9685_I2C_BUSNUM = 1\nSTEERING_CHANNEL = 3\nSTEERING_LEFT_PWM = 440\n"
    assert places(settings_from_myconfig(write(agreeing))) == (1, 0x41, 3, 2)
    assert places(settings_from_myconfig(write("PWM_STEERING_THROTTLE_2 = {}\nSTEERING_PWM_FREQ = 50"))) == (
        1,
        0x41,
        3,
        2,
    )
    assert places(settings_from_myconfig(write('DRIVE_TRAIN_TYPE = "I2C_SERVO"'))) == (None, 0x60, 5, None)


@pytest.mark.parametrize(
    ("text", "own", "words"),
    [
        (
            "STEERING_CHANNEL = 0",
            {},
            ["STEERING_CHANNEL 0 (myconfig.py, line 1)", "THROTTLE_CHANNEL 0 (Donkeycar's"],
        ),
        ("STEERING_CHANNEL = 4", {"throttle_channel": 4}, ["STEERING_CHANNEL 4", "throttle_channel=4"]),
        ("STEERING_LEFT_PWM = 290", {}, ["STEERING_LEFT_PWM 290", "STEERING_RIGHT_PWM 290 (Donkeycar's"]),
        (
            "\nTHROTTLE_STOPPED_PWM = 510",
            {},
            ["THROTTLE_STOPPED_PWM 510 (myconfig.py, line 2)", "FORWARD_PWM 500"],
        ),
    ],
)
def test_values_that_do_not_fit_together_are_named_as_in_the_file(write, text, own, words):
    with pytest.raises(ConfigError) as caught:
        with_myconfig(PCA9685Settings(myconfig=write(text), **own))
    assert "{" not in str(caught.value)
    for word in ("under actuator:", *words):
        assert word in str(caught.value)


def test_a_rule_of_the_bus_keeps_its_words(write):
    # GPIO 3 is the clock of bus 1, which the rule calls the I2C bus.
    own = {"heartbeat": HeartbeatSettings(line=3)}
    with pytest.raises(
        ConfigError, match=r"PCA9685_I2C_BUSNUM 1 \(myconfig.py, line 1\) \[bus=1\]: .* I2C bus"
    ):
        with_myconfig(PCA9685Settings(myconfig=write("PCA9685_I2C_BUSNUM = 1"), **own))
