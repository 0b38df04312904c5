"""Settings that constrain each other: what is refused, by which keys and numbers, and where it is told."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, get_args

import pytest
import yaml

from lanenet.config import Settings, read_yaml
from lanenet.errors import ConfigError
from lanenet.onboard import stop
from lanenet.onboard.actuators import make_actuator
from lanenet.onboard.actuators.pca9685 import PCA9685Settings
from lanenet.onboard.donkey import DonkeySettings, LanePilot
from lanenet.onboard.drive import DriveSettings, build_loop, load_drive_settings

ROOT = Path(__file__).parents[3]
CAMERA = ROOT / "checkpoints" / "small" / "camera.yaml"
GUIDE = ROOT / "docs" / "driving.md"

#: A car in which nothing contradicts anything; with a width of its lane for the lane filter.
CAR = """
source: {kind: picamera2}
camera: camera.yaml
detector: {kind: lane-filter, lane_width_cm: 40}
control: {steering: {wheelbase_cm: 26}}
actuator: {kind: pca9685}
"""
BOARD = "actuator={kind: serial}"

#: Changes of that car, and the keys with their numbers that the error has to name.
REFUSED: list[tuple[tuple[str, ...], tuple[str, ...]]] = [
    # Pulses of both actuators.
    (("actuator.steering_left_us=1530", "actuator.steering_right_us=1470"),
     ("actuator.steering_left_us=1530", "actuator.steering_right_us=1470", "100 us apart")),
    (("actuator.throttle_stopped_us=2100",),
     ("actuator.throttle_stopped_us=2100", "actuator.throttle_forward_us=2040", "throttle_reverse_us=897.6")),
    (("actuator.throttle_stopped_us=2000",),
     ("actuator.throttle_stopped_us=2000", "actuator.throttle_forward_us=2040", "50 us")),
    (("actuator.throttle_forward_us=1000", "actuator.throttle_reverse_us=2040",
      "actuator.throttle_stopped_us=1049"),
     ("actuator.throttle_stopped_us=1049", "actuator.throttle_forward_us=1000", "50 us")),
    (("actuator.throttle_stopped_us=2040", "actuator.throttle_reverse_us=2040"),
     ("actuator.throttle_stopped_us=2040", "actuator.throttle_forward_us=2040", "50 us")),
    ((BOARD, "actuator.throttle_stopped_us=2000"),
     ("actuator.throttle_stopped_us=2000", "actuator.throttle_forward_us=2040", "50 us")),
    (("actuator.steering_trim_rad=-0.23",),
     ("actuator.steering_trim_rad=-0.23", "actuator.max_steering_rad=0.45", "0.225 rad")),
    # The PCA9685.
    (("actuator.steering_channel=3", "actuator.throttle_channel=3"),
     ("actuator.steering_channel=3", "actuator.throttle_channel=3")),
    (("actuator.steering_channel=0",), ("actuator.steering_channel=0", "actuator.throttle_channel=0")),
    (("actuator.throttle_channel=1",), ("actuator.steering_channel=1", "actuator.throttle_channel=1")),
    (("actuator.frequency_hz=400", "actuator.throttle_forward_us=2500"),
     ("actuator.throttle_forward_us=2500", "actuator.frequency_hz=400", "2458 us")),
    (("actuator.frequency_hz=400", "actuator.throttle_forward_us=900", "actuator.throttle_reverse_us=2490"),
     ("actuator.throttle_reverse_us=2490", "actuator.frequency_hz=400")),
    (("actuator.frequency_hz=400", "actuator.throttle_stopped_us=2480", "actuator.throttle_reverse_us=2480"),
     ("actuator.throttle_stopped_us=2480", "actuator.frequency_hz=400")),
    (("actuator.frequency_hz=400", "actuator.steering_left_us=2500"),
     ("actuator.steering_left_us=2500", "actuator.frequency_hz=400")),
    (("actuator.frequency_hz=400", "actuator.steering_right_us=2500"),
     ("actuator.steering_right_us=2500", "actuator.frequency_hz=400")),
    (("actuator.heartbeat={line: 2}",),
     ("actuator.heartbeat.line=2", "actuator.heartbeat.chip=/dev/gpiochip0", "actuator.bus=1")),
    (("actuator.heartbeat={line: 1}", "actuator.bus=0"), ("actuator.heartbeat.line=1", "actuator.bus=0")),
    # Limits, speed and steering.
    (("limits.max_steering_rad=0.5",),
     ("limits.max_steering_rad=0.5", "actuator.max_steering_rad=0.45", "at most 0.45 rad")),
    (("actuator.max_steering_rad=0.4",), ("limits.max_steering_rad=0.45", "actuator.max_steering_rad=0.4")),
    ((BOARD, "limits.max_steering_rad=0.5"),
     ("limits.max_steering_rad=0.5", "actuator.max_steering_rad=0.45")),
    (("limits.max_steering_rad=0.3",),
     ("control.steering.max_steering_rad=0.45", "limits.max_steering_rad=0.3", "at most 0.3 rad")),
    (("limits.max_throttle=0.08",), ("limits.max_throttle=0.08", "control.speed.throttle_at_rest=0.1")),
    (("limits.max_throttle=0.1",), ("limits.max_throttle=0.1", "control.speed.throttle_at_rest=0.1")),
    (("control.speed={cruise_cm_s: 130}",),
     ("control.speed.cruise_cm_s=130", "limits.max_throttle=0.4", "control.speed.throttle_at_rest=0.1",
      "control.speed.cm_s_per_throttle=400", "at most 120 cm/s", "limits.max_throttle at least 0.425")),
    (("control.speed={cruise_cm_s: 500}", "limits.max_throttle=1.0"),
     ("control.speed.cruise_cm_s=500", "at most 360 cm/s")),
    (("control.speed={cruise_cm_s: 20}",), ("control.speed.least_cm_s=30", "control.speed.cruise_cm_s=20")),
    # The lane.
    (("control.steering.lane_width_cm=35",),
     ("detector.lane_width_cm=40", "control.steering.lane_width_cm=35")),
    (("detector={kind: hough}", "camera=null"),
     ("detector.kind=hough", "camera=null", "control.own_target=false")),
    (("detector.model=m.onnx",), ("detector.kind=lane-filter", "detector.model=m.onnx")),
    (("detector.any_camera=true",), ("detector.kind=lane-filter", "detector.any_camera=true")),
    (("detector={kind: hough, mask: car.png}",), ("detector.kind=hough", "detector.mask=car.png")),
    (("detector={kind: painter, lane_width_cm: 40}",),
     ("detector.kind=painter", "detector.lane_width_cm=40")),
    # Safety.
    (("safety={stop_below: 0.6}",), ("safety.stop_below=0.6", "safety.slow_below=0.5")),
    (("safety={stop_below: 0}",), ("safety.stop_below", "greater than 0", "found 0")),
    (("safety={slow_below: 0, stop_below: 0}",), ("safety.slow_below", "greater than 0", "found 0")),
    (("safety={watchdog_s: 0.4, end_after_s: 0.3}",), ("safety.end_after_s=0.3", "safety.watchdog_s=0.4")),
    (("source.rate_hz=12",), ("safety.watchdog_s=0.08", "source.rate_hz=12", "0.0833 s")),
    (("source.rate_hz=10", "safety={watchdog_s: 0.2}"),
     ("safety.max_age_s=0.1", "source.rate_hz=10", "0.1 s")),
    # The camera.
    (("source.delay_s=0.07",), ("source.delay_s=0.07", "safety.max_age_s=0.1", "below 0.1 s")),
    (("source={kind: v4l2, delay_s: 0.25}", "safety={max_age_s: 0.2}"),
     ("source.delay_s=0.25", "safety.max_age_s=0.2")),
    (("source.silence_s=0.02",), ("source.silence_s=0.02", "source.rate_hz=30", "0.0333 s")),
    (("source.start_s=0.02",), ("source.start_s=0.02", "source.rate_hz=30", "0.0333 s")),
    (("source={kind: rpicam, codec: yuv420, width: 160}",),
     ("source.codec=yuv420", "source.width=160", "source.height=240", "multiple of 64")),
]  # fmt: skip

#: What is as tight as it may be.
TAKEN = [
    ("actuator.throttle_stopped_us=1990", "actuator.steering_trim_rad=0.225"),
    # A speed controller without reverse, as Donkeycar's files describe it.
    ("actuator.throttle_reverse_us=1509.6",),
    ("actuator.throttle_forward_us=1000", "actuator.throttle_reverse_us=1509.6"),
    ("actuator.steering_left_us=1450", "actuator.steering_right_us=1550"),
    ("actuator.steering_channel=0", "actuator.throttle_channel=1"),
    ("actuator.frequency_hz=400", "actuator.throttle_forward_us=2450"),
    ("actuator.heartbeat={line: 2}", "actuator.bus=0"),
    ("actuator.heartbeat={line: 2, chip: /dev/gpiochip4}",),
    (BOARD, "limits.max_steering_rad=0.45"),
    ("actuator={kind: recorder}", "limits.max_steering_rad=1.2"),
    ("actuator=null", "limits.max_steering_rad=1.2"),
    ("control.speed={cruise_cm_s: 120}",),
    ("limits.max_throttle=0.25",),
    ("control.steering.lane_width_cm=40",),
    ("detector={kind: hough}",),
    ("detector={kind: hough}", "camera=null", "control.own_target=true"),
    ("safety={stop_below: 0.5, slow_below: 0.5}",),
    ("source.rate_hz=10", "safety={watchdog_s: 0.12, max_age_s: 0.15}"),
    ("source.delay_s=0.06",),
    ("source={kind: rpicam, delay_s: 0.45}", "safety={max_age_s: 0.5}"),
    # To look at it.
    ("source={kind: replay, path: drive, rate_hz: 1}",),
]


@pytest.fixture
def car(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "car.yaml"
    path.write_text(CAR)
    monkeypatch.chdir(tmp_path)
    return path


def refusal(path: Path, changes: tuple[str, ...]) -> str:
    with pytest.raises(ConfigError) as caught:
        load_drive_settings(path, list(changes))
    assert str(caught.value).startswith(str(path))
    return str(caught.value)


@pytest.mark.parametrize(("changes", "named"), REFUSED, ids=lambda words: " ".join(words)[:60])
def test_what_cannot_be_right_is_refused_with_keys_and_numbers(
    car: Path, changes: tuple[str, ...], named: tuple[str, ...]
) -> None:
    text = refusal(car, changes)
    assert not [word for word in named if word not in text], text
    assert "pca9685." not in text and "{" not in text, "the file has no such key"


@pytest.mark.parametrize("changes", TAKEN, ids=" ".join)
def test_what_is_as_tight_as_it_may_be_is_taken(car: Path, changes: tuple[str, ...]) -> None:
    load_drive_settings(car, list(changes))


def test_all_that_one_change_breaks_is_named_at_once(car: Path) -> None:
    text = refusal(car, ("actuator.max_steering_rad=0.3", "limits.max_steering_rad=0.4"))
    assert "limits.max_steering_rad=0.4 and actuator.max_steering_rad=0.3" in text
    assert "control.steering.max_steering_rad=0.45 and limits.max_steering_rad=0.4" in text


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"limits": {"max_throttle": 0.05}}, ("limits.max_throttle=0.05", "throttle_at_rest=0.1")),
        ({"limits": {"max_throttle": 0.2}}, ("control.speed.cruise_cm_s=60", "limits.max_throttle=0.2")),
        ({"limits": {"max_steering_rad": 0.3}}, ("control.steering.max_steering_rad=0.45", "=0.3")),
        (
            {
                "detector": {"kind": "lane-filter", "lane_width_cm": 40},
                "control": {"steering": {"wheelbase_cm": 26, "lane_width_cm": 35}},
            },
            ("detector.lane_width_cm=40", "control.steering.lane_width_cm=35"),
        ),
        ({"camera": None, "detector": {"kind": "painter"}}, ("detector.kind=painter", "camera=null")),
        ({"min_confidence": 0}, ("min_confidence", "greater than 0")),
    ],
)
def test_the_pilot_of_a_donkeycar_is_held_to_the_same(
    tmp_path: Path, changes: dict[str, Any], named: tuple[str, ...]
) -> None:
    path = tmp_path / "lanenet.yaml"
    shipped = read_yaml(ROOT / "configs" / "donkeycar" / "pilot.yaml")
    # The shipped file takes it from the camera file, which is not beside this copy.
    shipped["control"]["steering"] = {"wheelbase_cm": 26}
    path.write_text(yaml.safe_dump(shipped | changes))
    with pytest.raises(ConfigError) as caught:
        LanePilot.from_file(path)
    assert not [word for word in named if word not in str(caught.value)], caught.value


@pytest.mark.parametrize(
    ("section", "lines", "named"),
    [
        ("steering_channel: 3", "THROTTLE_CHANNEL = 3", ("steering_channel=3", "throttle_channel=3")),
        # The steering's channel is Donkeycar's default here, and lanenet's.
        ("", "THROTTLE_CHANNEL = 1", ("steering_channel=1", "throttle_channel=1")),
        ("", "THROTTLE_STOPPED_PWM = 495", ("throttle_stopped_us=2019", "throttle_forward_us=2040")),
        ("", "STEERING_LEFT_PWM = 370\nSTEERING_RIGHT_PWM = 360", ("steering_left_us", "steering_right_us")),
        ("heartbeat: {line: 3}", "PCA9685_I2C_BUSNUM = 1", ("heartbeat.line=3", "bus=1")),
    ],
)
def test_what_a_myconfig_completes_is_held_to_the_same(
    car: Path, section: str, lines: str, named: tuple[str, ...]
) -> None:
    Path("myconfig.py").write_text(f'DRIVE_TRAIN_TYPE = "I2C_SERVO"\n{lines}\n')
    own = f"actuator={{kind: pca9685, myconfig: myconfig.py, {section}}}"
    settings = load_drive_settings(car, [own])
    assert settings.actuator is not None
    with pytest.raises(ConfigError) as caught:
        make_actuator(settings.actuator)
    assert not [word for word in named if word not in str(caught.value)], caught.value
    # What ends the drive is what stops the car.
    with pytest.raises(ConfigError):
        stop.stop_car(car, [own])


def test_a_myconfig_mends_what_the_section_alone_would_get_wrong(car: Path) -> None:
    """The channel of the steering is the default of the throttle, which the file moves."""
    Path("myconfig.py").write_text(
        'DRIVE_TRAIN_TYPE = "I2C_SERVO"\nTHROTTLE_CHANNEL = 1\nTHROTTLE_FORWARD_PWM = 560\n'
    )
    section = (
        "actuator={kind: pca9685, myconfig: myconfig.py, steering_channel: 0, throttle_stopped_us: 2100}"
    )
    settings = load_drive_settings(car, [section])
    assert settings.actuator is not None
    make_actuator(settings.actuator)


def test_the_limit_of_a_car_with_a_myconfig_is_held_to_its_servo(car: Path) -> None:
    text = refusal(car, ("actuator={kind: pca9685, myconfig: gone.py}", "limits.max_steering_rad=0.6"))
    assert "limits.max_steering_rad=0.6 and actuator.max_steering_rad=0.45" in text


def test_a_car_is_stopped_whatever_its_other_sections_say(car: Path) -> None:
    wrong = ["limits.max_steering_rad=0.9", "safety={stop_below: 0}", "source.rate_hz=1", "limits.x=1"]
    refusal(car, tuple(wrong))
    assert stop.read_actuator(car, wrong) == PCA9685Settings()


def test_a_camera_of_another_size_than_its_file_is_refused(car: Path) -> None:
    settings = load_drive_settings(car, [f"camera={CAMERA}", "source.width=640", "source.height=480"])
    with pytest.raises(
        ConfigError, match=r"source\.width=640, source\.height=480 .*camera\.yaml\) of 320x240"
    ):
        build_loop(settings, dry_run=True)


def rules_below(annotation: Any, prefix: str = "") -> set[frozenset[str]]:
    """The dotted keys of every rule of a section, of all its kinds, and of the sections in it."""
    found = set().union(*(rules_below(part, prefix) for part in get_args(annotation)))
    if isinstance(annotation, type) and issubclass(annotation, Settings):
        found |= {frozenset(prefix + key for key in rule.keys) for rule in annotation.rules}
        for name, field in annotation.model_fields.items():
            found |= rules_below(field.annotation, f"{prefix}{name}.")
    return found


def table_of_the_guide() -> set[frozenset[str]]:
    """The keys in the first column of each row."""
    section = GUIDE.read_text().partition("## Settings that constrain each other")[2].partition("\n## ")[0]
    rows = [line.split(" | ")[0] for line in section.splitlines() if line.startswith("| `")]
    return {frozenset(re.findall(r"`([a-z0-9_.]+)`", row)) for row in rows}


def test_the_table_of_the_guide_has_every_rule() -> None:
    # The five pulses share a row.
    rate = "actuator.frequency_hz"
    rules = {keys for keys in rules_below(DriveSettings) if rate not in keys}
    rules.add(frozenset().union(*(keys for keys in rules_below(DriveSettings) if rate in keys)))
    assert len(rules) > 20 and rules_below(DonkeySettings) < rules
    # Bounds of single values, and what another file says.
    others = {"safety.slow_below"}, {"safety.stop_below"}, {"camera", "source.height", "source.width"}
    listed = {row for row in table_of_the_guide() if row not in others}
    assert listed == rules, [sorted(keys) for keys in listed ^ rules]
