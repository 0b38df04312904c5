"""Label sets from a simulator's ground truth, for evaluation only."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Bool

from datagen.world.road.track import read_track
from lanenet.data.drives import open_drive, read_truth
from lanenet.data.label_set import LabelMeta, LabelSet
from lanenet.errors import DriveFormatError
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.frames import map_from_car
from lanenet.geometry.lane import BESIDE_DIVIDER_LANES, POINT_NAMES, SIDES
from lanenet.perception.edges.road import PerceptionSettings, RoadEdgeExtractor

#: Spacing of a line's points, as in labels from a map (:mod:`lanenet.data.maps.frame_lines`).
_SAMPLE_CM = 2.0


def truth_labels(
    drive_path: Path,
    perception: PerceptionSettings | None = None,
    window: BirdseyeWindow | None = None,
    marking_cm: float | None = None,
) -> LabelSet:
    """Make a label set from a simulator's ground truth.

    As with a map, frames on the line between two lanes have no labels. Unlike a map, the ground truth does
    not take the road beyond an outer dashed line for a lane.

    Args:
        drive_path: Simulated drive.
        perception: How edge points are found; None takes the defaults.
        window: The network's window; None takes the default.
        marking_cm: Width of the markings; None if unknown.

    Raises:
        DriveFormatError: If the drive has no ground truth, camera or lane width.
    """
    drive, truth = open_drive(drive_path), read_truth(drive_path / "truth.csv")
    if truth is None or drive.camera is None or drive.lane_width_cm is None:
        raise DriveFormatError(f"{drive_path}: expected a simulated drive with truth, camera and lane width")
    perception = PerceptionSettings() if perception is None else perception
    extractor = RoadEdgeExtractor(drive.camera, perception)
    edges = []
    for i in range(len(drive)):
        road = extractor.extract(drive.image(i))
        edges.append(road.rows())
    n = len(drive)
    window = BirdseyeWindow() if window is None else window
    poses = np.stack([truth["x_cm"], truth["y_cm"], truth["heading_rad"]], axis=1)
    lines, between, divides = true_lines(drive_path, truth, drive.camera.wheelbase_cm)
    points_cm = window.labelled(np.stack([truth[name] for name in POINT_NAMES], axis=1))
    points_cm[between] = np.nan
    return LabelSet(
        meta=LabelMeta(
            window=window,
            camera_hash=drive.camera.hash,
            wheelbase_cm=drive.camera.wheelbase_cm,
            lane_width_cm=drive.lane_width_cm,
            source="truth",
            perception=perception,
            marking_cm=marking_cm,
            camera_cm=drive.camera.mounting.at_cm,
            camera=drive.camera,
        ),
        drive=[drive.name] * n,
        file=[""] * n,
        frame=drive.frames,
        t_s=drive.t_s,
        lap=np.zeros(n, dtype=np.int64),
        poses=poses,
        points_cm=points_cm,
        edges=edges,
        lines=lines,
        quality=np.ones(n),
        divides=divides,
    )


def true_lines(
    drive_path: Path, truth: dict[str, np.ndarray], wheelbase_cm: float
) -> tuple[list[tuple[np.ndarray, np.ndarray]], Bool[np.ndarray, "n"], Bool[np.ndarray, "n 2"]]:
    """Return the lines of each frame's lane, and where the other lane is.

    Args:
        drive_path: Simulated drive; without a road there are no lines.
        truth: Its ground truth, see :func:`lanenet.data.drives.read_truth`.
        wheelbase_cm: Distance between the axles.

    Returns:
        The lines, sampled like those of a map; which frames are not clearly inside their lane on the side of
        the other one; and whether the other lane is beyond the left, beyond the right line.
    """
    poses = np.stack([truth["x_cm"], truth["y_cm"], truth["heading_rad"]], axis=1)
    between = np.zeros(len(poses), dtype=bool)
    divides = np.zeros((len(poses), len(SIDES)), dtype=bool)
    if not (drive_path / "track.json").is_file():
        nothing = np.empty((0, 2))
        return [(nothing, nothing)] * len(poses), between, divides
    track = read_track(drive_path / "track.json")
    other_cm = track.oncoming_cm
    every = max(1, round(_SAMPLE_CM / track.step_cm))
    lines = []
    place: float | None = None
    for k, pose in enumerate(poses):
        # Where two sections of the road are close, the car is on the one that it was on before.
        front = map_from_car(np.zeros((1, 2)), pose, wheelbase_cm)[0]
        place, offset_cm = track.nearest(front, place)
        lane_cm = 0.0
        if other_cm is not None:
            to_centre_cm = 0.5 * (truth["left_0_cm"][k] + truth["right_0_cm"][k])
            in_other = (offset_cm - to_centre_cm) / other_cm > 0.5
            lane_cm = other_cm if in_other else 0.0
            # Distance of the front axle's middle beyond the line between the lanes, in lane widths.
            beyond_lanes = offset_cm / other_cm - 0.5
            between[k] = (beyond_lanes if in_other else -beyond_lanes) < BESIDE_DIVIDER_LANES
            divides[k, 0 if (other_cm > 0.0) != in_other else 1] = True
        left, right = track.lines_car(pose, wheelbase_cm, place, lane_cm)
        lines.append((left[::every], right[::every]))
    return lines, between, divides
