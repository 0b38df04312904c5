"""Every detector compared on labelled sources, and the report of it.

Knows ``datagen``, ``lanenet.learn`` and ``lanenet.onboard``, as the command line does, and imports them only
where they are needed: the car has neither SciPy nor PyArrow.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lanenet.evaluation.sources import Opened

if TYPE_CHECKING:
    from lanenet.data.label_set import LabelSet
    from lanenet.data.maps.labelled_frames import LabelledFrames
    from lanenet.evaluation.answers import FrameAnswers
    from lanenet.evaluation.comparison import Comparison, SourceAnswers
    from lanenet.perception.estimate import Detector

#: Called with (source, frames done, frames).
Progress = Callable[[str, int, int], None]
#: Fewer frames than these are answered sooner than a process has started.
_WORTH_PROCESSES = 600


@dataclass(frozen=True)
class _Entrants:
    """Who answers, in the order of the tables, and how they are built for a source."""

    names: Sequence[str]
    models: Mapping[str, Path]
    marking_cm: float | None
    any_camera: bool

    @property
    def in_order(self) -> list[str]:
        """All detectors; more networks follow the first one."""
        more = [name for name in self.models if name != "network"]
        network = [name for name in self.names if name == "network"]
        return [*network, *more, *(name for name in self.names if name != "network")]


@dataclass(frozen=True)
class Evaluation:
    """A comparison and its report.

    Attributes:
        comparison: The figures.
        files: Contents of the report by ending: ``.md``, and where they can be made ``.png`` (errors by row),
            ``-breakdown.png`` (errors by bend, and how right the doubt is) and ``-worst.jpg`` (the frames
            that the first detector got most wrong).
    """

    comparison: Comparison
    files: dict[str, str | bytes]


def default_names(sources: Sequence[Opened], with_model: bool) -> tuple[str, ...]:
    """Return the detectors that all sources allow, in the order of the tables."""
    from lanenet.perception.registry import compared_names

    with_frames = all(source.frames is not None for source in sources)
    return tuple(
        compared_names(
            lambda kind: (with_frames or kind.on_label_sets) and (with_model or not kind.needs_model)
        )
    )


def evaluate(
    sources: Sequence[Opened],
    names: Sequence[str],
    model: Path | None,
    *,
    also: Mapping[str, Path] | None = None,
    training: Sequence[LabelSet] = (),
    marking_cm: float | None = None,
    any_camera: bool = False,
    workers: int = 1,
    progress: Progress | None = None,
) -> Evaluation:
    """Run detectors over sources and report their errors.

    Args:
        sources: Labelled frames, and label sets if only networks and the lane filter are compared.
        names: Detectors; the first is what the others are held against.
        model: ONNX file of the network.
        also: ONNX files of more networks, by the name that they get in the tables.
        training: What the network has learned from, where it is known: errors are told by the distance from
            it.
        marking_cm: Thickness of the tape for the lane filter; None takes the source's, or the default.
        any_camera: Accept a model that was trained with another camera than that of the frames or labels.
        workers: Processes at a time, where several sources have many frames.
        progress: Called with (source, frames done, frames); of several processes with (what is done, sources
            done, sources).

    Raises:
        LanenetError: If a source cannot be read or does not fit a detector.
    """
    from lanenet.evaluation.comparison import compare_detectors
    from lanenet.evaluation.pictures import (
        breakdown_picture,
        draw_worst,
        error_picture,
        find_worst,
        jpeg_bytes,
    )
    from lanenet.evaluation.tables import as_markdown

    models = {} if model is None else {"network": model}
    models |= also or {}
    entrants = _Entrants(names, models, marking_cm, any_camera)
    all_frames = [s.frames for s in sources if s.frames is not None]
    given = iter(_answer_all(all_frames, entrants, workers, progress))
    answered = [
        _answer_labels(s, entrants, training) if s.frames is None else _describe(s, next(given), training)
        for s in sources
    ]
    comparison = compare_detectors(answered)
    files: dict[str, str | bytes] = {".md": as_markdown(comparison)}
    for ending, picture in ((".png", error_picture), ("-breakdown.png", breakdown_picture)):
        drawn = picture(comparison)
        if drawn is not None:
            files[ending] = drawn
    pairs = [(s.frames, a.answers_cm[comparison.first]) for s, a in zip(sources, answered, strict=True)]
    with_frames = [(frames, answer) for frames, answer in pairs if frames is not None]
    if with_frames:
        frames, answers = [pair[0] for pair in with_frames], [pair[1] for pair in with_frames]
        worst = find_worst(frames, answers)
        if worst:
            files["-worst.jpg"] = jpeg_bytes(draw_worst(frames, answers, worst))
    return Evaluation(comparison, files)


def _answer_all(
    frames: Sequence[LabelledFrames], entrants: _Entrants, workers: int, progress: Progress | None
) -> list[FrameAnswers]:
    """Let all detectors answer all frames, in several processes where that is faster."""
    from lanenet.processes import run_jobs

    if workers == 1 or len(frames) == 1 or sum(map(len, frames)) < _WORTH_PROCESSES:
        return [_answer(each, entrants, progress) for each in frames]
    jobs = [(each.name, each) for each in frames]
    report = None if progress is None else partial(progress, "sources")
    return run_jobs(partial(_answer, entrants=entrants), jobs, workers, report)


def _answer(frames: LabelledFrames, entrants: _Entrants, progress: Progress | None = None) -> FrameAnswers:
    from lanenet.evaluation.answers import answer_frames, build_compared

    detectors: dict[str, Detector] = {}
    for key in entrants.in_order:
        detector = "network" if key in entrants.models else key
        built = build_compared(
            [detector],
            frames,
            model=entrants.models.get(key),
            marking_cm=entrants.marking_cm,
            any_camera=entrants.any_camera,
        )
        detectors[key] = built[detector]
    return answer_frames(
        frames, detectors, None if progress is None else partial(progress, Path(frames.name).name)
    )


def _describe(source: Opened, answers: FrameAnswers, training: Sequence[LabelSet]) -> SourceAnswers:
    """Answers to frames, beside the truth and the conditions that errors are told by."""
    from lanenet.evaluation.comparison import SourceAnswers
    from lanenet.evaluation.conditions import at_frames, lines_seen, way_to_training_cm

    frames, labels = source.frames, source.labels
    assert frames is not None
    first = next(iter(answers.confidence))
    conditions = {"light": answers.brightness, "confidence": answers.confidence[first]}
    visible = None
    if labels is not None:
        visible = at_frames(lines_seen(labels), labels.frame, frames.frames)
        way = way_to_training_cm(labels, training)
        conditions["place"] = at_frames(way, labels.frame, frames.frames)
    return SourceAnswers(
        name=str(source.path),
        kind="simulated drive" if frames.reference == "truth" else "map",
        reference=frames.reference,
        truth_cm=frames.points_cm,
        answers_cm=answers.points_cm,
        sigma_cm=answers.sigma_cm,
        presence=answers.presence,
        visible=visible,
        conditions=conditions,
    )


def _answer_labels(source: Opened, entrants: _Entrants, training: Sequence[LabelSet]) -> SourceAnswers:
    from lanenet.evaluation.answers import answer_edges
    from lanenet.evaluation.comparison import SourceAnswers
    from lanenet.evaluation.conditions import lines_seen, way_to_training_cm
    from lanenet.evaluation.errors import RasterModel
    from lanenet.perception.detector_kind import DetectorInputs
    from lanenet.perception.registry import build_on_edges

    labels = source.labels
    assert labels is not None
    meta = labels.meta
    points: dict[str, Any] = {}
    sigma: dict[str, Any] = {}
    presence: dict[str, Any] = {}
    for key in entrants.in_order:
        if key in entrants.models:
            path = entrants.models[key]
            model = RasterModel(path)
            if not entrants.any_camera:
                model.meta.check_trained_with(meta.camera_hash, f"the camera of {source.path}", str(path))
            found = model.answer_labels(labels)
            points[key], sigma[key], presence[key] = found.points_cm, found.sigma_cm, found.presence
        else:
            marking_cm = meta.marking_cm if entrants.marking_cm is None else entrants.marking_cm
            inputs = DetectorInputs(lane_width_cm=meta.lane_width_cm, marking_cm=marking_cm)
            points[key] = answer_edges(labels, build_on_edges(key, inputs))
    return SourceAnswers(
        name=str(source.path),
        kind="label set",
        reference=meta.source,
        truth_cm=labels.points_cm,
        answers_cm=points,
        sigma_cm=sigma,
        presence=presence,
        visible=lines_seen(labels),
        conditions={"place": way_to_training_cm(labels, training)},
    )
