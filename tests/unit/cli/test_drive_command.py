from __future__ import annotations

import logging
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner, Result

from lanenet.cli.app import app
from lanenet.config import models_in
from lanenet.data.drives import open_drive
from lanenet.data.drives.folder import DriveWriter
from lanenet.errors import CalibrationError, ConfigError
from lanenet.onboard.actuators import PCA9685Settings
from lanenet.onboard.arming import HoldFile
from lanenet.onboard.bench import LANE_WIDTH_CM, example_camera, example_frames
from lanenet.onboard.cameras.replay import ReplaySettings
from lanenet.onboard.car_file import PATHS, with_full_paths
from lanenet.onboard.drive import DriveSettings, build_loop, load_drive_settings
from lanenet.onboard.safety import State


@pytest.fixture
def car(tmp_path: Path) -> Path:
    """A config that replays a painted drive at full speed, with the lane filter."""
    camera = example_camera()
    with DriveWriter(tmp_path / "drive", camera, LANE_WIDTH_CM) as writer:
        for k, frame in enumerate(example_frames(camera, 24, np.random.default_rng(0))):
            writer.add(frame, 0.05 * k, throttle=0.2)
    config = {
        "source": {"kind": "replay", "path": str(tmp_path / "drive"), "pace": "fast"},
        "camera": str(tmp_path / "drive" / "camera.yaml"),
        "detector": {"kind": "lane-filter", "lane_width_cm": LANE_WIDTH_CM},
        "control": {"steering": {"look_ahead_cm": 20.0}},
        # On a busy machine a frame may be old before it is answered.
        "safety": {"countdown_s": 0.0, "max_age_s": 0.5},
    }
    path = tmp_path / "car.yaml"
    path.write_text(yaml.safe_dump(config))
    return path


def drive(*words: str | Path) -> Result:
    return CliRunner().invoke(app, ["drive", *(str(word) for word in words)])


def test_the_wheelbase_is_the_cameras_unless_the_settings_say(car: Path) -> None:
    assert load_drive_settings(car).control.steering.wheelbase_cm == example_camera().wheelbase_cm == 26.0
    given = load_drive_settings(car, ["control.steering.wheelbase_cm=17.5"])
    assert given.control.steering.wheelbase_cm == 17.5
    with pytest.raises(ConfigError, match=r"'control\.steering\.wheelbase_cm' is missing"):
        load_drive_settings(car, ["camera=null"])
    with pytest.raises(CalibrationError, match=r"nowhere\.yaml"):
        load_drive_settings(car, ["camera=nowhere.yaml"])


def path_fields(schema: Any, prefix: str = "") -> Iterator[tuple[str, str | None]]:
    """Keys of a schema that hold a path, with their defaults."""
    for name, field in schema.model_fields.items():
        if Path in (field.annotation, *get_args(field.annotation)):
            yield f"{prefix}{name}", None if field.is_required() or not field.default else str(field.default)
        for nested in models_in(field.annotation):
            yield from path_fields(nested, f"{prefix}{name}.")


def test_every_path_of_a_car_counts_from_its_file() -> None:
    assert dict(path_fields(DriveSettings)) == PATHS


