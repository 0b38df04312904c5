"""Frames of texture are no road for the Hough tracker, by hue or by brightness; lanes still are."""

from __future__ import annotations

import functools
from pathlib import Path

import cv2
import numpy as np
import pytest
from textured_frames import GENERATORS
from typer.testing import CliRunner

from lanenet.cli import app as cli
from lanenet.config import load_settings
from lanenet.onboard.bench import example_camera, example_frames
from lanenet.perception.hough.detector import HoughSettings, HoughTracker

SHIPPED_FILE = Path(__file__).resolve().parents[3] / "configs" / "detectors" / "hough_value.yaml"
SETTINGS = {
    "hue": HoughSettings(),
    "value": HoughSettings.model_validate({"edges": {"channel": "value"}}),
    "shipped": load_settings(HoughSettings, SHIPPED_FILE),
}
#: What the paper has none of, switched off.
PAPER = HoughSettings.model_validate(
    {
        "edges": {"min_saturation": 0, "min_value": 0, "max_rough_share": 1.0},
        "lines": {
            "by_sign": False,
            "min_support": 0.0,
            "crowded_length_px": 0.0,
            "max_vanishing_share": None,
            "middle": False,
        },
        "steering": {"max_jump_px": None, "hold_frames": None},
    }
)
SEEDS = range(20)


@functools.cache
def frames(name: str, height: int, width: int) -> list[np.ndarray]:
    return [GENERATORS[name](np.random.default_rng(seed), height, width) for seed in SEEDS]


def invented(settings: HoughSettings, name: str, height: int, width: int) -> list[int]:
    """Seeds whose frame shows the tracker a line."""
    found = []
    for seed, frame in zip(SEEDS, frames(name, height, width), strict=True):
        estimate = HoughTracker(None, settings).detect(frame)
        if estimate.confidence > 0.0 or np.isfinite(estimate.steering_rad):
            found.append(seed)
    return found


@pytest.mark.parametrize("size", [(240, 320), (120, 160)], ids=["320x240", "160x120"])
@pytest.mark.parametrize("name", GENERATORS)
@pytest.mark.parametrize("settings", SETTINGS)
def test_a_texture_is_no_lane(settings: str, name: str, size: tuple[int, int]) -> None:
    assert invented(SETTINGS[settings], name, *size) == []


@pytest.mark.parametrize("name", ["blocks", "blurred_noise", "jpeg_noise", "sticks"])
def test_the_papers_plain_behaviour_invents_lanes(name: str) -> None:
    assert len(invented(PAPER, name, 240, 320)) > len(SEEDS) // 2


@pytest.mark.parametrize("settings", ["value", "shipped"])
def test_lanes_in_noisy_frames_are_still_found(settings: str) -> None:
    camera = example_camera()
    tracker = HoughTracker(camera, SETTINGS[settings])
    for frame in example_frames(camera, 20, np.random.default_rng(1)):
        tracker.reset()
        assert tracker.detect(frame).confidence == 1.0


def test_detect_prints_the_hint_where_the_hue_shows_nothing(tmp_path: Path) -> None:
    camera = example_camera()
    source, out = tmp_path / "photo.png", tmp_path / "lanes.csv"
    # The gray of the floor, and a white line on each side: no hue.
    gray = example_frames(camera, 1, np.random.default_rng(1))[0][..., 1]
    cv2.imwrite(str(source), gray)
    words = ["detect", str(source), "--detector", "hough", "--out", str(out)]
    result = CliRunner().invoke(cli.app, words)
    assert result.exit_code == 0, result.output
    assert "hint: hough steers in 0 of 1 frames" in " ".join(result.output.split())
    helped = CliRunner().invoke(cli.app, [*words, "--config", str(SHIPPED_FILE)])
    assert helped.exit_code == 0 and "hint:" not in helped.output
