"""Several detectors on the same sources: their errors in cm, overall, on shared points and by source.

What needs SciPy, PyArrow or numba is imported inside functions: the car, which knows ``lanenet val`` as a
command, has none of them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from lanenet.errors import LabelFormatError
from lanenet.evaluation.decisions import Decisions, decide
from lanenet.evaluation.errors import (
    GROUPS,
    Breakdown,
    ErrorStats,
    ErrorTable,
    bootstrap_segments,
    error_stats,
    errors_by_group,
    lane_curvature,
    lines_shown,
    point_errors,
    presence_stats,
    rmse_interval_cm,
    sigma_stats,
)
from lanenet.evaluation.plain_sight import OFF_CM, PlainSight, count_off, off_markings
from lanenet.evaluation.sources import Opened, at_frames, distance_to_training_cm, lines_seen
from lanenet.geometry.lane import ROWS_CM, SIDES

if TYPE_CHECKING:
    from lanenet.data.label_set import LabelSet
    from lanenet.data.maps.mapped_drive import LabelledFrames
    from lanenet.evaluation.answers import Answers, Compared, Progress

FORMAT = "lanenet-evaluation/1"

#: Rows in groups: a detector that measures edges extrapolates to the first one, which no frame shows.
SHARED_ROWS = {"y = 0": (0,), "y = 15, 30": (1, 2)}

_UNITS = {"*_cm": "centimetre", "coverage": "share of the labelled points, 0 to 1"}


@dataclass(frozen=True)
class SourceAnswers:
    """What the detectors say about one drive, map or label set.

    Attributes:
        name: The path, for display.
        kind: ``simulated drive``, ``map`` or ``label set``.
        reference: Where the labels come from: ``truth`` or ``map``.
        truth_cm: Six labels per frame; NaN where there is none.
        all_cm: As ``truth_cm``, with the points whose place is known although they are no labels; None
            where the labels are all that is known.
        answers_cm: By detector, six points per frame; NaN where it has no answer.
        sigma_cm: By detector, its sigmas; a detector that predicts none may be left out.
        presence: By detector, its probability that the left and the right line can be seen; likewise.
        visible: Whether each line can be seen: 1, 0, or NaN for unknown; None if unknown throughout.
        plain: Frames with both markings in plain sight; None where there are no frames.
        steering_rad: By detector, its steering target for each frame; empty where there are no frames.
        conditions: By name (see :data:`lanenet.evaluation.errors.GROUPS`) its value for each frame.
    """

    name: str
    kind: str
    reference: str
    truth_cm: Float[np.ndarray, "n 6"]
    answers_cm: Mapping[str, Float[np.ndarray, "_ 6"]]
    sigma_cm: Mapping[str, Float[np.ndarray, "_ 6"]] = field(default_factory=dict)
    presence: Mapping[str, Float[np.ndarray, "_ 2"]] = field(default_factory=dict)
    visible: Float[np.ndarray, "n 2"] | None = None
    conditions: Mapping[str, Float[np.ndarray, "n"]] = field(default_factory=dict)
    all_cm: Float[np.ndarray, "n 6"] | None = None
    plain: Bool[np.ndarray, "n"] | None = None
    steering_rad: Mapping[str, Float[np.ndarray, "n"]] = field(default_factory=dict)


@dataclass(frozen=True)
class SharedErrors:
    """Errors of two detectors on the points that both answered.

    Attributes:
        own: Of a detector.
        first: Of the first detector of the comparison.
    """

    own: ErrorStats
    first: ErrorStats


@dataclass(frozen=True)
class WholeTruth:
    """Errors of a detector over the points that have no label, and over all whose place is known.

    Attributes:
        masked: Outside the network's window, or of a frame that is not to be labelled.
        all: With a label or without.
    """

    masked: ErrorStats
    all: ErrorStats


@dataclass(frozen=True)
class SourceErrors:
    """Errors on one source.

    Attributes:
        name: The path, for display.
        kind: As in :class:`SourceAnswers`.
        reference: As in :class:`SourceAnswers`.
        frames: Frames that the detectors saw.
        detectors: Errors over all points, by detector.
    """

    name: str
    kind: str
    reference: str
    frames: int
    detectors: dict[str, ErrorStats]


@dataclass(frozen=True)
class Comparison:
    """The errors of several detectors.

    Attributes:
        reference: What the errors are against: ``truth``, ``map`` or ``map and truth``.
        tables: Errors by detector, over all sources together.
        shared: By detector but the first: it and the first on the points that both answered. A detector that
            answers only what is easy looks good on its own answers.
        shared_rows: As ``shared``, by the group of rows (``SHARED_ROWS``).
        whole: By detector, the errors that the labels leave out; empty where they leave nothing out.
        plain: By detector, what it says about markings in plain sight; empty where no frame shows them so.
        decisions: By detector, its wrong decisions, and the errors of the others.
        sources: The errors by source.
        errors_cm: Absolute errors by detector, a row per frame; NaN without a label or an answer.
        breakdown: Where the errors come from.
    """

    reference: str
    tables: dict[str, ErrorTable]
    shared: dict[str, SharedErrors]
    shared_rows: dict[str, dict[str, SharedErrors]]
    whole: dict[str, WholeTruth]
    plain: dict[str, PlainSight]
    decisions: dict[str, Decisions]
    sources: tuple[SourceErrors, ...]
    errors_cm: dict[str, Float[np.ndarray, "n 6"]]
    breakdown: Breakdown

    @property
    def first(self) -> str:
        """Name of the detector that the others are compared with."""
        return next(iter(self.tables))

    def as_dict(self) -> dict[str, object]:
        """Return plain values for JSON, with the version of their layout."""
        detectors = {}
        for name, table in self.tables.items():
            shared = self.shared.get(name)
            detectors[name] = {
                **table.as_dict(),
                "shared_with": None if shared is None else self.first,
                "shared": None if shared is None else shared.own.as_dict(),
                "first_on_shared": None if shared is None else shared.first.as_dict(),
                "shared_rows": {
                    rows: {"own": pair.own.as_dict(), "first": pair.first.as_dict()}
                    for rows, pair in self.shared_rows.get(name, {}).items()
                },
                "masked": self.whole[name].masked.as_dict() if name in self.whole else None,
                "plain_sight": vars(self.plain[name]) if name in self.plain else None,
                "decisions": self.decisions[name].as_dict(),
                "all_known": self.whole[name].all.as_dict() if name in self.whole else None,
                **self.breakdown.of(name),
            }
        sources = [
            vars(source) | {"detectors": {name: stats.as_dict() for name, stats in source.detectors.items()}}
            for source in self.sources
        ]
        return {
            "format": FORMAT,
            "units": _UNITS,
            "rows_cm": list(ROWS_CM),
            "reference": self.reference,
            "sources": sources,
            "detectors": detectors,
        }


@dataclass(frozen=True)
class SeenSource:
    """What the first detector of a comparison answers on frames, for pictures.

    Attributes:
        frames: The source.
        answers_cm: Six points for each frame; NaN where it has no answer.
        plain: Frames with both markings in plain sight.
        values: Its other answers for each frame: ``steering_rad`` and ``confidence``.
    """

    frames: LabelledFrames
    answers_cm: Float[np.ndarray, "n 6"]
    plain: Bool[np.ndarray, "n"]
    values: Mapping[str, Float[np.ndarray, "n"]] = field(default_factory=dict)

    @property
    def off_cm(self) -> Float[np.ndarray, "n 6"]:
        """The answers off a marking in plain sight, on the rows that frames show; NaN otherwise."""
        off = self.plain & (off_markings(self.answers_cm, self.frames.points_cm) > OFF_CM)
        shown = np.tile(np.array(ROWS_CM) > 0.0, len(SIDES))
        return np.where(off[:, None] & shown, self.answers_cm, np.nan)


def default_names(sources: Sequence[Opened], with_model: bool) -> tuple[str, ...]:
    """Return the detectors that all sources allow, in the order of the tables."""
    from lanenet.perception.registry import usual_names

    with_frames = all(source.frames is not None for source in sources)
    return tuple(
        usual_names(lambda kind: (with_frames or kind.on_label_sets) and (with_model or not kind.needs_model))
    )


def evaluate(
    sources: Sequence[Opened],
    compared: Compared,
    training: Sequence[LabelSet] = (),
    workers: int = 1,
    progress: Progress | None = None,
) -> tuple[Comparison, list[SeenSource]]:
    """Run detectors over sources and compare them.

    Args:
        sources: Labelled frames; or label sets, if all detectors can do without frames.
        compared: The detectors; the first is what the others are compared with.
        training: What the network has learned from, if known: errors are also given by the distance from it.
        workers: Processes at a time, where several sources have many frames.
        progress: Called with (source, frames done, frames); with several processes with ("sources", sources
            done, sources).

    Returns:
        The comparison; and what the first detector answers on the sources that have frames.

    Raises:
        LanenetError: If a source cannot be read or does not fit a detector.
    """
    all_frames = [source.frames for source in sources if source.frames is not None]
    answers = iter(compared.answer_each(all_frames, workers, progress))
    answered = [_describe(source, compared, answers, training) for source in sources]
    comparison = compare_detectors(answered)
    seen = [
        SeenSource(
            source.frames,
            answer.answers_cm[comparison.first],
            answer.plain,
            {
                "steering_rad": answer.steering_rad[comparison.first],
                "confidence": answer.conditions["confidence"],
            },
        )
        for source, answer in zip(sources, answered, strict=True)
        if source.frames is not None and answer.plain is not None
    ]
    return comparison, seen


def compare_detectors(sources: Sequence[SourceAnswers]) -> Comparison:
    """Compare detectors that answered the same frames.

    Args:
        sources: Labels and answers; the errors are over all of them together.

    Raises:
        LabelFormatError: If there is no source or no detector, two sources were answered by different
            detectors, or a detector answered in another shape than that of the labels.
    """
    if not sources:
        raise LabelFormatError("no source to compare on, expected at least one")
    names = list(sources[0].answers_cm)
    if not names:
        raise LabelFormatError(f"{sources[0].name}: no detector has answered, expected at least one")
    for source in sources:
        if list(source.answers_cm) != names:
            raise LabelFormatError(
                f"{source.name}: answered by {', '.join(source.answers_cm)}, expected {', '.join(names)}"
            )
        for name, answer in source.answers_cm.items():
            if answer.shape != source.truth_cm.shape:
                raise LabelFormatError(
                    f"{source.name}, detector {name!r}: answered shape {answer.shape}, expected "
                    f"{source.truth_cm.shape}"
                )
    reference = " and ".join(sorted({source.reference for source in sources}))
    truth = np.concatenate([source.truth_cm for source in sources]).astype(np.float64)
    answers = {
        name: np.concatenate([source.answers_cm[name] for source in sources]).astype(np.float64)
        for name in names
    }
    errors = {name: np.abs(answer - truth) for name, answer in answers.items()}
    shows = [np.zeros(len(s.truth_cm), bool) if s.plain is None else s.plain for s in sources]
    plain = np.concatenate(shows)
    labelled, first = np.isfinite(truth), errors[names[0]]
    shared, shared_rows = {}, {}
    for name in names[1:]:
        both = np.isfinite(first) & np.isfinite(errors[name])
        pair = (errors[name], first)
        shared[name] = SharedErrors(*(error_stats(e, both, labelled) for e in pair))
        shared_rows[name] = {
            group: SharedErrors(*(error_stats(*(part[:, at] for part in (e, both, labelled))) for e in pair))
            for group, at in ((g, _columns_of(rows)) for g, rows in SHARED_ROWS.items())
        }
    return Comparison(
        reference=reference,
        tables={name: point_errors(answer, truth, reference) for name, answer in answers.items()},
        shared=shared,
        shared_rows=shared_rows,
        whole=_whole_truth(sources, truth, answers),
        plain={name: count_off(answer, truth, plain) for name, answer in answers.items() if plain.any()},
        decisions=_decisions(sources, truth, answers),
        sources=tuple(_source_errors(source) for source in sources),
        errors_cm=errors,
        breakdown=_break_down(sources, names, truth, errors),
    )


def _columns_of(rows: Sequence[int]) -> list[int]:
    """Columns of both lines' points on some of the label rows."""
    return [side * len(ROWS_CM) + row for side in range(len(SIDES)) for row in rows]


