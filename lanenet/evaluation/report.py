"""Compare detectors on labelled sources, and report it.

What needs SciPy, PyArrow or numba is imported inside the functions: the car, which knows ``lanenet val`` as a
command, has none of them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from lanenet.evaluation.sources import Opened

if TYPE_CHECKING:
    from lanenet.data.label_set import LabelSet
    from lanenet.evaluation.answers import Answers, Compared, Progress
    from lanenet.evaluation.comparison import Comparison, SourceAnswers


@dataclass(frozen=True)
class Evaluation:
    """A comparison and its report.

    Attributes:
        comparison: The figures.
        files: Contents of the report by ending: ``.md``, and where they can be made ``.png`` (errors by row),
            ``-breakdown.png`` (errors by bend, and coverage of sigma) and ``-worst.jpg`` (the frames with the
            first detector's largest errors).
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
    compared: Compared,
    training: Sequence[LabelSet] = (),
    workers: int = 1,
    progress: Progress | None = None,
) -> Evaluation:
    """Run detectors over sources and report their errors.

    Args:
        sources: Labelled frames; or label sets, if all detectors can do without frames.
        compared: The detectors; the first is what the others are compared with.
        training: What the network has learned from, if known: errors are also given by the distance from it.
        workers: Processes at a time, where several sources have many frames.
        progress: Called with (source, frames done, frames); with several processes with ("sources", sources
            done, sources).

    Raises:
        LanenetError: If a source cannot be read or does not fit a detector.
    """
    from lanenet.evaluation.comparison import compare_detectors
    from lanenet.evaluation.pictures import report_pictures
    from lanenet.evaluation.tables import as_markdown

    all_frames = [source.frames for source in sources if source.frames is not None]
    answers = iter(compared.answer_each(all_frames, workers, progress))
    answered = [_describe(source, compared, answers, training) for source in sources]
    comparison = compare_detectors(answered)
    seen = [
        (source.frames, answer.answers_cm[comparison.first])
        for source, answer in zip(sources, answered, strict=True)
        if source.frames is not None
    ]
    return Evaluation(comparison, {".md": as_markdown(comparison), **report_pictures(comparison, seen)})


def _describe(
    source: Opened, compared: Compared, answers: Iterator[Answers], training: Sequence[LabelSet]
) -> SourceAnswers:
    """Return the answers to a source with its labels and conditions; ``answers`` are those to frames."""
    from lanenet.evaluation.comparison import SourceAnswers
    from lanenet.evaluation.sources import at_frames, distance_to_training_cm, lines_seen

    frames, labels = source.frames, source.labels
    conditions, visible = {}, None
    if labels is not None:
        visible = lines_seen(labels)
        conditions["place"] = distance_to_training_cm(labels, training)
    if frames is None:
        assert labels is not None
        kind, reference, truth_cm = "label set", labels.meta.source, labels.points_cm
        answer = compared.answer_labels(labels, source.path)
    else:
        kind = "simulated drive" if frames.reference == "truth" else "map"
        reference, truth_cm = frames.reference, frames.points_cm
        answer = next(answers)
        if labels is not None and visible is not None:
            visible = at_frames(visible, labels.frame, frames.frames)
            conditions["place"] = at_frames(conditions["place"], labels.frame, frames.frames)
        assert answer.brightness is not None
        conditions |= {"light": answer.brightness, "confidence": next(iter(answer.confidence.values()))}
    return SourceAnswers(
        name=str(source.path),
        kind=kind,
        reference=reference,
        truth_cm=truth_cm,
        answers_cm=answer.points_cm,
        sigma_cm=answer.sigma_cm,
        presence=answer.presence,
        visible=visible,
        conditions=conditions,
    )
