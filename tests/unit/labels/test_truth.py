"""Label sets of a simulator's truth."""

from __future__ import annotations

import numpy as np

from datagen.labels.truth import truth_labels
from datagen.world.car.camera import CameraSettings
from datagen.world.car.driver import DriverSettings
from datagen.world.road.track_settings import TrackSettings
from datagen.world.simulate import simulate_drive
from datagen.world.world import SimulationSettings
from lanenet.data.drives import read_truth
from lanenet.data.label_set import write_labels
from lanenet.evaluation.answers import Compared
from lanenet.evaluation.comparison import evaluate
from lanenet.evaluation.sources import open_source, open_tests
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.perception.edges.road import PerceptionSettings


def _truth_of(tmp_path, driver: DriverSettings, seed: int):
    settings = SimulationSettings(
        seed=seed,
        frames=90,
        camera=CameraSettings(width=160, height=120),
        track=TrackSettings(lanes=2, lane_width_cm=40.0),
        driver=driver,
        random_look=False,
    )
    simulate_drive(settings, tmp_path / "drive")
    truth = read_truth(tmp_path / "drive" / "truth.csv")
    assert truth is not None
    return truth_labels(tmp_path / "drive"), truth


def test_on_the_line_between_two_lanes_there_are_no_labels(tmp_path):
    driver = DriverSettings(
        speed_cm_s=100.0, wander_cm=0.0, change_lanes_every_cm=160.0, lane_change_cm=150.0
    )
    labels, truth = _truth_of(tmp_path, driver, 3)
    hidden = np.isnan(labels.points_cm).all(axis=1)
    # From either lane the line between them is the one that the front axle is nearer to.
    away_cm = np.minimum(np.abs(truth["left_0_cm"]), np.abs(truth["right_0_cm"]))
    assert 2 <= hidden.sum() <= 10
    assert away_cm[hidden].max() < 2.3 and away_cm[~hidden].min() > 1.8
    # The line between the lanes is on the left of the right one, and on the right of the left one.
    assert {tuple(row) for row in labels.divides.tolist()} == {(True, False), (False, True)}
    nearer_left = np.abs(truth["left_0_cm"]) < np.abs(truth["right_0_cm"])
    near = ~hidden & (away_cm < 10.0)
    assert near.sum() >= 4
    np.testing.assert_array_equal(labels.divides[near, 0], nearer_left[near])
    # Points lie on the lines of the lane that they name, also in the other one.
    for k in np.flatnonzero(~hidden):
        left, right = labels.lines[k]
        for line, x_cm in ((left, labels.points_cm[k, 0]), (right, labels.points_cm[k, 3])):
            if np.isfinite(x_cm):
                assert np.hypot(line[:, 0] - x_cm, line[:, 1]).min() < 2.0


def test_a_swerve_into_the_other_lane_has_no_labels(tmp_path):
    driver = DriverSettings(
        style="recover", speed_cm_s=100.0, wander_cm=0.0, recover_cm=27.0, recover_every_cm=200.0
    )
    swerved = 0
    for seed in range(4):
        labels, truth = _truth_of(tmp_path / str(seed), driver, seed)
        hidden = np.isnan(labels.points_cm).all(axis=1)
        # The truth names the lane on the right throughout; its left line is that between the two.
        np.testing.assert_array_equal(hidden, -truth["left_0_cm"] < 2.0)
        swerved += int((truth["left_0_cm"] > 2.0).sum())
    assert swerved > 5


def test_what_is_scored_is_what_the_labels_name(tmp_path):
    driver = DriverSettings(
        speed_cm_s=100.0, wander_cm=0.0, change_lanes_every_cm=160.0, lane_change_cm=150.0
    )
    labels, _ = _truth_of(tmp_path, driver, 3)
    write_labels(tmp_path / "labels.parquet", labels)
    (source,) = open_tests([tmp_path / "labels.parquet"], [tmp_path / "drive"])
    seen = PerceptionSettings().with_colours()
    opened = open_source(tmp_path / "drive", BirdseyeWindow(), seen, truth_labels)
    assert opened.labels is not None and opened.labels.meta.perception == seen
    assert np.isnan(labels.points_cm).all(axis=1).any()
    for found in (source.frames, opened.frames):
        assert found is not None
        np.testing.assert_array_equal(found.points_cm, labels.points_cm)
    table = evaluate([source], Compared(["lane-filter"]))[0].as_dict()["detectors"]["lane-filter"]
    # What the car would make of the answers stands beside the other conditions.
    groups = table["conditions"]["confidence"]
    assert list(groups) == ["under 0.2", "0.2 to 0.5", "over 0.5"]
    assert sum(group["count"] for group in groups.values()) == table["groups"]["all"]["count"] > 0