def _decisions(
    sources: Sequence[SourceAnswers],
    truth_cm: Float[np.ndarray, "n 6"],
    answers_cm: Mapping[str, Float[np.ndarray, "n 6"]],
) -> dict[str, Decisions]:
    frames = [len(source.truth_cm) for source in sources]
    starts, cuts = np.cumsum(frames)[:-1], bootstrap_segments(frames)[0]
    sigma_cm = {name: _joined(sources, [s.sigma_cm.get(name) for s in sources], 6) for name in answers_cm}
    return {name: decide(own, truth_cm, sigma_cm[name], starts, cuts) for name, own in answers_cm.items()}


def _whole_truth(
    sources: Sequence[SourceAnswers],
    truth_cm: Float[np.ndarray, "n 6"],
    answers_cm: Mapping[str, Float[np.ndarray, "n 6"]],
) -> dict[str, WholeTruth]:
    """Return the errors of each detector without labels; empty if no source knows more than its labels."""
    parts = [source.truth_cm if source.all_cm is None else source.all_cm for source in sources]
    known_cm = np.concatenate(parts).astype(np.float64)
    unlabelled = np.where(np.isfinite(truth_cm), np.nan, known_cm)
    if not np.isfinite(unlabelled).any():
        return {}
    return {
        name: WholeTruth(*(point_errors(answer, part).all for part in (unlabelled, known_cm)))
        for name, answer in answers_cm.items()
    }


