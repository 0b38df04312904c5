"""``lanenet settings``: every key of every file, with what it takes."""

from __future__ import annotations

import builtins
import os
import subprocess
import sys
from typing import Any

import pytest
from typer.testing import CliRunner

from lanenet.cli.app import app
from lanenet.cli.schemas import files_on_the_car, sections
from lanenet.config import load_settings


def said(*words: str) -> str:
    result = CliRunner().invoke(app, ["settings", *words])
    assert result.exit_code == 0, result.output
    return result.stdout


def test_a_key_is_said_with_type_unit_range_default_and_meaning() -> None:
    text = said("control.speed.cruise_cm_s")
    assert "control.speed.cruise_cm_s  number, cm/s, > 0; default 60.0\n      Speed on a straight." in text
    assert text.startswith("lanenet drive CONFIG") and "In a Donkeycar: lanenet.yaml" in text
    assert "least_cm_s" not in text
    # A section, the end of a key, and a word.
    assert "control.speed.least_cm_s" in said("control.speed")
    assert "learn.epochs  whole number, ≥ 1; default 12" in said("epochs")
    assert "safety.watchdog_s  number, s" in said("watchdog")
    assert "actuator.bus (kind: pca9685)" in said("actuator.bus")
    # A section that stands in two places is found in both.
    assert "data.drives.map.find_bumper" in said("find_bumper") and "  data.map.find_bumper" in said(
        "find_bumper"
    )


def test_without_a_key_a_cars_file_and_a_config_are_said_in_full() -> None:
    text = said()
    drive = files_on_the_car()["drive"]
    for section in sections(drive):
        for setting in section.settings:
            key = f"{section.key}.{setting.name}" if section.key else setting.name
            assert setting.nested or f"  {key}" in text, key
    assert "  data.drives.lane_width_cm  number, cm; required" in text and "simulate" not in text


def test_the_file_beside_a_recording_is_said() -> None:
    assert said("topics").startswith("In a recording: drive.yaml\n  topics  list of text")
    text = said("drive.yaml")
    assert "\n  notes  text\n" in text
    assert (
        "lane_width_cm  number or null, cm" in text
        and "max_steering_rad" in text
        and "lanenet drive" not in text
    )


def test_a_reader_that_has_enough_is_no_error() -> None:
    read, write = os.pipe()
    os.close(read)
    words = [sys.executable, "-m", "lanenet", "settings"]
    done = subprocess.run(words, stdout=write, stderr=subprocess.PIPE, text=True, timeout=100)
    os.close(write)
    assert (done.returncode, done.stderr) == (0, "")


def test_an_unknown_key_is_refused_with_the_nearest() -> None:
    result = CliRunner().invoke(app, ["settings", "epohcs"])
    assert result.exit_code == 1 and "did you mean 'epochs'?" in result.stderr


def test_what_is_said_can_be_set(tmp_path: Any) -> None:
    file = tmp_path / "car.yaml"
    file.write_text("source: {kind: replay, path: tub}\ncontrol: {steering: {wheelbase_cm: 26}}\n")
    drive = files_on_the_car()["drive"]
    assert load_settings(drive, file, ["control.speed.cruise_cm_s=61"]).control.speed.cruise_cm_s == 61.0


def test_on_the_car_its_own_files_are_said(monkeypatch: pytest.MonkeyPatch) -> None:
    there = builtins.__import__

    def imported(name: str, *more: Any) -> Any:
        if name.startswith("datagen"):
            raise ModuleNotFoundError("No module named 'numba'", name="numba")
        return there(name, *more)

    monkeypatch.setattr(builtins, "__import__", imported)
    result = CliRunner().invoke(app, ["settings", "cruise_cm_s"])
    assert result.exit_code == 0 and "control.speed.cruise_cm_s" in result.stdout
    assert "only the files of the car: numba is not installed" in result.stderr
