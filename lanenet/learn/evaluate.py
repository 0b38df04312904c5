"""Errors in cm: per point, row and side, for several detectors on the same frames."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from rich import box
from rich.table import Table

from lanenet.data.label_set import LabelSet
from lanenet.errors import LabelFormatError, ModelMismatchError
from lanenet.geometry.lane import N_POINTS, POINT_NAMES, ROWS_CM, SIDES
from lanenet.learn.dataset import reference_of
from lanenet.perception.network import INPUT_NAME, open_model

#: From a label set to the six points of each of its frames, [cm], NaN where it has no answer.
Predictor = Callable[[LabelSet], Float[np.ndarray, "n 6"]]

_CHUNK = 64


@dataclass(frozen=True)
class ErrorStats:
    """Absolute errors of a group of points.

    Attributes:
        rmse_cm: Root of the mean square; NaN, like the next three, without an answered point.
        median_cm: Median.
        p95_cm: 95th percentile.
        worst_cm: Largest.
        count: Points that have a label and an answer.
        truth_count: Points that have a label.
    """

    rmse_cm: float
    median_cm: float
    p95_cm: float
    worst_cm: float
    count: int
    truth_count: int

    @property
    def coverage(self) -> float:
        """Share of the labelled points that were answered; NaN without a labelled point."""
        return self.count / self.truth_count if self.truth_count else float("nan")


@dataclass(frozen=True)
class ErrorTable:
    """Errors of one detector.

    Attributes:
        groups: By name: ``all``, the sides, the rows (``y = 15 cm``), the six points.
        reference: What the errors are against: ``truth``, ``map``, ``map and truth``, or empty.
        common_rmse_cm: RMSE over the points that every compared detector answered; NaN without one.
        common_count: Number of those points.
    """

    groups: dict[str, ErrorStats]
    reference: str = ""
    common_rmse_cm: float = float("nan")
    common_count: int = 0

    @property
    def all(self) -> ErrorStats:
        """Errors over all points."""
        return self.groups["all"]

    @property
    def point_rmse_cm(self) -> tuple[float, ...]:
        """RMSE of each of the six points, [cm]."""
        return tuple(self.groups[name].rmse_cm for name in POINT_NAMES)

    def as_dict(self) -> dict[str, object]:
        """Return plain values for JSON; every key carries its unit."""
        groups = {
            name: {
                "rmse_cm": stats.rmse_cm,
                "median_cm": stats.median_cm,
                "p95_cm": stats.p95_cm,
                "worst_cm": stats.worst_cm,
                "count": stats.count,
                "coverage": stats.coverage,
            }
            for name, stats in self.groups.items()
        }
        return {
            "reference": self.reference,
            "common_rmse_cm": self.common_rmse_cm,
            "common_count": self.common_count,
            "groups": groups,
        }


def point_errors(
    pred_cm: Float[np.ndarray, "n 6"], truth_cm: Float[np.ndarray, "n 6"], reference: str = ""
) -> ErrorTable:
    """Compare answers with labels.

    Args:
        pred_cm: Six points per frame, NaN where there is no answer.
        truth_cm: Six labels per frame, NaN where there is none; such points do not count.
        reference: Where the labels come from, for the report.

    Returns:
        The errors of all points, of each side, row and point.
    """
    labelled = np.isfinite(truth_cm)
    answered = labelled & np.isfinite(pred_cm)
    error = np.abs(np.where(answered, pred_cm, 0.0) - np.where(answered, truth_cm, 0.0)).astype(np.float64)
    groups = {
        name: _stats(error[:, columns], answered[:, columns], labelled[:, columns])
        for name, columns in _groups().items()
    }
    return ErrorTable(groups, reference)


def evaluate_detectors(
    label_sets: Sequence[LabelSet], predictors: Mapping[str, Predictor]
) -> dict[str, ErrorTable]:
    """Compare detectors on the same frames.

    Args:
        label_sets: Frames and labels; the errors are over all of them together.
        predictors: Detectors by name.

    Returns:
        The errors by name. Detectors that answer only what is easy look good on their own answers, so each
        table also holds the RMSE over the points that every detector answered.

    Raises:
        LabelFormatError: If there is no label set, or a predictor answers in another shape.
    """
    if not label_sets:
        raise LabelFormatError("no label set to compare with, expected at least one")
    reference = reference_of(label_sets)
    truth = np.concatenate([labels.points_cm for labels in label_sets]).astype(np.float64)
    answers = {name: _answers(name, predict, label_sets) for name, predict in predictors.items()}
    common = np.isfinite(truth)
    for answer in answers.values():
        common = common & np.isfinite(answer)
    tables = {}
    for name, answer in answers.items():
        table = point_errors(answer, truth, reference)
        error = (answer - truth)[common]
        rmse = float(np.sqrt(np.mean(error**2))) if error.size else float("nan")
        tables[name] = ErrorTable(table.groups, reference, rmse, int(error.size))
    return tables


def network_predictor(onnx_path: Path, threads: int = 1) -> Predictor:
    """Return a model file as a predictor for label sets.

    The camera is not compared: the label set's edges are already on the road.

    Raises:
        ModelMismatchError: If the file cannot be used; when called, if a label set has another window.
    """
    session, meta = open_model(onnx_path, threads)

    def predict(labels: LabelSet) -> Float[np.ndarray, "n 6"]:
        if labels.meta.window != meta.window:
            raise ModelMismatchError(
                f"{onnx_path}: made for the window {meta.window}, but the label set has {labels.meta.window}"
            )
        n = len(labels.points_cm)
        result = np.full((n, N_POINTS), np.nan)
        for start in range(0, n, _CHUNK):
            rasters = np.stack([labels.raster(i) for i in range(start, min(start + _CHUNK, n))])
            (points,) = session.run(("points_cm",), {INPUT_NAME: rasters[:, None]})
            # As on the car: where nothing is seen there is no answer.
            seen = np.asarray(rasters.any(axis=(1, 2)))
            result[start : start + len(rasters)] = np.where(seen[:, None], points, np.nan)
        return result

    return predict


def format_table(tables: Mapping[str, ErrorTable]) -> tuple[Table, str]:
    """Lay out errors for a terminal and for a report.

    Args:
        tables: Errors by detector.

    Returns:
        A rich table and the same as Markdown; lengths in cm.
    """
    references = sorted({table.reference for table in tables.values() if table.reference})
    title = f"Errors in cm against the {' and '.join(references) or 'labels'}"
    header = ["detector", "", "all", *(f"{side} {row:.0f}" for side in SIDES for row in ROWS_CM)]
    lines = []
    for name, t in tables.items():
        groups = [t.groups[group] for group in ("all", *POINT_NAMES)]
        lines += [
            [name, "RMSE", *(_cm(stats.rmse_cm) for stats in groups)],
            ["", "median", *(_cm(stats.median_cm) for stats in groups)],
            ["", "p95", *(_cm(stats.p95_cm) for stats in groups)],
            ["", "worst", *(_cm(stats.worst_cm) for stats in groups)],
            ["", "answered", *(_percent(stats) for stats in groups)],
            ["", "common", _cm(t.common_rmse_cm), *[""] * len(POINT_NAMES)],
        ]
    counts = ", ".join(sorted({f"{t.all.truth_count} labelled points" for t in tables.values()}))
    note = (
        f"{counts}; columns are the line and the distance ahead in cm; "
        "common: RMSE over the points that every detector answered"
        + "".join(sorted({f" ({t.common_count} points)" for t in tables.values() if t.common_count}))
    )
    # Narrow enough for a terminal of 80 columns.
    rich_table = Table(title=title, caption=note, box=box.SIMPLE, pad_edge=False)
    for i, name in enumerate(header):
        rich_table.add_column(name.replace(" ", "\n"), justify="left" if i < 2 else "right", no_wrap=True)
    for line in lines:
        rich_table.add_row(*line, end_section=line[1] == "common")
    rule = ["---", "---", *["---:"] * (len(header) - 2)]
    rows = "\n".join("| " + " | ".join(line) + " |" for line in [header, rule, *lines])
    return rich_table, f"{title}\n\n{rows}\n\n{note}\n"


def _answers(name: str, predict: Predictor, label_sets: Sequence[LabelSet]) -> Float[np.ndarray, "n 6"]:
    parts = []
    for labels in label_sets:
        part = np.asarray(predict(labels), np.float64)
        if part.shape != labels.points_cm.shape:
            raise LabelFormatError(
                f"detector {name!r}: answered shape {part.shape}, expected {labels.points_cm.shape}"
            )
        parts.append(part)
    return np.concatenate(parts)


def _percent(stats: ErrorStats) -> str:
    return f"{100.0 * stats.coverage:.0f}%" if stats.truth_count else "-"


def _row_names() -> list[str]:
    return [f"y = {row:.0f} cm" for row in ROWS_CM]


def _groups() -> dict[str, list[int]]:
    """Columns of the six points that make up each group."""
    n = len(ROWS_CM)
    groups = {"all": list(range(N_POINTS))}
    groups |= {side: list(range(k * n, (k + 1) * n)) for k, side in enumerate(SIDES)}
    groups |= {name: [k, k + n] for k, name in enumerate(_row_names())}
    groups |= {name: [k] for k, name in enumerate(POINT_NAMES)}
    return groups


def _stats(
    error_cm: Float[np.ndarray, "n k"], answered: Bool[np.ndarray, "n k"], labelled: Bool[np.ndarray, "n k"]
) -> ErrorStats:
    found = error_cm[answered]
    total = int(labelled.sum())
    if not found.size:
        nan = float("nan")
        return ErrorStats(nan, nan, nan, nan, 0, total)
    return ErrorStats(
        rmse_cm=float(np.sqrt(np.mean(found**2))),
        median_cm=float(np.median(found)),
        p95_cm=float(np.percentile(found, 95)),
        worst_cm=float(found.max()),
        count=int(found.size),
        truth_count=total,
    )


def _cm(value: float) -> str:
    return "-" if np.isnan(value) else f"{value:.2f}" if value < 99.5 else f"{value:.0f}"