def _describe(
    source: Opened, compared: Compared, answers: Iterator[Answers], training: Sequence[LabelSet]
) -> SourceAnswers:
    """Return the answers to a source with its labels and conditions; ``answers`` are those to frames."""
    frames, labels = source.frames, source.labels
    conditions, visible, all_cm = {}, None, None
    if labels is not None:
        visible = lines_seen(labels)
        conditions["place"] = distance_to_training_cm(labels, training)
    if frames is None:
        assert labels is not None
        kind, reference, truth_cm = "label set", labels.meta.source, labels.points_cm
        answer = compared.answer_labels(labels, source.path)
    else:
        kind = "simulated drive" if frames.reference == "truth" else "map"
        reference, truth_cm, all_cm = frames.reference, frames.points_cm, frames.all_cm
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
        all_cm=all_cm,
        plain=answer.plain,
        steering_rad=answer.steering_rad,
    )


def _break_down(
    sources: Sequence[SourceAnswers],
    names: Sequence[str],
    truth_cm: Float[np.ndarray, "n 6"],
    errors_cm: Mapping[str, Float[np.ndarray, "n 6"]],
) -> Breakdown:
    labelled = np.isfinite(truth_cm)
    values = {"bend": lane_curvature(truth_cm)}
    for condition in GROUPS:
        if any(condition in source.conditions for source in sources):
            values[condition] = _joined(sources, [s.conditions.get(condition) for s in sources])
    visible = _joined(sources, [s.visible for s in sources], 2)
    if np.isfinite(visible).any():
        values["lines"] = lines_shown(visible)
    groups = {
        condition: {n: errors_by_group(condition, value, errors_cm[n], labelled) for n in names}
        for condition, value in values.items()
    }
    cuts, interval_over = bootstrap_segments([len(source.truth_cm) for source in sources])
    sigma, presence, interval = {}, {}, {}
    for name in names:
        # The same segments are drawn for every detector.
        interval[name] = rmse_interval_cm(np.split(errors_cm[name], cuts), np.random.default_rng(0))
        own = sigma_stats(errors_cm[name], _joined(sources, [s.sigma_cm.get(name) for s in sources], 6))
        if own is not None:
            sigma[name] = own
        lines = presence_stats(_joined(sources, [s.presence.get(name) for s in sources], 2), visible)
        if lines is not None:
            presence[name] = lines
    return Breakdown(groups, interval, interval_over, sigma, presence)


def _joined(
    sources: Sequence[SourceAnswers], parts: Sequence[np.ndarray | None], *width: int
) -> Float[np.ndarray, "n *w"]:
    """Concatenate what sources know; NaN for a source that knows nothing."""
    unknown = [np.full((len(source.truth_cm), *width), np.nan) for source in sources]
    return np.concatenate([u if part is None else part for u, part in zip(unknown, parts, strict=True)])


def _source_errors(source: SourceAnswers) -> SourceErrors:
    stats = {name: point_errors(answer, source.truth_cm).all for name, answer in source.answers_cm.items()}
    return SourceErrors(source.name, source.kind, source.reference, len(source.truth_cm), stats)