def test_paths_count_from_the_file_and_those_of_overrides_from_here(
    car: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = yaml.safe_load(car.read_text())
    config["source"]["path"], config["camera"] = "drive", "./drive/../drive/camera.yaml"
    config["detector"]["mask"], config["recording"] = "/of/all.png", {}
    config["actuator"] = {"kind": "pca9685", "myconfig": "mycar/myconfig.py"}
    car.write_text(yaml.safe_dump(config))
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    for name in (car, Path("..") / car.name):
        settings = load_drive_settings(name)
        assert isinstance(settings.source, ReplaySettings) and settings.source.path == tmp_path / "drive"
        assert settings.camera == tmp_path / "drive" / "camera.yaml"
        assert settings.detector.mask == Path("/of/all.png")
        assert isinstance(settings.actuator, PCA9685Settings)
        assert settings.actuator.myconfig == tmp_path / "mycar" / "myconfig.py"
        assert settings.recording is not None and settings.recording.folder == tmp_path / "drives"
    given = load_drive_settings(car, ["source.path=tub", "recording.folder=kept"])
    assert isinstance(given.source, ReplaySettings) and given.source.path == Path("tub")
    assert given.recording is not None and given.recording.folder == Path("kept")
    # What is of a wrong type is refused by its key, as before.
    with pytest.raises(ConfigError, match="key 'camera'"):
        car.write_text(yaml.safe_dump({**config, "camera": 3}))
        load_drive_settings(car)
    monkeypatch.setenv("HOME", str(tmp_path))
    assert with_full_paths({"camera": "~/camera.yaml"}, car)["camera"] == str(tmp_path / "camera.yaml")
    assert with_full_paths({"detector": {"model": "hf:a/b"}}, car)["detector"]["model"] == "hf:a/b"
    assert with_full_paths({"source": [1], "actuator": None}, car) == {"source": [1], "actuator": None}


@pytest.mark.parametrize("words", [("--hold", "key"), ("--arm", "--hold-fresh", "1")])
def test_a_hold_that_holds_nothing_is_refused(car: Path, words: tuple[str, ...]) -> None:
    result = drive(car, "actuator={kind: recorder}", *words)
    assert result.exit_code == 1 and "--hold" in result.output


@pytest.mark.parametrize(
    ("override", "told"),
    [
        ("safety.watchdog_s=5", "safety.watchdog_s"),
        ("limits.max_throttle=1.5", "limits.max_throttle"),
        ("source.kind=webcam", "source"),
        ("saftey.countdown_s=1", "did you mean 'safety'"),
        ("control=3", "control"),
    ],
)
def test_a_wrong_setting_is_named(car: Path, override: str, told: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_drive_settings(car, [override])
    assert told in str(caught.value) and "car.yaml" in str(caught.value)


def test_options_that_contradict_each_other_are_refused(car: Path) -> None:
    settings = load_drive_settings(car)
    with pytest.raises(ConfigError, match="expected one of"):
        build_loop(settings, arm=True, dry_run=True)
    with pytest.raises(ConfigError, match="'actuator' is missing"):
        build_loop(settings, arm=True)


@pytest.mark.parametrize("kind", ["pca9685", "serial"])
def test_a_car_with_a_motor_does_not_follow_a_recording(car: Path, kind: str) -> None:
    settings = load_drive_settings(car, [f"actuator={{kind: {kind}}}"])
    with pytest.raises(ConfigError, match=r"found 'replay' \(.*drive\) for an armed car"):
        build_loop(settings, arm=True)
    # The wheels alone may follow it, and so may a car on a box.
    build_loop(settings, steering_only=True)
    build_loop(load_drive_settings(car, [f"actuator={{kind: {kind}}}", "source.may_drive=true"]), arm=True)


def test_a_device_that_is_missing_is_named_before_the_first_frame(car: Path) -> None:
    result = drive(car, "source.path=nowhere", "--dry-run")
    assert result.exit_code == 1
    assert "ended: HardwareError before the first frame: replay: nowhere: no such drive" in result.stderr


def test_a_dry_run_shows_what_would_be_sent(car: Path) -> None:
    result = drive(car, "--dry-run")
    assert result.exit_code == 0, result.output
    assert "24 frames" in result.output and "driving 100 %" in result.output
    assert "ended: the recording is over" in result.output
    assert f"next: lanenet doctor --config {car}" in result.output


def test_the_log_and_the_live_line_go_to_stderr_and_leave_nothing_behind(car: Path) -> None:
    log = logging.getLogger("lanenet")
    before = (log.level, list(log.handlers))
    result = drive(car, "--dry-run", "--frames", "5")
    assert "INFO driving" in result.stderr and "steering" in result.stderr
    assert "INFO driving" not in result.stdout and "5 frames, as asked" in result.stdout
    assert (log.level, list(log.handlers)) == before


@pytest.mark.parametrize("full", ["stdout", "stderr"])
def test_a_full_disk_under_what_is_said_ends_no_drive(car: Path, full: str) -> None:
    words = [sys.executable, "-m", "lanenet", "drive", str(car), "--dry-run"]
    with Path("/dev/full").open("wb") as disk:
        streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, full: disk}
        done = subprocess.run(words, **streams, check=False, timeout=60)
    assert done.returncode == 0
    assert b"Traceback" not in (done.stderr or b"") and (full == "stdout" or b"24 frames" in done.stdout)


def test_a_car_without_an_actuator_says_what_to_do(car: Path) -> None:
    result = drive(car)
    assert result.exit_code == 1 and "or --dry-run" in result.stderr


def test_an_armed_car_drives_through_its_guard(car: Path) -> None:
    settings = load_drive_settings(car, ["actuator={kind: recorder}"])
    steps = []
    report = build_loop(settings, arm=True, watch=steps.append).run()
    assert report.frames == 24 and not report.by_fault
    # The tenth good frame lets it start.
    assert [step.state for step in steps] == [State.STOPPED] * 9 + [State.DRIVING] * 15
    assert all("not armed" in step.reason for step in steps[:9])
    assert steps[-1].throttle > 0.0
    unarmed = drive(car, "actuator={kind: recorder}")
    assert unarmed.exit_code == 0 and "disarmed 100 %" in unarmed.output
    assert "--steering-only" in unarmed.output


def test_an_armed_car_that_has_to_stop_ends_with_an_error(car: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    held = iter([""] * 40)
    monkeypatch.setattr(HoldFile, "fault", property(lambda _: next(held, "the key is not there")))
    again = ("source.loop=true", "safety.end_after_s=0.2", "safety.allow_repeated_frames=true")
    result = drive(car, "actuator={kind: recorder}", *again, "--arm", "--hold", "key")
    assert result.exit_code == 1
    assert "the car had to stop: not held: the key is not there" in result.stderr


def test_an_armed_car_with_too_few_frames_does_not_start(car: Path) -> None:
    silent = ("source.pace=real", "source.rate_hz=3", "source.loop=false", "safety.end_after_s=0.3")
    result = drive(car, "actuator={kind: recorder}", *silent, "--arm", "--frames", "3")
    assert result.exit_code == 0 and "driving" not in result.output


def test_a_recorded_drive_holds_the_frames_and_what_was_told(car: Path, tmp_path: Path) -> None:
    recording = f"recording={{folder: {tmp_path / 'drives'}, min_free_mb: 0, queue_frames: 100}}"
    result = drive(car, recording, "actuator={kind: recorder}", "--arm")
    assert result.exit_code == 0, result.output
    assert "recorded 24 frames, left out 0" in result.output and "next: lanenet map" in result.output
    (path,) = (tmp_path / "drives").iterdir()
    recorded = open_drive(path)
    assert len(recorded) == 24 and recorded.problems == ()
    assert recorded.commands.throttle is not None and recorded.commands.throttle.max() > 0.0
    assert recorded.commands.steering_rad is not None and np.ptp(recorded.commands.steering_rad) > 0.0
    assert recorded.camera is not None and recorded.camera.hash == example_camera().hash


def test_a_dry_run_records_no_commands(car: Path, tmp_path: Path) -> None:
    recording = f"recording={{folder: {tmp_path / 'drives'}, min_free_mb: 0, queue_frames: 100}}"
    assert drive(car, recording, "--dry-run").exit_code == 0
    (path,) = (tmp_path / "drives").iterdir()
    commands = open_drive(path).commands
    assert commands.throttle is None and commands.steering_rad is None
