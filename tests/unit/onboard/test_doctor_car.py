from __future__ import annotations

import math
import time
from pathlib import Path

import fake_picamera2
import i2c_emulator
import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from lanenet.cli.app import app
from lanenet.config import check_settings
from lanenet.data.drives.folder import DriveWriter
from lanenet.errors import HardwareError, LanenetError
from lanenet.onboard.bench import example_camera
from lanenet.onboard.devices import Frame
from lanenet.onboard.doctor import car as doctor_car
from lanenet.onboard.doctor import installation as doctor
from lanenet.onboard.doctor.car import (
    check_calibration,
    check_car,
    check_source,
    check_temperature,
    check_throttling,
)
from lanenet.onboard.drive import DriveSettings
from lanenet.perception.camera_check import CameraCheck
from lanenet.perception.estimate import LaneEstimate

ROOT = Path(__file__).resolve().parents[3]
CHECKPOINT = ROOT / "checkpoints" / "small"


class Camera:
    """A source of even frames, ``late_s`` old when they come."""

    def __init__(self, rate_hz=50.0, size=(240, 320), late_s=0.01, value=100, missing=False, age_known=True):
        self.rate_hz, self.size, self.late_s, self.value, self.missing = rate_hz, size, late_s, value, missing
        self.number, self.closed, self.age_known = 0, False, age_known

    def open(self):
        if self.missing:
            raise HardwareError("picamera2 camera 0: cannot be started")

    def read(self, timeout_s):
        if timeout_s < 1.0 / self.rate_hz:
            time.sleep(timeout_s)
            return None
        time.sleep(1.0 / self.rate_hz)
        self.number += 1
        image = np.full((*self.size, 3), self.value, np.uint8)
        return Frame(image, time.monotonic() - self.late_s, self.number, self.age_known)

    def close(self):
        self.closed = True


@pytest.fixture(autouse=True)
def short(monkeypatch):
    monkeypatch.setattr(doctor_car, "_WATCH_S", 0.4)


def states(checks):
    return {check.name: check.state for check in checks}


def test_good_camera():
    source = Camera()
    checks, frames = check_source(source, 40.0, example_camera())
    assert len(frames) > 2 and states(checks) == {"camera": "ok", "image size": "ok", "delay": "ok"}
    assert source.closed
    assert "10 ms from exposure" in checks[2].text or "11 ms" in checks[2].text


@pytest.mark.parametrize(
    ("source", "name", "state", "text"),
    [
        (Camera(missing=True), "camera", "problem", "cannot be started"),
        (Camera(rate_hz=10.0), "camera", "problem", "40 were requested"),
        (Camera(size=(120, 160)), "image size", "problem", "160x120 px, but the camera file is for 320x240"),
        (Camera(late_s=0.2), "delay", "note", "200 ms"),
        (
            Camera(age_known=False),
            "delay",
            "note",
            "age of the frames unknown: measure it with lanenet doctor",
        ),
        (Camera(value=3), "image", "note", "is the lens covered"),
        (Camera(rate_hz=1.0), "camera", "problem", "expected a stream"),
    ],
    ids=["missing", "slow", "size", "late", "no age", "dark", "no stream"],
)
def test_what_is_wrong_with_a_camera(source, name, state, text):
    found = {check.name: check for check in check_source(source, 40.0, example_camera())[0]}
    assert found[name].state == state and text in found[name].text
    assert source.closed


def test_picamera2_that_is_too_old_is_a_line_and_not_a_traceback(monkeypatch, car, bus):
    fake_picamera2.install(monkeypatch).old = True
    text = car.read_text().replace("kind: replay", "kind: picamera2").replace("  loop: true\n", "")
    car.write_text("".join(line for line in text.splitlines(True) if "path: " not in line))
    done = CliRunner().invoke(app, ["doctor", "--config", str(car)])
    assert isinstance(done.exception, SystemExit | LanenetError), done.output
    (line,) = [line for line in done.output.splitlines() if "picamera2 is too old" in line]
    assert line.startswith("problem camera:") and "sudo apt upgrade" in line


@pytest.mark.parametrize(
    ("pitch_deg", "confidence", "state"),
    [(3.0, 1.0, "ok"), (20.0, 1.0, "problem"), (20.0, 0.1, "note"), (math.nan, 1.0, "note")],
)
def test_the_lines_are_compared_with_the_camera_file(pitch_deg, confidence, state):
    class Views(CameraCheck):
        def view(self, frame_bgr):
            return math.radians(pitch_deg), 0.0

    class Eye:
        def detect(self, frame_bgr):
            return LaneEstimate(confidence=confidence)

        def reset(self):
            pass

    frames = [Frame(np.zeros((240, 320, 3), np.uint8), 0.1 * i, i) for i in range(20)]
    assert check_calibration(Views(example_camera()), Eye(), frames, 0.5).state == state


@pytest.mark.parametrize(
    ("milli", "state"), [("45123\n", "ok"), ("72000", "note"), ("81000", "problem"), ("hot", "note")]
)
def test_temperature(tmp_path, milli, state):
    (tmp_path / "temp").write_text(milli)
    assert check_temperature(tmp_path / "temp").state == state
    assert check_temperature(tmp_path / "missing").state == "note"


@pytest.mark.parametrize(
    ("said", "state", "text"),
    [
        ("throttled=0x0", "ok", "no throttling"),
        ("throttled=0x50005", "problem", "voltage is too low and the processor is throttled; use a supply"),
        ("throttled=0x80008", "problem", "limit of temperature"),
        ("throttled=0x20000", "note", "since boot it happened that the processor's clock is capped"),
        ("VCHI initialization failed", "note", "VCHI"),
    ],
)
def test_throttling(said, state, text):
    check = check_throttling(lambda: said)
    assert check.state == state and text in check.text


