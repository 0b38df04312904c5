"""Several detectors on the same frames: their errors in cm, overall, on shared points and by source."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from lanenet.errors import LabelFormatError
from lanenet.evaluation.breakdown import (
    GROUPS,
    Breakdown,
    bootstrap_segments,
    errors_by_group,
    lane_curvature,
    lines_shown,
    presence_stats,
    rmse_interval_cm,
    sigma_stats,
)
from lanenet.evaluation.errors import ErrorStats, ErrorTable, error_stats, point_errors
from lanenet.geometry.lane import ROWS_CM

FORMAT = "lanenet-evaluation/1"

_UNITS = {"*_cm": "centimetre", "coverage": "share of the labelled points, 0 to 1"}


@dataclass(frozen=True)
class SourceAnswers:
    """What the detectors say about one drive, map or label set.

    Attributes:
        name: The path, as people know it.
        kind: ``simulated drive``, ``map`` or ``label set``.
        reference: Where the labels come from: ``truth`` or ``map``.
        truth_cm: Six labels per frame; NaN where there is none.
        answers_cm: By detector, six points per frame; NaN where it has no answer.
        sigma_cm: By detector, its sigmas; a detector that predicts none may be left out.
        presence: By detector, its probability that the left and the right line can be seen; likewise.
        visible: Whether each line can be seen: 1, 0, or NaN for unknown; None if unknown throughout.
        conditions: By name (see :data:`lanenet.evaluation.breakdown.GROUPS`) its value for each frame.
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
class SourceErrors:
    """Errors on one source.

    Attributes:
        name: The path, as people know it.
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
        sources: The errors by source.
        errors_cm: Absolute errors by detector, a row per frame; NaN without a label or an answer.
        breakdown: Where the errors come from.
    """

    reference: str
    tables: dict[str, ErrorTable]
    shared: dict[str, SharedErrors]
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
    labelled, first = np.isfinite(truth), errors[names[0]]
    shared = {}
    for name in names[1:]:
        both = np.isfinite(first) & np.isfinite(errors[name])
        shared[name] = SharedErrors(*(error_stats(e, both, labelled) for e in (errors[name], first)))
    return Comparison(
        reference=reference,
        tables={name: point_errors(answer, truth, reference) for name, answer in answers.items()},
        shared=shared,
        sources=tuple(_source_errors(source) for source in sources),
        errors_cm=errors,
        breakdown=_break_down(sources, names, truth, errors),
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
            unknown = [np.full(len(source.truth_cm), np.nan) for source in sources]
            parts = [s.conditions.get(condition, u) for s, u in zip(sources, unknown, strict=True)]
            values[condition] = np.concatenate(parts)
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
    sources: Sequence[SourceAnswers], parts: Sequence[np.ndarray | None], width: int
) -> Float[np.ndarray, "n w"]:
    """Concatenate what sources know; NaN for a source that knows nothing."""
    unknown = [np.full((len(source.truth_cm), width), np.nan) for source in sources]
    return np.concatenate([u if part is None else part for u, part in zip(unknown, parts, strict=True)])


def _source_errors(source: SourceAnswers) -> SourceErrors:
    stats = {name: point_errors(answer, source.truth_cm).all for name, answer in source.answers_cm.items()}
    return SourceErrors(source.name, source.kind, source.reference, len(source.truth_cm), stats)
