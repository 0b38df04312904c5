"""``lanenet calibrate drive``: what it asks for, writes, shows and says to run next."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner, Result

import datagen.calibrate_drive
from datagen.calibrate_drive import CalibratedDrive
from datagen.settings import MapSettings
from lanenet.cli import app as cli
from lanenet.config import read_yaml
from lanenet.data.camera_file import read_camera, write_camera
from lanenet.data.drives import open_drive
from lanenet.data.drives.folder import DriveWriter
from lanenet.errors import CalibrationError
from lanenet.onboard.bench import example_camera, example_frames

SIGMA = {
    **dict.fromkeys(("focal_px", "cx_px", "cy_px", "ahead_of_front_axle_cm", "height_cm"), 0.5),
    **dict.fromkeys(("k1", "pitch_down_rad", "roll_rad", "yaw_rad"), 0.01),
}


def run(*words: str | Path) -> Result:
    return CliRunner().invoke(cli.app, [str(word) for word in words], env={"COLUMNS": "200"})


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    with DriveWriter(tmp_path / "tub") as writer:
        for k, frame in enumerate(example_frames(example_camera(), 3, np.random.default_rng(1))):
            writer.add(frame, 0.05 * k, truth=None)
    return tmp_path / "tub"


@pytest.fixture
def asked(drive: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What the command hands on to the calibration, which is made up here."""
    calls: dict[str, Any] = {}
    result = CalibratedDrive(
        example_camera(),
        SIGMA,
        ("made up",),
        "a method",
        500,
        28,
        0.18,
        40.0,
        (0, 2),
        open_drive(drive),
    )

    def calibrate(*args: Any, **options: Any) -> CalibratedDrive:
        calls["args"], calls["options"] = args, options
        if "error" in calls:
            raise calls["error"]
        return result

    monkeypatch.setattr(datagen.calibrate_drive, "calibrate_drive", calibrate)
    return calls


def test_it_writes_camera_and_pictures_and_says_what_is_next(tmp_path, drive, asked):
    out = tmp_path / "camera.yaml"
    result = run("calibrate", "drive", drive, "--lane-width", "40", "--wheelbase", "25.5", "--out", out)
    assert result.exit_code == 0, result.output
    assert asked["args"][:4] == (drive, 40.0, None, None)
    assert asked["args"][4].guess.wheelbase_cm == 25.5
    assert asked["options"] == {"accept_open_loop": False}
    assert read_camera(out).hash == example_camera().hash
    data = read_yaml(out)
    assert data["method"] == "a method" and data["date"]
    figures = data["residuals"]
    assert figures["focal_sigma_px"] == 0.5 and figures["pitch_down_sigma_rad"] == 0.01
    assert figures["k1_sigma"] == 0.01 and figures["frames_count"] == 500.0
    for what, columns in (("undistorted", 2 * example_camera().width), ("birdseye", 2 * 480)):
        picture = cv2.imread(str(tmp_path / f"camera-{what}.png"))
        assert picture is not None and picture.shape[1] == columns
    pitch = np.rad2deg(example_camera().mounting.pitch_down_rad)
    for text in ("focal length", f"{pitch:.2f}", "0.57", "28 places seen twice", "0.18 px", f"wrote {out}"):
        assert text in result.stdout
    assert f"next: lanenet map {drive} --lane-width 40 --camera {out} --out MAP" in result.stdout
    assert "warning: made up" in result.stderr and "wheelbase" not in result.stderr


def test_a_camera_to_refine_is_read_and_handed_on(tmp_path, drive, asked):
    start = tmp_path / "start.yaml"
    write_camera(start, example_camera(), "made up")
    words = ("calibrate", "drive", drive, "--camera", start, "--out", tmp_path / "camera.yaml")
    refused = run(*words)
    assert refused.exit_code == 1 and "add --refine" in refused.stderr and "args" not in asked
    result = run(*words, "--refine", "--wheelbase", "30", "--accept-open-loop", "--camera-height", "18")
    assert result.exit_code == 0, result.output
    _, width, height, camera, settings = asked["args"][:5]
    assert (width, height) == (None, 18.0) and asked["options"] == {"accept_open_loop": True}
    assert camera.hash == example_camera().hash and camera.wheelbase_cm == 30.0
    assert settings == MapSettings(guess=settings.guess)
    assert "--lane-width LANE_WIDTH" in result.stdout


def test_what_is_nominal_is_said(tmp_path, drive, asked):
    result = run("calibrate", "drive", drive, "--lane-width", "40", "--out", tmp_path / "camera.yaml")
    assert "the wheelbase is a nominal 17 cm" in result.stderr
    # A drive that knows its camera keeps it, and the command says so.
    with DriveWriter(tmp_path / "known", camera=example_camera()) as writer:
        writer.add(np.zeros((example_camera().height, example_camera().width, 3), np.uint8), 0.0, truth=None)
    words = ("calibrate", "drive", tmp_path / "known", "--lane-width", "40", "--out", tmp_path / "c.yaml")
    assert "camera of its own" in run(*words).stderr
    assert asked["args"][3] is None
    assert run(*words, "--refine").exit_code == 0
    assert replace(asked["args"][3]).hash == example_camera().hash


def test_a_refusal_is_one_line_and_nothing_is_written(tmp_path, drive, asked):
    asked["error"] = CalibrationError("tub: too straight")
    out = tmp_path / "camera.yaml"
    result = run("calibrate", "drive", drive, "--lane-width", "40", "--out", out)
    assert result.exit_code == 1 and "error: tub: too straight" in result.stderr.splitlines()
    assert not out.exists()
    assert "ends in .yaml" in run("calibrate", "drive", drive, "--out", tmp_path / "c.txt").stderr
