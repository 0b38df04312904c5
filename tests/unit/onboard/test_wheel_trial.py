from __future__ import annotations

import itertools
import time
from pathlib import Path

import pytest
import yaml

from lanenet.config import check_settings
from lanenet.errors import ConfigError, HardwareError
from lanenet.onboard.actuators.pulses import PulseSettings, command_pulses
from lanenet.onboard.doctor.wheel_trial import set_values, try_wheels
from lanenet.onboard.drive import DriveSettings

PULSES = {
    "max_steering_rad": 0.4,
    "steering_left_us": 1900.0,
    "steering_right_us": 1100.0,
    "throttle_forward_us": 2000.0,
    "throttle_stopped_us": 1500.0,
    "throttle_reverse_us": 1000.0,
}


def settings_of(**actuator) -> DriveSettings:
    data = {
        "source": {"kind": "v4l2"},
        "control": {"steering": {"wheelbase_cm": 20.0, "max_steering_rad": 0.4}},
        "limits": {"max_throttle": 0.3, "max_steering_rad": 0.4},
        "actuator": {"kind": "serial", **PULSES, **actuator},
    }
    return check_settings(DriveSettings, data, "car.yaml")


class Car:
    """A car and the person beside it, who looks at its wheels; speaks for both ends of the trial."""

    def __init__(
        self, settings, *, straight_us=1500.0, longer_is_left=True, rolls_at_us=60.0, longer_is_ahead=True
    ):
        self.pulses = settings.actuator
        self.straight_us, self.rolls_at_us = straight_us, rolls_at_us
        self.longer_is_left, self.longer_is_ahead = longer_is_left, longer_is_ahead
        self.sent, self.opened, self.closed, self.broken = [], 0, 0, False
        self.questions = []

    def open(self):
        self.opened += 1
        self.sent.append((time.monotonic(), 0.0, 0.0))

    def send(self, steering_rad, throttle, until_s):
        if self.broken:
            raise HardwareError("the board is gone")
        assert until_s > time.monotonic()
        self.sent.append((time.monotonic(), steering_rad, throttle))

    def idle(self):
        pass

    def neutral(self):
        self.sent.append((time.monotonic(), 0.0, 0.0))

    def close(self):
        self.closed += 1
        self.neutral()

    def ask(self, question, letters):
        self.questions.append(question)
        if letters == "yn":
            return "y"
        pulses = command_pulses(self.pulses, *self.sent[-1][1:])
        left_us = (pulses.steering_us - self.straight_us) * (1.0 if self.longer_is_left else -1.0)
        ahead_us = (pulses.throttle_us - self.pulses.throttle_stopped_us) * (
            1.0 if self.longer_is_ahead else -1.0
        )
        if letters == "lrs":
            return "s" if abs(left_us) <= 12.0 else "l" if left_us > 0.0 else "r"
        if letters == "lr":
            return "l" if left_us > 0.0 else "r"
        assert letters == "nfb"
        return "n" if abs(ahead_us) < self.rolls_at_us else "f" if ahead_us > 0.0 else "b"


def mended(settings: DriveSettings, changes: dict[str, float]) -> PulseSettings:
    found = {key.partition(".")[2]: value for key, value in changes.items() if key.startswith("actuator.")}
    return check_settings(
        PulseSettings, {**PULSES, "steering_trim_rad": settings.actuator.steering_trim_rad, **found}, ""
    )


@pytest.mark.parametrize("straight_us", [1500.0, 1560.0, 1430.0])
@pytest.mark.parametrize("longer_is_left", [True, False])
@pytest.mark.parametrize("trim_rad", [0.0, 0.04])
def test_any_car_runs_straight_and_turns_left_afterwards(straight_us, longer_is_left, trim_rad):
    settings = settings_of(steering_trim_rad=trim_rad)
    car = Car(settings, straight_us=straight_us, longer_is_left=longer_is_left)
    result = try_wheels(settings, car, car.ask)
    pulses = mended(settings, result.changes)
    assert command_pulses(pulses, 0.0, 0.0).steering_us == pytest.approx(straight_us, abs=13.0)
    turned_us = command_pulses(pulses, 0.2, 0.0).steering_us - straight_us
    assert (turned_us > 100.0) == longer_is_left and abs(turned_us) > 100.0


def test_motor_that_turns_backward_is_turned_round():
    settings = settings_of()
    car = Car(settings, longer_is_ahead=False)
    result = try_wheels(settings, car, car.ask)
    assert result.changes["control.speed.throttle_at_rest"] == 0.12, "60 us of 500 us are 0.12"
    assert command_pulses(mended(settings, result.changes), 0.0, 0.5).throttle_us == 1250.0


@pytest.mark.parametrize("reverse_us", [1500.0, 1460.0])
def test_a_motor_without_reverse_is_turned_round_at_the_speed_controller(reverse_us):
    """Exchanged, the forward pulse would be neutral, or too close to it: a file that is refused."""
    settings = settings_of(throttle_reverse_us=reverse_us)
    car = Car(settings, longer_is_ahead=False)
    result = try_wheels(settings, car, car.ask)
    assert result.changes == {"control.speed.throttle_at_rest": 0.12}
    assert any("backward" in line and "direction at the speed controller" in line for line in result.lines)


def test_right_car_keeps_its_values():
    settings = settings_of()
    car = Car(settings)
    result = try_wheels(settings, car, car.ask)
    assert result.changes == {"control.speed.throttle_at_rest": 0.12}
    assert max(throttle for _, _, throttle in car.sent) <= 0.12


