"""The shipped networks on fresh simulated drives: how exact they are, and better than each other detector."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from synthetic_roads import frames_of

from datagen.world.world import SimulationSettings, build_world
from lanenet.evaluation.comparison import SourceAnswers, compare_detectors
from lanenet.evaluation.tables import as_markdown
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.perception.estimate import DetectorInputs
from lanenet.perception.network.model_file import find_model
from lanenet.perception.registry import build_detector

pytestmark = pytest.mark.slow
LOG = logging.getLogger(__name__)
CHECKPOINTS = Path(__file__).resolve().parents[2] / "checkpoints"
NETWORKS = ("small", "general")
OTHERS = ("lane-filter", "hough-value", "painter")

#: Of roads that no training and no choice has seen.
SEEDS = (910_241, 910_242, 910_243)
FRAMES = 100
#: Upper bounds of the median and the RMSE over the labels, and of the p95 over all points, [cm].
BOUNDS_CM = {"small": (0.2, 0.8, 1.6), "general": (0.4, 1.5, 3.0)}


def drive(seed: int) -> SourceAnswers:
    """Answers of all detectors to a drive on a road of its own."""
    world = build_world(SimulationSettings(seed=seed, frames=FRAMES))
    settings = world.settings.track
    inputs = DetectorInputs(camera=world.camera, lane_width_cm=settings.lane_width_cm, any_camera=True)
    detectors = {
        name: build_detector("network", replace(inputs, model=find_model(CHECKPOINTS / name)))
        for name in NETWORKS
    } | {name: build_detector(name, inputs) for name in OTHERS}
    truth, answers = [], {name: [] for name in detectors}
    for frame in frames_of(world):
        truth.append(frame.points_cm)
        for name, detector in detectors.items():
            answers[name].append(detector.detect(frame.image_bgr).points_cm)
    points = {name: np.array(found) for name, found in answers.items()}
    labels_cm = BirdseyeWindow().labelled(np.array(truth))
    return SourceAnswers(str(seed), "simulated drive", "truth", labels_cm, points, all_cm=np.array(truth))


def test_they_are_exact_and_beat_each_other_detector_where_both_answer() -> None:
    sources = [drive(seed) for seed in SEEDS]
    for network in NETWORKS:
        names = (network, *OTHERS)
        found = compare_detectors(
            [replace(source, answers_cm={n: source.answers_cm[n] for n in names}) for source in sources]
        )
        LOG.warning("%s", as_markdown(found))
        own, whole = found.tables[network].all, found.whole[network].all
        most = BOUNDS_CM[network]
        assert own.coverage > 0.97, network
        assert own.median_cm < most[0] and own.rmse_cm < most[1], network
        assert whole.p95_cm < most[2], network
        for name, rows in found.shared_rows.items():
            for group, pair in rows.items():
                assert pair.own.count > 50 and pair.first.rmse_cm < pair.own.rmse_cm, (network, name, group)
