"""Every detector compared on labelled sources, and the report of it.

Knows ``datagen``, ``lanenet.learn`` and ``lanenet.onboard``, as the command line does, and imports them only
where they are needed: the car has neither SciPy nor PyArrow.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lanenet.labelled_sources import Opened

if TYPE_CHECKING:
    from lanenet.data.label_set import LabelSet
    from lanenet.learn.compare import Comparison, SourceAnswers
    from lanenet.onboard.compare import ComparedName
    from lanenet.perception.estimate import Detector

#: Called with (source, frames done, frames).
Progress = Callable[[str, int, int], None]


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
    also: Mapping[str, Path] | None = None,
    training: Sequence[LabelSet] = (),
    marking_cm: float | None = None,
    any_camera: bool = False,
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
        progress: Called with (source, frames done, frames).

    Raises:
        LanenetError: If a source cannot be read or does not fit a detector.
    """
    from lanenet.learn.breakdown_picture import breakdown_picture
    from lanenet.learn.compare import compare_detectors
    from lanenet.learn.error_picture import error_picture
    from lanenet.learn.error_tables import as_markdown
    from lanenet.onboard.worst_frames import draw_worst, find_worst, jpeg_bytes

    models = {} if model is None else {"network": model}
    models |= also or {}
    answered = [_answer(s, names, models, training, marking_cm, any_camera, progress) for s in sources]
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


def _in_order(names: Sequence[ComparedName], models: Mapping[str, Path]) -> list[str]:
    """All detectors in the order of the tables: more networks follow the first one."""
    more = [name for name in models if name != "network"]
    return [*(n for n in names if n == "network"), *more, *(n for n in names if n != "network")]


def _answer(
    source: Opened,
    names: Sequence[ComparedName],
    models: Mapping[str, Path],
    training: Sequence[LabelSet],
    marking_cm: float | None,
    any_camera: bool,
    progress: Progress | None,
) -> SourceAnswers:
    from lanenet.learn.compare import SourceAnswers
    from lanenet.learn.conditions import at_frames, lines_seen, way_to_training_cm
    from lanenet.onboard.compare import answer_frames, build_compared

    frames, labels, name = source.frames, source.labels, str(source.path)
    if frames is None:
        assert labels is not None
        return _answer_labels(name, labels, names, models, training, marking_cm, any_camera)
    detectors: dict[str, Detector] = {}
    for key in _in_order(names, models):
        detector: Any = "network" if key in models else key
        built = build_compared(
            [detector], frames, model=models.get(key), marking_cm=marking_cm, any_camera=any_camera
        )
        detectors[key] = built[detector]

    def report(done: int, total: int) -> None:
        if progress is not None:
            progress(source.path.name, done, total)

    answers = answer_frames(frames, detectors, report)
    first = next(iter(detectors))
    conditions = {"light": answers.brightness, "confidence": answers.confidence[first]}
    visible = None
    if labels is not None:
        visible = at_frames(lines_seen(labels), labels.frame, frames.frames)
        way = way_to_training_cm(labels, training)
        conditions["place"] = at_frames(way, labels.frame, frames.frames)
    return SourceAnswers(
        name=name,
        kind="simulated drive" if frames.reference == "truth" else "map",
        reference=frames.reference,
        truth_cm=frames.points_cm,
        answers_cm=answers.points_cm,
        sigma_cm=answers.sigma_cm,
        presence=answers.presence,
        visible=visible,
        conditions=conditions,
    )


def _answer_labels(
    name: str,
    labels: LabelSet,
    names: Sequence[ComparedName],
    models: Mapping[str, Path],
    training: Sequence[LabelSet],
    marking_cm: float | None,
    any_camera: bool,
) -> SourceAnswers:
    from lanenet.learn.compare import SourceAnswers
    from lanenet.learn.conditions import lines_seen, way_to_training_cm
    from lanenet.learn.evaluate import RasterModel
    from lanenet.onboard.detectors import filter_settings, lane_filter_points_cm

    points: dict[str, Any] = {}
    sigma: dict[str, Any] = {}
    presence: dict[str, Any] = {}
    for key in _in_order(names, models):
        if key in models:
            model = RasterModel(models[key])
            if not any_camera:
                camera = f"the camera of {name}"
                model.meta.check_trained_with(labels.meta.camera_hash, camera, str(models[key]))
            found = model.answer_labels(labels)
            points[key], sigma[key], presence[key] = found.points_cm, found.sigma_cm, found.presence
        else:
            meta = labels.meta
            settings = filter_settings(meta.lane_width_cm, meta.marking_cm, marking_cm)
            points[key] = lane_filter_points_cm(labels, settings)
    return SourceAnswers(
        name=name,
        kind="label set",
        reference=labels.meta.source,
        truth_cm=labels.points_cm,
        answers_cm=points,
        sigma_cm=sigma,
        presence=presence,
        visible=lines_seen(labels),
        conditions={"place": way_to_training_cm(labels, training)},
    )
