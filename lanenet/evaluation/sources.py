"""Labels opened from drives, maps and label sets, for detectors to be compared on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from lanenet.config import read_yaml
from lanenet.errors import DriveFormatError
from lanenet.perception.network.model_file import without_model

if TYPE_CHECKING:
    from lanenet.data.label_set import LabelSet
    from lanenet.data.maps.labelled_frames import LabelledFrames
    from lanenet.geometry.birdseye import BirdseyeWindow
    from lanenet.perception.edges.road import PerceptionSettings


#: Makes a label set from a simulated drive, given the settings of its edges and the window.
TruthReader = Callable[[Path, "PerceptionSettings | None", "BirdseyeWindow | None"], "LabelSet"]


@dataclass(frozen=True)
class Opened:
    """A source of labels.

    Attributes:
        path: Where it lies.
        content: A label set, which holds edge points only, or frames with labels.
        beside: The label set of the frames, if there is one: it knows which lines can be seen.
    """

    path: Path
    content: LabelSet | LabelledFrames
    beside: LabelSet | None = None

    @property
    def frames(self) -> LabelledFrames | None:
        """The frames, if the source has any."""
        from lanenet.data.maps.labelled_frames import LabelledFrames

        return self.content if isinstance(self.content, LabelledFrames) else None

    @property
    def labels(self) -> LabelSet | None:
        """The label set, if there is one."""
        from lanenet.data.label_set import LabelSet

        return self.content if isinstance(self.content, LabelSet) else self.beside

    @property
    def drive(self) -> Path:
        """The recording: the source itself, or the drive that a map was made of."""
        file = self.path / "map.yaml"
        return Path(read_yaml(file)["drive"]) if file.is_file() else self.path

    @property
    def lane_width_cm(self) -> float:
        """Between the middles of the lane's two lines."""
        from lanenet.data.label_set import LabelSet

        content = self.content
        return content.meta.lane_width_cm if isinstance(content, LabelSet) else content.lane_width_cm


def open_source(
    path: Path,
    window: BirdseyeWindow,
    perception: PerceptionSettings | None,
    read_truth_labels: TruthReader,
) -> Opened:
    """Open a label set, a map folder or a simulated drive.

    Args:
        path: Where it lies.
        window: Points of drives and maps beside this bird's-eye window have no label.
        perception: How the edges of a simulated drive's label set are found; None takes the defaults.
        read_truth_labels: Reads the label set of a simulated drive from its truth
            (:func:`datagen.labels.truth.truth_labels`).

    Raises:
        LanenetError: If it is none of these, or cannot be read.
    """
    from lanenet.data.label_set import read_labels

    if not path.exists():
        raise DriveFormatError(f"{path}: no such model or source")
    if path.is_file():
        return Opened(path, read_labels(path))
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


def _open_frames(path: Path, window: BirdseyeWindow) -> LabelledFrames:
    """Open a map folder or a simulated drive."""
    if (path / "map.yaml").is_file():
        from lanenet.data.maps.labelled_frames import read_map_frames

        return read_map_frames(path, window)
    from lanenet.data.maps.labelled_frames import read_truth_frames

    return read_truth_frames(path, window)


def _as_labelled(frames: LabelledFrames, labels: LabelSet) -> LabelledFrames:
    """Frames with the points of their label set, which leaves out what no frame can tell."""
    from lanenet.evaluation.conditions import at_frames

    return replace(frames, points_cm=at_frames(labels.points_cm, labels.frame, frames.frames))


def open_tests(labels: Sequence[Path], frames: Sequence[Path]) -> list[Opened]:
    """Open the test part of a training run, from frames where they are still there.

    Args:
        labels: Label sets.
        frames: For each label set the simulated drive or the map that it was made of.

    Raises:
        LanenetError: If one cannot be read.
    """
    from lanenet.data.label_set import read_labels

    sources = []
    for labels_path, frames_path in zip(labels, frames, strict=True):
        label_set = read_labels(labels_path)
        opened = Opened(labels_path, label_set)
        if frames_path.is_dir():
            whole = _open_frames(frames_path, label_set.meta.window)
            # A recorded drive was cut along its time; the network has learned from its first part.
            part = whole.numbered(int(label_set.frame[0]), int(label_set.frame[-1]))
            meta = label_set.meta
            # As wherever the other detectors look at frames, they look at gray.
            part = replace(part, perception=meta.perception.with_colours(0.0), marking_cm=meta.marking_cm)
            opened = Opened(frames_path, _as_labelled(part, label_set), label_set)
        sources.append(opened)
    return sources
