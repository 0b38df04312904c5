"""Texture without a road is no lane for the lane filter, and a lane on a textured floor still is one."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
from textured_frames import GENERATORS

from lanenet.geometry.camera import Camera
from lanenet.onboard.bench import LANE_WIDTH_CM, example_camera, example_frames
from lanenet.perception.edges.canny import EdgeSettings
from lanenet.perception.edges.road import PerceptionSettings, RoadEdgeExtractor
from lanenet.perception.estimate import Detector, DetectorInputs
from lanenet.perception.lane_filter import PAPER, LaneFilter, LaneFilterSettings
from lanenet.perception.registry import build_detector

SIZES = {"320x240": 1.0, "160x120": 0.5}


def camera(scale: float) -> Camera:
    base = example_camera()
    K = base.K * scale
    K[:2, 2] = (base.K[:2, 2] + 0.5) * scale - 0.5
    K[2, 2] = 1.0
    size = (round(scale * base.width), round(scale * base.height))
    return dataclasses.replace(base, width=size[0], height=size[1], K=K)


@functools.cache
def detector(size: str, lane_width_cm: float) -> Detector:
    return build_detector(
        "lane-filter", DetectorInputs(camera=camera(SIZES[size]), lane_width_cm=lane_width_cm)
    )


# A narrow lane is found by chance more easily than a wide one; two parallel strokes that far apart are one.
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("name", GENERATORS)
def test_texture_is_no_lane(name: str, size: str) -> None:
    width, height = map(int, size.split("x"))
    for seed in range(20):
        frame = GENERATORS[name](np.random.default_rng(seed), height, width)
        for lane_width_cm in (LANE_WIDTH_CM,) if name == "sticks" else (18.0, 23.0, LANE_WIDTH_CM):
            filter_ = detector(size, lane_width_cm)
            filter_.reset()
            estimate = filter_.detect(frame)
            assert not estimate.mask.any() and estimate.confidence == 0.0, (seed, lane_width_cm)
            assert np.isnan(estimate.steering_rad)


def test_the_papers_filter_finds_lanes_in_texture() -> None:
    # Why the checks are there; without this the test above could pass on an empty table of the road.
    extractor = RoadEdgeExtractor(camera(1.0), PerceptionSettings(edges=EdgeSettings(method="canny")))
    plain = LaneFilter(extractor, LaneFilterSettings(lane_width_cm=LANE_WIDTH_CM, **PAPER))
    found = [
        plain.detect(GENERATORS["gray_blocks"](np.random.default_rng(seed), 240, 320)).confidence > 0.0
        for seed in range(5)
    ]
    assert any(found)


@pytest.mark.parametrize("size", SIZES)
def test_painted_lanes_are_found(size: str) -> None:
    cam = camera(SIZES[size])
    frames = example_frames(cam, 12, np.random.default_rng(3))
    estimates = [detector(size, LANE_WIDTH_CM).detect(frame) for frame in frames]
    width = np.array([e.points_cm[[4, 5]] - e.points_cm[[1, 2]] for e in estimates])
    assert np.isfinite(width[:, 0]).all()
    # In the small image the far row's markings are three pixels wide, and some are off their thickness.
    assert np.isfinite(width[:, 1]).mean() >= (1.0 if size == "320x240" else 0.5)
    assert np.nanmax(np.abs(width - LANE_WIDTH_CM)) < 1.0
