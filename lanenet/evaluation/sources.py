"""Labelled sources, on which detectors are compared: drives, maps and label sets."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from lanenet.config import read_yaml
from lanenet.errors import DriveFormatError
from lanenet.perception.network.model_file import without_model

if TYPE_CHECKING:
    from lanenet.data.label_set import LabelSet
    from lanenet.data.maps.mapped_drive import LabelledFrames
    from lanenet.geometry.birdseye import BirdseyeWindow
    from lanenet.perception.edges.road import PerceptionSettings


#: Makes a label set from a simulated drive, given the settings of its edges and the window.
TruthReader = Callable[[Path, "PerceptionSettings | None", "BirdseyeWindow | None"], "LabelSet"]


@dataclass(frozen=True)
class Opened:
    """A source of labels.

    Attributes:
        path: Where it lies.
        frames: Frames with labels, if it has any.
        labels: The label set, if there is one. Beside frames it says which lines can be seen.
    """

    path: Path
    frames: LabelledFrames | None = None
    labels: LabelSet | None = None

    @property
    def drive(self) -> Path:
        """The recording: the source itself, or the drive that a map was made from."""
        file = self.path / "map.yaml"
        return Path(read_yaml(file)["drive"]) if file.is_file() else self.path

    @property
    def without_camera(self) -> str:
        """What a label set lacks for networks if it does not hold its camera; empty if nothing."""
        if self.frames is not None or self.labels is None or self.labels.meta.camera is not None:
            return ""
        return (
            f"{self.path}: holds no camera, so that a network answers each frame alone, less exactly than on "
            "the car; lanenet label MAP makes a label set with its camera"
        )

    @property
    def lane_width_cm(self) -> float:
        """Between the middles of the lane's two lines."""
        if self.frames is not None:
            return self.frames.lane_width_cm
        assert self.labels is not None
        return self.labels.meta.lane_width_cm


def open_source(
    path: Path,
    window: BirdseyeWindow | None,
    perception: PerceptionSettings | None,
    read_truth_labels: TruthReader,
) -> Opened:
    """Open a label set, a map folder or a simulated drive.

    Args:
        path: Where it lies.
        window: Points outside this bird's-eye window have no label; None takes that of the label set, or the
            default.
        perception: How the edges of a simulated drive's label set are found; None takes the defaults.
        read_truth_labels: Reads the label set of a simulated drive from its truth
            (:func:`datagen.labels.truth.truth_labels`).

    Raises:
        LanenetError: If it is none of these, or cannot be read.
    """
    from lanenet.data.drives import meant_instead
    from lanenet.data.label_set import read_labels

    if not path.exists():
        raise DriveFormatError(f"{path}: no such model or source{meant_instead(path)}")
    if path.is_file():
        labels = read_labels(path)
        return Opened(path, labels=labels if window is None else labels.in_window(window))
    _check_folder(path)
    frames = _open_frames(path, window)
    if frames.reference == "map":
        return Opened(path, frames)
    labels = read_truth_labels(path, perception, window)
    return Opened(path, _as_labelled(frames, labels), labels)


def _check_folder(path: Path) -> None:
    """Refuse a folder that holds neither a drive nor a map."""
    from lanenet.data.drives import find_format, formats_text

    if find_format(path) is None and not (path / "map.yaml").is_file():
        raise DriveFormatError(
            f"{path}: not a drive, map or model: expected {formats_text()}, or a map (map.yaml), and "
            f"{without_model(path)}"
        )


def _open_frames(path: Path, window: BirdseyeWindow | None) -> LabelledFrames:
    """Open a map folder or a simulated drive."""
    from lanenet.data.maps.mapped_drive import read_map_frames, read_truth_frames

    return (read_map_frames if (path / "map.yaml").is_file() else read_truth_frames)(path, window)


def _as_labelled(frames: LabelledFrames, labels: LabelSet) -> LabelledFrames:
    """Return frames with the points of their label set, which masks what no frame can show."""
    return replace(frames, points_cm=at_frames(labels.points_cm, labels.frame, frames.frames))


