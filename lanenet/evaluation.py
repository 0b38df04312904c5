"""Labels opened from drives, maps and label sets, and every detector compared on them.

Knows ``datagen``, ``lanenet.learn`` and ``lanenet.onboard``, as the command line does, and imports them only
where they are needed: the car has neither SciPy nor PyArrow.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lanenet.errors import DriveFormatError

if TYPE_CHECKING:
    from lanenet.data.label_set import LabelSet
    from lanenet.data.labelled_frames import LabelledFrames
    from lanenet.geometry.birdseye import BirdseyeWindow
    from lanenet.learn.compare import Comparison, SourceAnswers
    from lanenet.onboard.compare import ComparedName

#: Called with (source, frames done, frames).
Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Opened:
    """A source of labels.

    Attributes:
        path: Where it lies.
        content: A label set, which holds edge points only, or frames with labels.
    """

    path: Path
    content: LabelSet | LabelledFrames

    @property
    def frames(self) -> LabelledFrames | None:
        """The frames, if the source has any."""
        from lanenet.data.labelled_frames import LabelledFrames

        return self.content if isinstance(self.content, LabelledFrames) else None


@dataclass(frozen=True)
class Evaluation:
    """A comparison and its report.

    Attributes:
        comparison: The figures.
        files: Contents of the report by ending: ``.md``, and where they can be made ``.png`` (errors by row)
            and ``-worst.jpg`` (the frames that the first detector got most wrong).
    """

    comparison: Comparison
    files: dict[str, str | bytes]


def open_source(path: Path, window: BirdseyeWindow) -> Opened:
    """Open a label set, a map folder or a simulated drive.

    Args:
        path: Where it lies.
        window: Points of drives and maps beside this bird's-eye window have no label.

    Raises:
        LanenetError: If it is none of these, or cannot be read.
    """
    from lanenet.data.label_set import read_labels
    from lanenet.data.labelled_frames import read_truth_frames

    if not path.exists():
        raise DriveFormatError(f"{path}: no such model or source")
    if path.is_file():
        return Opened(path, read_labels(path))
    if (path / "map.yaml").is_file():
        from datagen.labels.mapped_drive import read_map_frames

        return Opened(path, read_map_frames(path, window))
    return Opened(path, read_truth_frames(path, window))


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
            whole = open_source(frames_path, label_set.meta.window).frames
            assert whole is not None
            # A recorded drive was cut along its time; the network has learned from its first part.
            part = whole.numbered(int(label_set.frame[0]), int(label_set.frame[-1]))
            meta = label_set.meta
            opened = Opened(
                frames_path, replace(part, perception=meta.perception, marking_cm=meta.marking_cm)
            )
        sources.append(opened)
    return sources


def default_names(sources: Sequence[Opened], with_model: bool) -> tuple[ComparedName, ...]:
    """Return the detectors that all sources allow, in the order of the tables."""
    from lanenet.onboard.compare import COMPARED, ON_LABEL_SETS

    possible = COMPARED if all(source.frames is not None for source in sources) else ON_LABEL_SETS
    return tuple(name for name in possible if with_model or name != "network")


def evaluate(
    sources: Sequence[Opened],
    names: Sequence[ComparedName],
    model: Path | None,
    *,
    marking_cm: float | None = None,
    any_camera: bool = False,
    progress: Progress | None = None,
) -> Evaluation:
    """Run detectors over sources and report their errors.

    Args:
        sources: Labelled frames, and label sets if only the network and the lane filter are compared.
        names: Detectors; the first is what the others are held against.
        model: ONNX file of the network.
        marking_cm: Thickness of the tape for the lane filter; None takes the source's, or the default.
        any_camera: Accept a model that was trained with another camera than that of the frames.
        progress: Called with (source, frames done, frames).

    Raises:
        LanenetError: If a source cannot be read or does not fit a detector.
    """
    from lanenet.learn.compare import compare_detectors
    from lanenet.learn.error_picture import error_picture
    from lanenet.learn.error_tables import as_markdown
    from lanenet.onboard.worst_frames import draw_worst, find_worst, jpeg_bytes

    answered = [_answer(s, names, model, marking_cm, any_camera, progress) for s in sources]
    comparison = compare_detectors(answered)
    files: dict[str, str | bytes] = {".md": as_markdown(comparison)}
    picture = error_picture(comparison)
    if picture is not None:
        files[".png"] = picture
    pairs = [(s.frames, a.answers_cm[comparison.first]) for s, a in zip(sources, answered, strict=True)]
    with_frames = [(frames, answer) for frames, answer in pairs if frames is not None]
    if with_frames:
        frames, answers = [pair[0] for pair in with_frames], [pair[1] for pair in with_frames]
        worst = find_worst(frames, answers)
        if worst:
            files["-worst.jpg"] = jpeg_bytes(draw_worst(frames, answers, worst))
    return Evaluation(comparison, files)


def _answer(
    source: Opened,
    names: Sequence[ComparedName],
    model: Path | None,
    marking_cm: float | None,
    any_camera: bool,
    progress: Progress | None,
) -> SourceAnswers:
    from lanenet.learn.compare import SourceAnswers
    from lanenet.onboard.compare import answer_frames, build_compared

    frames, name = source.frames, str(source.path)
    if frames is None:
        labels: Any = source.content
        answers = _answer_labels(labels, names, model, marking_cm)
        return SourceAnswers(name, "label set", labels.meta.source, labels.points_cm, answers)
    detectors = build_compared(names, frames, model=model, marking_cm=marking_cm, any_camera=any_camera)

    def report(done: int, total: int) -> None:
        if progress is not None:
            progress(source.path.name, done, total)

    answers = answer_frames(frames, detectors, report)
    kind = "simulated drive" if frames.reference == "truth" else "map"
    return SourceAnswers(name, kind, frames.reference, frames.points_cm, answers)


def _answer_labels(
    labels: LabelSet, names: Sequence[ComparedName], model: Path | None, marking_cm: float | None
) -> dict[str, Any]:
    from lanenet.learn.evaluate import network_predictor
    from lanenet.onboard.detectors import filter_settings, lane_filter_points_cm

    answers: dict[str, Any] = {}
    for name in names:
        if name == "network":
            assert model is not None
            answers[name] = network_predictor(model)(labels)
        else:
            meta = labels.meta
            settings = filter_settings(meta.lane_width_cm, meta.marking_cm, marking_cm)
            answers[name] = lane_filter_points_cm(labels, settings)
    return answers
