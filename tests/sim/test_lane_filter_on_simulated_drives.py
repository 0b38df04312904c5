"""The lane filter against the exact truth of simulated drives, beside the plain filter of the paper."""

from __future__ import annotations

import logging

import numpy as np
import pytest
from synthetic_roads import frames_of

from datagen.world.world import SimulationSettings, build_world
from lanenet.perception.edges.road import PerceptionSettings, RoadEdgeExtractor
from lanenet.perception.lane_filter import PAPER, LaneFilter, LaneFilterSettings

pytestmark = pytest.mark.slow
LOG = logging.getLogger(__name__)


def test_fewer_wrong_lanes_than_the_papers_and_as_many_answers() -> None:
    errors: dict[str, list[np.ndarray]] = {"paper": [], "checked": []}
    for seed in (1, 2, 3):
        world = build_world(SimulationSettings(seed=seed, frames=300))
        extractor = RoadEdgeExtractor(world.camera, PerceptionSettings())
        filters = {
            "paper": LaneFilter(extractor, LaneFilterSettings(lane_width_cm=40.0, **PAPER)),
            "checked": LaneFilter(extractor, LaneFilterSettings(lane_width_cm=40.0)),
        }
        for frame in frames_of(world):
            for name, lane_filter in filters.items():
                errors[name].append(lane_filter.detect(frame.image_bgr).points_cm - frame.points_cm)
    figures = {name: figures_of(np.array(values)) for name, values in errors.items()}
    for name, (median, rmse, p95, answered) in figures.items():
        LOG.warning(
            "%s: median %.2f, RMSE %.2f, p95 %.2f cm, %.3f answered", name, median, rmse, p95, answered
        )
    assert figures["checked"][1] < 0.5 * figures["paper"][1]
    assert figures["checked"][1] < 1.5
    assert figures["checked"][3] >= figures["paper"][3]


def figures_of(error_cm: np.ndarray) -> tuple[float, float, float, float]:
    known = np.isfinite(error_cm)
    size = np.abs(error_cm[known])
    rmse = float(np.sqrt(np.mean(size**2)))
    return float(np.median(size)), rmse, float(np.percentile(size, 95.0)), float(known.mean())