@pytest.fixture
def car(tmp_path, monkeypatch) -> Path:
    """A whole car: a drive that plays the camera, the shipped model, and a PCA9685."""
    with DriveWriter(tmp_path / "drive") as writer:
        for i in range(30):
            writer.add(np.full((240, 320, 3), 90 + i, np.uint8), 0.04 * i)
    data = {
        "source": {"kind": "replay", "path": str(tmp_path / "drive"), "loop": True},
        "camera": str(CHECKPOINT / "camera.yaml"),
        "detector": {"kind": "network", "model": str(CHECKPOINT / "model.onnx")},
        "control": {"steering": {"look_ahead_cm": 15.0}},
        "actuator": {"kind": "pca9685"},
    }
    path = tmp_path / "car.yaml"
    path.write_text("# mine\n" + yaml.safe_dump(data))
    return path


@pytest.fixture
def bus(monkeypatch):
    bus = i2c_emulator.Bus(i2c_emulator.Chip())
    i2c_emulator.install(monkeypatch, bus)
    return bus


def test_doctor_of_a_whole_car(car, bus):
    done = CliRunner().invoke(app, ["doctor", "--config", str(car)])
    assert done.exit_code == 0, done.output
    for line in (
        "ok      camera file",
        "ok      camera: 25",
        "ok      detector network",
        "ok      actuator pca9685",
    ):
        assert line in done.output
    assert "--wheels-off-ground" in done.output
    assert bus.closed and bus.chip.counts(0) == 370
    assert set(bus.chip.pulses) <= {(0, 370), (1, 375)}, "doctor moved the motor"


def test_doctor_of_a_broken_car(car, bus):
    bus.broken = True
    text = car.read_text().replace("model.onnx", "missing.onnx")
    settings = check_settings(
        DriveSettings, {**yaml.safe_load(text), "control": {"steering": {"wheelbase_cm": 26}}}, ""
    )
    found = {check.name: check for check in check_car(settings)}
    assert found["detector network"].state == "problem" and "missing.onnx" in found["detector network"].text
    assert found["actuator pca9685"].state == "problem" and "i2cdetect" in found["actuator pca9685"].text
    car.write_text(text)
    done = CliRunner().invoke(app, ["doctor", "--config", str(car)])
    assert done.exit_code == 1


def test_wheels_off_ground_needs_a_file_and_a_yes(car, monkeypatch):
    done = CliRunner().invoke(app, ["doctor", "--wheels-off-ground"])
    assert done.exit_code == 1
    before = car.read_text()
    done = CliRunner().invoke(app, ["doctor", "--config", str(car), "--wheels-off-ground"], input="x\nn\n")
    assert done.exit_code == 0 and "nothing was tried" in done.output
    assert car.read_text() == before


def test_answers_are_written_into_the_file(car, monkeypatch):
    from lanenet.onboard import drive

    class Sink:
        def open(self):
            pass

        send = idle = neutral = close = lambda self, *values: None

    monkeypatch.setattr(drive, "build_sink", lambda settings: Sink())
    # On a box; points right; points left of straight, then straight; does not turn yet, then backward.
    done = CliRunner().invoke(
        app, ["doctor", "--config", str(car), "--wheels-off-ground"], input="y\nr\nl\ns\nn\nb\n"
    )
    assert done.exit_code == 0, done.output
    text = car.read_text()
    data = yaml.safe_load(text)
    assert text.startswith("# mine\n")
    assert data["actuator"] == {
        "kind": "pca9685",
        "steering_left_us": 1183.2,
        "steering_right_us": 1876.8,
        "steering_trim_rad": -0.01,
        "throttle_forward_us": 897.6,
        "throttle_reverse_us": 2040.0,
    }
    assert data["control"]["speed"]["throttle_at_rest"] == 0.04
    assert done.output.count("wrote") == 1


def test_answers_that_rule_out_the_cruise_speed_are_told_with_what_to_write(car, monkeypatch):
    from lanenet.onboard import drive

    class Sink:
        def open(self):
            pass

        send = idle = neutral = close = lambda self, *values: None

    monkeypatch.setattr(drive, "build_sink", lambda settings: Sink())
    # Left is left, straight is straight; the wheels turn at the thirteenth step, a throttle of 0.26.
    answers = "y\nl\ns\n" + 12 * "n\n" + "f\n"
    done = CliRunner().invoke(app, ["doctor", "--config", str(car), "--wheels-off-ground"], input=answers)
    assert done.exit_code == 1 and "wrote" in done.output
    assert yaml.safe_load(car.read_text())["control"]["speed"]["throttle_at_rest"] == 0.26
    assert "control.speed.cruise_cm_s at most 56 cm/s, or limits.max_throttle at least 0.41" in done.stderr


@pytest.mark.parametrize(
    ("missing", "told"), [((), "next: copy a drive here"), (("torch",), "next, for the car: cp configs/car/")]
)
def test_next_is_what_this_installation_can_do(monkeypatch, tmp_path, missing, told):
    monkeypatch.chdir(tmp_path)
    there = doctor._version
    monkeypatch.setattr(doctor, "_version", lambda name: None if name in missing else there(name))
    done = CliRunner().invoke(app, ["doctor"])
    assert done.exit_code == 0 and told in done.stdout