def open_tests(labels: Sequence[Path], frames: Sequence[Path]) -> list[Opened]:
    """Open the test part of a training run, with its frames where they still exist.

    Args:
        labels: Label sets.
        frames: For each label set the simulated drive or the map that it was made from.

    Raises:
        LanenetError: If one cannot be read.
    """
    from lanenet.data.label_set import read_labels

    sources = []
    for labels_path, frames_path in zip(labels, frames, strict=True):
        label_set = read_labels(labels_path)
        opened = Opened(labels_path, labels=label_set)
        if frames_path.is_dir():
            whole = _open_frames(frames_path, label_set.meta.window)
            # Only the part of a recorded drive that the network has not learned from.
            part = whole.numbered(int(label_set.frame[0]), int(label_set.frame[-1]))
            meta = label_set.meta
            # The other detectors use brightness alone, as they do everywhere.
            part = replace(part, perception=meta.perception.with_colours(0.0), marking_cm=meta.marking_cm)
            opened = Opened(frames_path, _as_labelled(part, label_set), label_set)
        sources.append(opened)
    return sources


def lines_seen(labels: LabelSet) -> Float[np.ndarray, "n 2"]:
    """Return whether each frame's raster shows the left and the right line: 1, 0, or NaN for unknown."""
    from lanenet.samples.augment import join_frames, plain_batch

    frames = join_frames(labels.edges, labels.lines, labels.points_cm)
    return plain_batch(frames, np.arange(len(labels)), labels.meta.window).present.astype(np.float64)


def distance_to_training_cm(labels: LabelSet, training: Sequence[LabelSet]) -> Float[np.ndarray, "n"]:
    """Return the distance of each frame to the nearest training frame of the same map, [cm].

    Two label sets are of one map, see :func:`of_one_map`, if their drives have the same name, their cameras
    are the same and both take their labels from a map. NaN where no training frame is of this map, or of
    this segment of it.
    """
    from lanenet.data.segments import map_segments

    same = [other for other in training if of_one_map(labels, other)]
    parts = [*same, labels]
    frames, poses = (np.concatenate([getattr(part, name) for part in parts]) for name in ("frame", "poses"))
    learned = np.arange(len(frames)) < len(frames) - len(labels)
    order = np.argsort(frames, kind="stable")
    segments = np.empty(len(frames), np.int64)
    segments[order] = map_segments(frames[order], poses[order])
    result = np.full(len(labels), np.nan)
    for segment in np.unique(segments[~learned]):
        mine = segments[~learned] == segment
        result[mine] = nearest_pose_cm(labels.poses[mine], poses[learned & (segments == segment)])
    return result


def of_one_map(labels: LabelSet, other: LabelSet) -> bool:
    """Tell whether two label sets are parts of one recording and its map."""
    return (
        labels.meta.source == other.meta.source == "map"
        and labels.meta.camera_hash == other.meta.camera_hash
        and labels.drive[:1] == other.drive[:1]
    )


def nearest_pose_cm(
    poses: Float[np.ndarray, "n 3"], training_poses: Float[np.ndarray, "m 3"]
) -> Float[np.ndarray, "n"]:
    """Return the distance of each pose to the nearest training pose, [cm]; headings do not count."""
    if not len(training_poses):
        return np.full(len(poses), np.nan)
    squares = [((training_poses[:, :2] - pose[:2]) ** 2).sum(axis=1).min() for pose in poses]
    return np.sqrt(np.array(squares, np.float64))


def at_frames(
    values: Float[np.ndarray, "n *k"], frames: Int[np.ndarray, "n"], wanted: Int[np.ndarray, "m"]
) -> Float[np.ndarray, "m *k"]:
    """Return the values of frames by their numbers; NaN for a number without a value.

    Args:
        values: A row per frame.
        frames: Numbers of the rows, increasing.
        wanted: Numbers to look up.
    """
    result = np.full((len(wanted), *values.shape[1:]), np.nan)
    if len(frames):
        row = np.minimum(np.searchsorted(frames, wanted), len(frames) - 1)
        found = frames[row] == wanted
        result[found] = values[row[found]]
    return result
