"""A new detector is one module and one line: what is in the registry appears everywhere."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from lanenet.errors import ConfigError
from lanenet.onboard.bench import example_camera
from lanenet.perception.estimate import DetectorInputs
from lanenet.perception.registry import (
    KINDS,
    build_detector,
    build_on_edges,
    compared_names,
    detector_names,
    kind_of,
    usual_names,
)

#: Registers a detector before the command line is built, as the line in the registry does.
FAKE = """
from lanenet.config import Settings
from lanenet.perception import registry
from lanenet.perception.estimate import DetectorKind
from lanenet.perception.estimate import LaneEstimate

class Fake:
    def detect(self, frame_bgr): return LaneEstimate(confidence=0.25)
    def reset(self): pass

class FakeSettings(Settings):
    gain: float = 1.0

registry.KINDS["fake"] = DetectorKind(
    "fake", lambda inputs: Fake(), settings=FakeSettings, needs_camera=False, takes_mask=True,
    variants={"fake-twice": {"gain": 2.0}},
)

import sys
from pathlib import Path
from typer.testing import CliRunner
from lanenet.cli.app import app
from lanenet.config import check_settings
from lanenet.evaluation.answers import choose_names
from lanenet.onboard.bench import example_camera, time_paths
from lanenet.onboard.drive import DriveDetectorSettings

def run(*words):
    result = CliRunner().invoke(app, list(words), env={"COLUMNS": "1000", "TERM": "dumb"})
    assert result.exit_code == 0, result.output
    return result.output

out = Path(sys.argv[1])
detect = run("detect", "--help")
assert "|fake" in detect, detect
assert "hough, painter and fake need none" in detect and "hough, painter or fake" in detect
assert "for network, lane-filter and fake:" in detect
assert "fake, fake-twice" in run("val", "--help")
assert "painter and fake also as NAME=SETTINGS.yaml" in (judge := run("judge", "--help"))
assert "hough-value,painter,fake" in judge
assert all("fake" in paths for paths in time_paths(example_camera(), rounds=1).values())
assert choose_names("fake-twice,fake") == ("fake", "fake-twice")
assert check_settings(DriveDetectorSettings, {"kind": "fake"}, "test").kind == "fake"
run("detect", sys.argv[2], "--detector", "fake", "--out", str(out / "f.csv"))
assert ",0.25" in (out / "f.csv").read_text()
"""


def test_a_new_detector_appears_everywhere(tmp_path: Path) -> None:
    import cv2

    cv2.imwrite(str(tmp_path / "photo.png"), np.zeros((60, 80, 3), np.uint8))
    words = [sys.executable, "-c", FAKE, str(tmp_path), str(tmp_path / "photo.png")]
    result = subprocess.run(words, capture_output=True, text=True, timeout=120, check=False)
    assert result.returncode == 0, result.stderr


def test_the_order_of_tables_and_help() -> None:
    assert list(KINDS) == ["network", "lane-filter", "hough", "painter"]
    assert usual_names() == ["network", "lane-filter", "hough", "hough-value", "painter"]
    assert compared_names() == ["network", "network-single", "lane-filter", "hough", "hough-value", "painter"]
    assert compared_names(lambda kind: kind.on_label_sets)[::2] == ["network", "lane-filter"]
    assert detector_names(lambda kind: not kind.needs_camera) == ["hough", "painter"]


def test_a_variant_is_the_detector_with_its_settings() -> None:
    assert kind_of("hough-value") is kind_of("hough")
    built = build_detector("hough-value", DetectorInputs(camera=example_camera()))
    assert built.settings.edges.channel == "value"  # type: ignore[attr-defined]
    shipped = Path(__file__).resolve().parents[3] / "configs/detectors/hough_value.yaml"
    same = build_detector("hough", DetectorInputs(camera=example_camera(), config=shipped))
    assert built.settings == same.settings  # type: ignore[attr-defined]


def test_what_does_not_exist_or_needs_frames_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"'eagle'.*hough-value"):
        build_detector("eagle", DetectorInputs())
    with pytest.raises(ConfigError, match="detector painter"):
        build_on_edges("painter", DetectorInputs(lane_width_cm=40.0))
    with pytest.raises(ConfigError, match="--model"):
        build_detector("network", DetectorInputs(camera=example_camera()))
