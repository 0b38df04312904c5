"""Label sets of a simulator's truth."""

from __future__ import annotations

import numpy as np

from datagen.labels.truth import truth_labels
from datagen.world.driver import DriverSettings
from datagen.world.rig import CameraSettings
from datagen.world.simulate import SimulationSettings, simulate_drive
from datagen.world.track_settings import TrackSettings
from lanenet.data.drive import read_truth


def test_on_the_line_between_two_lanes_there_are_no_labels(tmp_path):
    driver = DriverSettings(
        speed_cm_s=100.0, wander_cm=0.0, change_lanes_every_cm=160.0, lane_change_cm=150.0
    )
    settings = SimulationSettings(
        seed=3,
        frames=90,
        camera=CameraSettings(width=64, height=48),
        track=TrackSettings(lanes=2, lane_width_cm=40.0),
        driver=driver,
        random_look=False,
    )
    simulate_drive(settings, tmp_path / "drive")
    labels, truth = truth_labels(tmp_path / "drive"), read_truth(tmp_path / "drive" / "truth.csv")
    assert truth is not None
    hidden = np.isnan(labels.points_cm).all(axis=1)
    # From either lane the line between them is the one that the front axle is nearer to.
    away_cm = np.minimum(np.abs(truth["left_0_cm"]), np.abs(truth["right_0_cm"]))
    assert 2 <= hidden.sum() <= 10
    assert away_cm[hidden].max() < 2.3 and away_cm[~hidden].min() > 1.8
