"""How errors grow when something is wrong: label sets, changed in one way at a time."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lanenet.data.label_set import LabelSet
from lanenet.errors import LabelFormatError
from lanenet.evaluation.answers import RasterAnswers, RasterModel
from lanenet.evaluation.errors import (
    ErrorStats,
    PresenceStats,
    SigmaStats,
    error_stats,
    presence_stats,
    rmse_interval_cm,
    sigma_stats,
)
from lanenet.evaluation.tables import TextTable, show_cm, show_share
from lanenet.perception.estimate import LaneMemory
from lanenet.samples.dataset import LaneSamples
from lanenet.samples.settings import AugmentSettings

#: Called with (changes done, changes).
Progress = Callable[[int, int], None]

FORMAT = "lanenet-robustness/1"

#: What is changed, and by how much. With the draw "limit" every frame is changed by all of it, with either
#: sign. The amounts are chosen: what a home-made car meets; 15 degrees and 8 cm are the augmentation's
#: limits.
CHANGES: dict[str, dict[str, object]] = {
    "none": {},
    "one line missing": {"missing_line": 1.0},
    "same, width known": {"missing_line": 1.0},
    "same, width unknown": {"missing_line": 1.0},
    "30 % clutter": {"clutter_share": 0.3, "draw": "limit"},
    "3 unknown objects": {"objects": 3, "draw": "limit"},
    "heading and offset": {"rotate_rad": math.radians(15.0), "shift_cm": 8.0},
    "pitch 1 deg wrong": {"pitch_rad": math.radians(1.0), "draw": "limit"},
    "height 5 % wrong": {"height": 0.05, "draw": "limit"},
    "both lines missing": {"missing_both": 1.0},
}
#: These have no errors: nothing of the lane can be seen.
_PRESENCE_ALONE = ("both lines missing",)
#: Here the errors are those of the missing line, where the other one can be seen.
_MISSING_SIDE = ("one line missing", "same, width known", "same, width unknown")
#: Whether the lane width is known. Elsewhere it is known to models that take it, as they are used so.
_WIDTH_KNOWN = {"same, width known": True, "same, width unknown": False}
_SEED = 20


@dataclass(frozen=True)
class RobustRow:
    """One model under one change.

    Attributes:
        change: Name in ``CHANGES``.
        model: Name of the model.
        errors: Over all points, or over those of the missing line; None where nothing of the lane is seen.
        interval_cm: 95 % interval of their RMSE over drives.
        sigma: Whether its sigmas are right.
        presence: Whether it predicts which lines can be seen.
    """

    change: str
    model: str
    errors: ErrorStats | None
    interval_cm: tuple[float, float] | None
    sigma: SigmaStats | None
    presence: PresenceStats | None

    def as_dict(self) -> dict[str, object]:
        """Return plain values for JSON."""
        return {
            "change": self.change,
            "model": self.model,
            "errors": None if self.errors is None else self.errors.as_dict(),
            "rmse_95_interval_cm": None if self.interval_cm is None else list(self.interval_cm),
            "doubt": None if self.sigma is None else self.sigma.as_dict(),
            "presence": None if self.presence is None else vars(self.presence),
        }


def measure_robustness(
    models: Mapping[str, RasterModel],
    label_sets: Sequence[LabelSet],
    names: Sequence[str],
    progress: Progress | None = None,
) -> list[RobustRow]:
    """Answer every frame of label sets under each change.

    Args:
        models: By name; all get the same rasters, and those that take it the lane width.
        label_sets: With lane lines, from which the labels of a moved car follow.
        names: Where each label set came from, for messages.
        progress: Called after each change.

    Returns:
        A row per change and model. With one line missing there is a second row: with the width known, or for
        a model that takes it, unknown.

    Raises:
        LabelFormatError: If a label set has no lane lines.
        ModelMismatchError: If a model is for edges that were found with other settings.
    """
    for labels, name in zip(label_sets, names, strict=True):
        if not can_measure(labels):
            raise LabelFormatError(f"{name}: has no lane lines, expected a label set made of a map or a road")
    # A raster and labels for the window of each model.
    samples = {
        window: LaneSamples([labels.in_window(window) for labels in label_sets], names)
        for window in dict.fromkeys(model.meta.window for model in models.values())
    }
    for model in models.values():
        model.check_edges(samples[model.meta.window].perception)
    rows = []
    for done, change in enumerate(CHANGES, start=1):
        settings = change_settings(change)
        batches = {
            window: each.augmented_batch(np.arange(len(each)), settings, _SEED, 0)
            for window, each in samples.items()
        }
        for name, model in models.items():
            width_known = _WIDTH_KNOWN.get(change, model.meta.takes_width)
            if change in _WIDTH_KNOWN and width_known == model.meta.takes_width:
                continue  # the same as "one line missing"
            batch, ends = batches[model.meta.window], samples[model.meta.window].set_start[1:-1]
            truth_cm, visible = batch.points_cm.astype(np.float64), batch.present
            answers = model.answer(batch.rasters, batch.lane_cm if width_known else None)
            if change in _MISSING_SIDE and width_known:
                answers = _with_width(answers, batch.lane_cm)
            errors: Float[np.ndarray, "n 6"] = np.abs(answers.points_cm - truth_cm)
            labelled = np.isfinite(truth_cm)
            if change in _MISSING_SIDE:
                missing = np.repeat((visible == 0.0) & (visible[:, ::-1] == 1.0), 3, axis=1)
                errors, labelled = np.where(missing, errors, np.nan), labelled & missing
            alone = change in _PRESENCE_ALONE
            rows.append(
                RobustRow(
                    change,
                    name,
                    None if alone else error_stats(errors, np.isfinite(errors), labelled),
                    None if alone else rmse_interval_cm(np.split(errors, ends), np.random.default_rng(0)),
                    None if alone else sigma_stats(errors, answers.sigma_cm),
                    presence_stats(answers.presence, visible),
                )
            )
        if progress is not None:
            progress(done, len(CHANGES))
    return rows


def can_measure(labels: LabelSet) -> bool:
    """Return whether a label set has lane lines, from which the labels of a changed frame follow."""
    return any(np.isfinite(line).any() for pair in labels.lines for line in pair)


def _with_width(answers: RasterAnswers, widths_cm: Float[np.ndarray, "n"]) -> RasterAnswers:
    """Rebuild missing lines from the lane width, as the car does."""
    points, sigma = answers.points_cm.copy(), answers.sigma_cm.copy()
    for i, width_cm in enumerate(widths_cm):
        memory = LaneMemory(float(width_cm))
        points[i], sigma[i] = memory.complete(points[i], sigma[i], answers.presence[i])
    return RasterAnswers(points, sigma, answers.presence)


def change_settings(change: str) -> AugmentSettings:
    """Return one of ``CHANGES`` as settings of the augmentation that change nothing else."""
    return AugmentSettings.only(**CHANGES[change])


def robust_table(rows: Sequence[RobustRow]) -> TextTable:
    """Lay out what was measured, a line per change and model."""
    lines = []
    for row in rows:
        stats, interval, sigma, presence = row.errors, row.interval_cm, row.sigma, row.presence
        lines.append(
            [
                row.change,
                row.model,
                "-" if stats is None else show_cm(stats.rmse_cm),
                "-" if interval is None else f"{show_cm(interval[0])}-{show_cm(interval[1])}",
                "-" if stats is None else show_cm(stats.p95_cm),
                show_share(None if sigma is None else sigma.coverage["68"]),
                show_share(None if presence is None else presence.recall),
                show_share(None if presence is None else presence.absent_recall),
            ]
        )
    return TextTable(
        title="Errors in cm when something is wrong",
        header=["change", "model", "RMSE", "95%", "p95", "in 68%", "lines found", "gaps found"],
        lines=lines,
        note="networks that take the lane width get it, except where it says unknown; one line missing: "
        "errors of that line where the other can be seen; with the width known it is rebuilt from it, as on "
        "the car; all else is the network alone; heading and offset: up to 15 degrees and 8 cm; 95%: "
        "interval of the RMSE over drives; in 68%: errors within one sigma; found: lines that can be seen "
        "and are predicted, and absent lines that are not",
        texts=2,
        # With one model every line would be a group of its own.
        grouped=len({row.model for row in rows}) > 1,
    )


def as_dict(rows: Sequence[RobustRow]) -> dict[str, object]:
    """Return plain values for JSON, with the version of their layout."""
    return {
        "format": FORMAT,
        "units": {"*_cm": "centimetre"},
        "changes": {name: change_settings(name).model_dump(mode="json") for name in CHANGES},
        "rows": [row.as_dict() for row in rows],
    }
