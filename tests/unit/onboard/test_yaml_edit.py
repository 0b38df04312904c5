from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from lanenet.errors import ConfigError
from lanenet.onboard.doctor.wheel_trial import set_values

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
    ],
)
def test_another_style_is_left_to_its_owner(text):
    with pytest.raises(ConfigError, match=r"car\.yaml: cannot be changed.*actuator\.steering_trim_rad=0\.05"):
        set_values(text, {"actuator.steering_trim_rad": 0.05}, "car.yaml")
