"""Errors in cm of one detector: per point, row and side."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from lanenet.geometry.lane import N_POINTS, POINT_NAMES, ROWS_CM, SIDES


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

    def as_dict(self) -> dict[str, float]:
        """Return plain values for JSON; every length carries its unit."""
        values = {name: value for name, value in vars(self).items() if name != "truth_count"}
        return values | {"coverage": self.coverage}


@dataclass(frozen=True)
class ErrorTable:
    """Errors of one detector.

    Attributes:
        groups: By name: ``all``, the sides, the rows (``y = 15 cm``), the six points.
        reference: What the errors are against: ``truth``, ``map``, ``map and truth``, or empty.
    """

    groups: dict[str, ErrorStats]
    reference: str = ""

    @property
    def all(self) -> ErrorStats:
        """Errors over all points."""
        return self.groups["all"]

    @property
    def point_rmse_cm(self) -> tuple[float, ...]:
        """RMSE of each of the six points, [cm]."""
        return tuple(self.groups[name].rmse_cm for name in POINT_NAMES)

    def as_dict(self) -> dict[str, object]:
        """Return plain values for JSON."""
        groups = {name: stats.as_dict() for name, stats in self.groups.items()}
        return {"reference": self.reference, "groups": groups}


def point_errors(
    pred_cm: Float[np.ndarray, "n 6"], truth_cm: Float[np.ndarray, "n 6"], reference: str = ""
) -> ErrorTable:
    """Compare a detector's answers with labels.

    Args:
        pred_cm: Six points per frame, NaN where there is no answer.
        truth_cm: Six labels per frame, NaN where masked; such points do not count.
        reference: Where the labels come from, for the report.

    Returns:
        The errors of all points, of each side, row and point.
    """
    labelled = np.isfinite(truth_cm)
    answered = labelled & np.isfinite(pred_cm)
    error = np.abs(np.where(answered, pred_cm, 0.0) - np.where(answered, truth_cm, 0.0)).astype(np.float64)
    groups = {
        name: error_stats(error[:, columns], answered[:, columns], labelled[:, columns])
        for name, columns in _groups().items()
    }
    return ErrorTable(groups, reference)


def _groups() -> dict[str, list[int]]:
    """Columns of the six points that make up each group."""
    n = len(ROWS_CM)
    groups = {"all": list(range(N_POINTS))}
    groups |= {side: list(range(k * n, (k + 1) * n)) for k, side in enumerate(SIDES)}
    groups |= {f"y = {row:.0f} cm": [k, k + n] for k, row in enumerate(ROWS_CM)}
    groups |= {name: [k] for k, name in enumerate(POINT_NAMES)}
    return groups


def error_stats(
    error_cm: Float[np.ndarray, "n k"], answered: Bool[np.ndarray, "n k"], labelled: Bool[np.ndarray, "n k"]
) -> ErrorStats:
    """Summarise absolute errors, [cm], of the points that have a label and an answer."""
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
