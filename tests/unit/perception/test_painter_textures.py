"""The painter invents no lane in frames of texture, and still finds the lane that is painted over one."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from textured_frames import GENERATORS

from lanenet.perception.painter.detector import LanePainter, PainterSettings

SIZES = ((240, 320), (120, 160))
SEEDS = 20
PLAIN = PainterSettings.model_validate({"mode": "photo", "evidence": {"required": False}})


@pytest.mark.parametrize("mode", ["photo", "video"])
@pytest.mark.parametrize("name", GENERATORS)
def test_a_texture_is_no_lane(name: str, mode: str) -> None:
    for height, width in SIZES:
        painter = LanePainter(None, PainterSettings.model_validate({"mode": mode}))
        for seed in range(SEEDS):
            frame = GENERATORS[name](np.random.default_rng(seed), height, width)
            estimate = painter.detect(frame)
            assert estimate.confidence == 0.0 and np.isnan(estimate.steering_rad), (height, seed)


@pytest.mark.parametrize("name", ["sticks", "salt"])
def test_a_standing_texture_is_no_lane_either(name: str) -> None:
    # What is invented once would be confirmed by every frame that follows.
    painter = LanePainter()
    frame = GENERATORS[name](np.random.default_rng(1), 240, 320)
    assert all(painter.detect(frame).confidence == 0.0 for _ in range(5))


def test_without_evidence_textures_are_lanes_as_with_the_papers_method() -> None:
    painter = LanePainter(None, PLAIN)
    frames = (GENERATORS["sticks"](np.random.default_rng(seed), 240, 320) for seed in range(SEEDS))
    assert sum(painter.detect(frame).confidence > 0.0 for frame in frames) >= 10


@pytest.mark.parametrize("dashed", [False, True])
@pytest.mark.parametrize("size", SIZES)
def test_a_road_is_a_lane(size: tuple[int, int], dashed: bool) -> None:
    height, width = size
    frame = np.full((height, width, 3), 70, np.uint8)
    # From the region's bottom towards a common point above its top.
    far = np.array([0.5 * width, 0.55 * height])
    for bottom in (0.12 * width, 0.88 * width):
        near = np.array([bottom, 0.98 * height])
        pieces = ((0.0, 0.35), (0.5, 0.68), (0.78, 0.9)) if dashed and bottom < 0.5 * width else ((0.0, 1.0),)
        for start, stop in pieces:
            ends = [near + share * (far - near) for share in (start, stop)]
            half = [0.014 * width * (1.0 - share) + 0.5 for share in (start, stop)]
            corners = [
                ends[0] - [half[0], 0],
                ends[0] + [half[0], 0],
                ends[1] + [half[1], 0],
                ends[1] - [half[1], 0],
            ]
            cv2.fillConvexPoly(frame, np.rint(corners).astype(np.int32), (235, 235, 235))
    painter = LanePainter(None, PainterSettings(mode="photo"))
    assert painter.detect(frame).confidence == 1.0
    assert painter.last.left_px is not None and painter.last.right_px is not None
    for line, bottom in ((painter.last.left_px, 0.12 * width), (painter.last.right_px, 0.88 * width)):
        v = line[0, 1]
        expected = bottom + (far[0] - bottom) * (0.98 * height - v) / (0.98 * height - far[1])
        assert line[0, 0] == pytest.approx(expected, abs=0.015 * width)
