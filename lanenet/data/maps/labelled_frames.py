"""Frames with the six labels that they should give: what detectors are compared on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from lanenet.data.drives import open_drive
from lanenet.data.drives.folder import TRUTH_FILE, read_truth
from lanenet.data.label_set import Source
from lanenet.data.maps.mapped_drive import label_frames, open_mapped_drive
from lanenet.errors import DriveFormatError, LabelFormatError
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.camera import Camera
from lanenet.geometry.lane import POINT_NAMES
from lanenet.perception.edges.road import PerceptionSettings


@dataclass(frozen=True, eq=False)
class LabelledFrames:
    """The frames of a drive, read on demand, with their labels.

    Frames without a label are included: a detector with a memory has to see them, as on the car.

    Attributes:
        name: The path, for messages.
        reference: ``truth`` for a simulator's labels, ``map`` for labels from a map made of the drive.
        camera: Camera of the frames.
        lane_width_cm: Between the middles of the lane's two lines.
        marking_cm: Width of the markings; None if unknown.
        perception: How edge points are found in these frames.
        frames: Frame numbers, increasing.
        starts: True where a frame does not continue the one before.
        points_cm: The six labels of each frame, frame car; NaN where there is none.
        image: Reads frame i (by position); DriveFormatError naming the file if it cannot.
    """

    name: str
    reference: Source
    camera: Camera
    lane_width_cm: float
    marking_cm: float | None
    perception: PerceptionSettings
    frames: Int[np.ndarray, "n"]
    starts: Bool[np.ndarray, "n"]
    points_cm: Float[np.ndarray, "n 6"]
    image: Callable[[int], UInt8[np.ndarray, "h w 3"]] = field(repr=False)

    def __len__(self) -> int:
        return len(self.frames)

    def numbered(self, first: int, last: int) -> LabelledFrames:
        """Return the frames with numbers from first to last, both included.

        Raises:
            LabelFormatError: If there is none.
        """
        rows = np.flatnonzero((self.frames >= first) & (self.frames <= last))
        if not rows.size:
            raise LabelFormatError(f"{self.name}: no frame from {first} to {last}")
        return replace(
            self,
            frames=self.frames[rows],
            starts=self.starts[rows],
            points_cm=self.points_cm[rows],
            image=partial(_image_at, self.image, rows),
        )


def _image_at(
    read: Callable[[int], UInt8[np.ndarray, "h w 3"]], rows: Int[np.ndarray, "n"], i: int
) -> UInt8[np.ndarray, "h w 3"]:
    """Read the image of row ``rows[i]``; at module level, so that it can be pickled."""
    return read(int(rows[i]))


def read_truth_frames(path: Path, window: BirdseyeWindow | None = None) -> LabelledFrames:
    """Read a simulated drive with its ground truth.

    Args:
        path: Drive folder with ``truth.csv``.
        window: Points outside this bird's-eye window have no label, as in label sets; None takes the default.

    Raises:
        DriveFormatError: If the drive has no truth, camera or lane width, or the truth does not have
            one row for each frame.
    """
    drive, truth = open_drive(path), read_truth(path)
    if truth is None or drive.camera is None or drive.lane_width_cm is None:
        missing = {TRUTH_FILE: truth, "a camera": drive.camera, "a lane width": drive.lane_width_cm}
        raise DriveFormatError(
            f"{path}: comes without {' and '.join(name for name, part in missing.items() if part is None)}, "
            "expected a simulated drive; for labels of another drive map it, and give the map"
        )
    if not np.array_equal(truth["frame"], drive.frames):
        raise DriveFormatError(
            f"{path / TRUTH_FILE}: {len(truth['frame'])} rows for {len(drive)} frames, or rows of other "
            "frames; expected a row for each frame"
        )
    window = BirdseyeWindow() if window is None else window
    starts = drive.breaks.copy()
    starts[0] = True
    return LabelledFrames(
        name=str(path),
        reference="truth",
        camera=drive.camera,
        lane_width_cm=drive.lane_width_cm,
        marking_cm=None,
        perception=PerceptionSettings(),
        frames=drive.frames,
        starts=starts,
        points_cm=window.labelled(np.stack([truth[name] for name in POINT_NAMES], axis=1)),
        image=drive.image,
    )


def read_map_frames(
    map_folder: Path, window: BirdseyeWindow | None = None, drive_path: Path | None = None
) -> LabelledFrames:
    """Read the frames of a mapped drive with their labels.

    The labels are those of :func:`datagen.labels.label_map.label_map`; frames without a label are kept.

    Args:
        map_folder: Folder of the map.
        window: Points outside this bird's-eye window have no label; None takes the default.
        drive_path: Where the drive is now, if it has moved since it was mapped.

    Raises:
        LanenetError: As :func:`open_mapped_drive`.
    """
    mapped = open_mapped_drive(map_folder, drive_path)
    drive, drive_map, rows = mapped.drive, mapped.drive_map, mapped.rows
    window = BirdseyeWindow() if window is None else window
    return LabelledFrames(
        name=str(map_folder),
        reference="map",
        camera=drive_map.camera,
        lane_width_cm=drive_map.meta.lane_cm,
        marking_cm=drive_map.meta.tape_cm,
        perception=mapped.perception,
        frames=drive_map.frames,
        starts=mapped.starts,
        points_cm=label_frames(mapped, window).points_cm,
        image=partial(_image_at, drive.image, rows),
    )
