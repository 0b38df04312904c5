"""Label sets from a simulator's truth: for scoring, never for training."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lanenet.data.drive import open_drive, read_truth
from lanenet.data.label_set import LabelMeta, LabelSet
from lanenet.errors import DriveFormatError
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.lane import POINT_NAMES
from lanenet.perception.birdseye import PerceptionSettings, RoadEdgeExtractor


def truth_labels(
    drive_path: Path,
    perception: PerceptionSettings | None = None,
    window: BirdseyeWindow | None = None,
    marking_cm: float | None = None,
) -> LabelSet:
    """Make a label set from a simulator's truth, for scoring.

    Args:
        drive_path: Simulated drive.
        perception: How edge points are found; None takes the defaults.
        window: The network's window; None takes the default.
        marking_cm: Width of the markings, if known.

    Raises:
        DriveFormatError: If the drive has no truth, or no camera or lane width.
    """
    drive, truth = open_drive(drive_path), read_truth(drive_path / "truth.csv")
    if truth is None or drive.camera is None or drive.lane_width_cm is None:
        raise DriveFormatError(f"{drive_path}: expected a simulated drive with truth, camera and lane width")
    perception = PerceptionSettings() if perception is None else perception
    extractor = RoadEdgeExtractor(drive.camera, perception)
    edges = []
    for i in range(len(drive)):
        road = extractor.extract(drive.image(i))
        edges.append(np.concatenate([road.points_cm, road.normals], axis=1).astype(np.float32))
    n = len(drive)
    window = BirdseyeWindow() if window is None else window
    nothing = np.empty((0, 2))
    return LabelSet(
        meta=LabelMeta(
            window=window,
            camera_hash=drive.camera.hash,
            wheelbase_cm=drive.camera.wheelbase_cm,
            lane_width_cm=drive.lane_width_cm,
            source="truth",
            perception=perception,
            marking_cm=marking_cm,
        ),
        drive=[drive.name] * n,
        file=[""] * n,
        frame=drive.frames,
        t_s=drive.t_s,
        lap=np.zeros(n, dtype=np.int64),
        poses=np.stack([truth["x_cm"], truth["y_cm"], truth["heading_rad"]], axis=1),
        points_cm=window.labelled(np.stack([truth[name] for name in POINT_NAMES], axis=1)),
        edges=edges,
        lines=[(nothing, nothing)] * n,
        quality=np.ones(n),
    )