def test_motor_that_never_turns_ends_at_the_limit():
    settings = settings_of()
    car = Car(settings, rolls_at_us=400.0)
    result = try_wheels(settings, car, car.ask)
    assert max(throttle for _, _, throttle in car.sent) == pytest.approx(0.3)
    assert result.changes == {} and "did not turn up to a throttle of 0.3" in result.lines[-1]
    assert car.sent[-1][1:] == (0.0, 0.0)


def test_crooked_servo_horn_is_named():
    settings = settings_of()
    car = Car(settings, straight_us=400.0)
    result = try_wheels(settings, car, car.ask)
    # Half of the servo's travel to a side; more is refused in a car's file.
    assert any("more than 11 degrees" in line and "refit the servo's horn" in line for line in result.lines)
    assert "actuator.steering_trim_rad" not in result.changes


def test_commands_are_repeated_while_a_person_thinks():
    settings = settings_of()
    car = Car(settings)

    def slow(question, letters):
        if letters == "lr":
            time.sleep(0.4)
        return car.ask(question, letters)

    try_wheels(settings, car, slow)
    turned = [t for t, steering_rad, _ in car.sent if steering_rad > 0.2]
    assert turned[-1] - turned[0] > 0.35
    assert max(b - a for a, b in itertools.pairwise(turned)) < 0.1 + 0.1, "the watchdog would stop it"


def test_nothing_moves_without_yes():
    car = Car(settings_of())
    result = try_wheels(settings_of(), car, lambda question, letters: "n")
    assert not car.opened and result.changes == {} and "put the car on a stand" in result.lines[0]


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_neutral_at_the_end_whatever_happens(error):
    settings = settings_of()
    car = Car(settings)

    def leave(question, letters):
        if letters == "nfb":
            raise error
        return car.ask(question, letters)

    with pytest.raises(error):
        try_wheels(settings, car, leave)
    assert car.closed == 1 and car.sent[-1][1:] == (0.0, 0.0)


def test_lost_actuator_ends_the_trial():
    settings = settings_of()
    car = Car(settings)

    def pull(question, letters):
        car.broken = letters == "lr"
        time.sleep(0.1)
        return car.ask(question, letters)

    with pytest.raises(HardwareError, match="the board is gone"):
        try_wheels(settings, car, pull)
    assert car.closed == 1


def test_car_without_wheels_is_refused():
    data, car = settings_of().model_dump(exclude={"actuator"}), Car(settings_of())
    with pytest.raises(ConfigError, match="found none, expected one with wheels"):
        try_wheels(check_settings(DriveSettings, data, ""), car, car.ask)
    data["actuator"] = {"kind": "recorder"}
    with pytest.raises(ConfigError, match="found kind: recorder"):
        try_wheels(check_settings(DriveSettings, data, ""), car, car.ask)


CARS = Path(__file__).resolve().parents[3] / "configs" / "car"
TEXT = """\
# A car.
control:
  steering:
    wheelbase_cm: 26
  speed:
    cruise_cm_s: 60
    # Just begins to roll.
    throttle_at_rest: 0.1   # measured
actuator:
  kind: serial
# The end.
recording:
  folder: drives
"""


def test_a_value_is_replaced_and_its_comment_stays():
    changed = set_values(TEXT, {"control.speed.throttle_at_rest": 0.14}, "car.yaml")
    assert changed == TEXT.replace("0.1   # measured", "0.14   # measured")


def test_a_value_is_added_to_its_section():
    changed = set_values(TEXT, {"actuator.steering_trim_rad": -0.02}, "car.yaml")
    assert changed == TEXT.replace("kind: serial\n", "kind: serial\n  steering_trim_rad: -0.02\n")


def test_a_section_is_added():
    changed = set_values(
        "control:\n  steering: {wheelbase_cm: 26}\n", {"control.speed.throttle_at_rest": 0.2}, "c"
    )
    assert changed == "control:\n  steering: {wheelbase_cm: 26}\n  speed:\n    throttle_at_rest: 0.2\n"
    assert set_values("", {"a.b.c": 2.0}, "c") == "a:\n  b:\n    c: 2\n"


@pytest.mark.parametrize("path", sorted(CARS.glob("*.yaml")), ids=lambda path: path.name)
def test_every_shipped_car_can_be_changed(path):
    text = path.read_text()
    changes = {
        "actuator.steering_trim_rad": 0.03,
        "control.speed.throttle_at_rest": 0.12,
        "limits.max_throttle": 1.0,
    }
    changed = set_values(text, changes, str(path))
    data = yaml.safe_load(changed)
    assert data["actuator"]["steering_trim_rad"] == 0.03 and data["limits"]["max_throttle"] == 1
    assert data["control"]["speed"]["throttle_at_rest"] == 0.12
    assert data["control"]["steering"] == yaml.safe_load(text)["control"]["steering"]
    assert [line for line in text.splitlines() if "#" in line and line not in changed.splitlines()] == []


@pytest.mark.parametrize(
    "text",
    [
        "actuator: {kind: serial}\n",
        "actuator: 5\n",
        "- a\n- b\n",
        "a: &x\n  b: [\n",
        "actuator:\n  kind: serial\n  kind: pca9685\n",
    ],
)
def test_another_style_is_left_to_its_owner(text):
    with pytest.raises(ConfigError, match=r"car\.yaml: cannot be changed.*actuator\.steering_trim_rad=0\.05"):
        set_values(text, {"actuator.steering_trim_rad": 0.05}, "car.yaml")
