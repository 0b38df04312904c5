"""Labels of drives that change lanes, or come back the other way, against the truth: from drive to labels."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen.pipeline import MapRequest, MapSettings, map_drive
from datagen.world.simulate import simulate_drive
from datagen.world.world import SimulationSettings
from lanenet.data.drives import open_drive, read_truth
from lanenet.data.drives.folder import DriveWriter
from lanenet.data.maps.mapped_drive import open_mapped_drive, read_map_frames
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.lane import POINT_NAMES

CAMERA = {"width": 160, "height": 120, "field_of_view_rad": math.radians(120.0), "height_cm": 17.0}
LANE_CM = 40.0


def simulated(folder: Path, seed: int, frames: int, track: dict[str, Any], driver: dict[str, Any]) -> Path:
    settings = {"seed": seed, "frames": frames, "camera": CAMERA, "track": track, "driver": driver}
    return simulate_drive(SimulationSettings.model_validate(settings), folder)


def true_points(drive: Path) -> np.ndarray:
    truth = read_truth(drive)
    assert truth is not None
    return np.stack([truth[name] for name in POINT_NAMES], axis=1)


def labelled(points_cm: np.ndarray) -> np.ndarray:
    """The points that the network's window holds."""
    return np.array([BirdseyeWindow().labelled(row) for row in points_cm])


def check(error: np.ndarray, truth: np.ndarray, rmse_cm: float, share: float) -> None:
    assert np.sqrt(np.nanmean(error**2)) < rmse_cm
    assert np.isfinite(error).sum() / np.isfinite(truth).sum() > share


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "direction"), [(4, "forward"), (5, "backward")])
def test_labels_before_during_and_after_changes_of_lane(tmp_path, seed, direction):
    track = {"lanes": 2, "lane_width_cm": LANE_CM, "interruptions_per_m": 0.0}
    driver = {"change_lanes_every_cm": 300.0, "direction": direction}
    drive = simulated(tmp_path / "drive", seed, 300, track, driver)
    map_drive(MapRequest(drive, LANE_CM), MapSettings(), tmp_path / "map")
    found = read_map_frames(tmp_path / "map")
    exact = true_points(drive)[found.frames]
    truth = labelled(exact)
    error = found.points_cm - truth
    # The other lane is to the left of the own one, whose line on the left is line 0.
    lane = open_mapped_drive(tmp_path / "map").drive_map.lanes.lane
    labelled_at = np.flatnonzero(np.diff(lane)) + 1
    assert lane[0] == 0 and lane[labelled_at].tolist() == [-1, 0]
    # The true lines jump by a lane's width where the middle of the front axle crosses the line between.
    true_at = np.flatnonzero(np.abs(np.diff(exact[:, 1])) > 0.6 * LANE_CM) + 1
    assert len(true_at) == 2
    # Labels change lanes when the car is clearly over the line: a tenth of the lane further.
    late = labelled_at - true_at
    assert (late >= 0).all() and (late <= 8).all()
    between = np.zeros(len(error), dtype=bool)
    near = np.zeros(len(error), dtype=bool)
    for begin, end in zip(true_at, labelled_at, strict=True):
        between[begin:end] = True
        near[max(begin - 20, 0) : end + 20] = True
    # In between, they are the lines of the lane that the car is leaving: a lane's width aside.
    if between.any() and np.isfinite(error[between]).any():
        assert np.nanmedian(np.abs(error[between])) == pytest.approx(LANE_CM, abs=8.0)
    check(error[~near], truth[~near], 0.5, 0.95)
    check(error[near & ~between], truth[near & ~between], 0.8, 0.85)


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "direction"), [(4, "forward"), (5, "backward")])
def test_an_edge_of_the_road_without_paint_is_masked(tmp_path, seed, direction):
    """Two lanes, dashes between them, and nothing on one side of the road: its left, or its right there."""
    track = {"lanes": 2, "lane_width_cm": LANE_CM, "interruptions_per_m": 0.0, "far": {"kind": "none"}}
    driver = {"change_lanes_every_cm": 300.0, "direction": direction}
    drive = simulated(tmp_path / "drive", seed, 300, track, driver)
    map_drive(MapRequest(drive, LANE_CM), MapSettings(), tmp_path / "map")
    found = read_map_frames(tmp_path / "map")
    exact = true_points(drive)[found.frames]
    error = found.points_cm - labelled(exact)
    there, back = np.flatnonzero(np.abs(np.diff(exact[:, 1])) > 0.6 * LANE_CM) + 1
    frame = np.arange(len(error))
    inside = (np.abs(frame - there) > 10) & (np.abs(frame - back) > 10)
    other = inside & (frame >= there) & (frame < back)
    own = inside & ~other
    # Driven backward, the side without paint is on the right of the driver's own lane.
    bare_lane, painted_lane, bare = (
        (other, own, slice(0, 3)) if direction == "forward" else (own, other, slice(3, 6))
    )
    assert not np.isfinite(found.points_cm[bare_lane, bare]).any()
    check(error[painted_lane], labelled(exact)[painted_lane], 0.5, 0.9)
    dashes = np.delete(error[bare_lane], np.arange(6)[bare], axis=1)
    truth = np.delete(labelled(exact)[bare_lane], np.arange(6)[bare], axis=1)
    check(dashes, truth, 0.5, 0.95)


@pytest.mark.slow
def test_labels_of_a_road_driven_both_ways(tmp_path):
    """There, a pause, and back on the same road: the dashed line is on the left, and then on the right."""
    track = {"left": {"kind": "dashed"}, "right": {"kind": "solid"}, "interruptions_per_m": 0.0}
    ways = [simulated(tmp_path / way, 6, 160, track, {"direction": way}) for way in ("forward", "backward")]
    both = tmp_path / "both"
    with DriveWriter(both, camera=open_drive(ways[0]).camera, lane_width_cm=LANE_CM) as writer:
        for k, way in enumerate(ways):
            drive, truth = open_drive(way), read_truth(way)
            assert truth is not None and drive.commands.speed_cm_s is not None
            for i in range(len(drive)):
                writer.add(
                    drive.image(i),
                    float(drive.t_s[i]) + 60.0 * k,
                    truth={name: float(values[i]) for name, values in truth.items() if name != "frame"},
                    speed_cm_s=float(drive.commands.speed_cm_s[i]),
                )
    report = map_drive(MapRequest(both, LANE_CM), MapSettings(), tmp_path / "map")
    assert report.figures["segments"] == 2
    found = read_map_frames(tmp_path / "map")
    truth = labelled(true_points(both)[found.frames])
    error = found.points_cm - truth
    segment = open_mapped_drive(tmp_path / "map").drive_map.segment
    assert np.bincount(segment).min() > 120
    for part in (segment == 0, segment == 1):
        check(error[part], truth[part], 0.5, 0.95)
