"""Errors in cm of one detector: per point, row and side."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8

from lanenet.data.label_set import LabelSet
from lanenet.errors import ModelMismatchError
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.lane import N_POINTS, POINT_NAMES, ROWS_CM, SIDES
from lanenet.perception.edges.road import PerceptionSettings
from lanenet.perception.network.model_file import INPUT_NAME, WIDTH_NAME, open_model

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

    def as_dict(self) -> dict[str, float]:
        """Return plain values for JSON; every length carries its unit."""
        return {
            "rmse_cm": self.rmse_cm,
            "median_cm": self.median_cm,
            "p95_cm": self.p95_cm,
            "worst_cm": self.worst_cm,
            "count": self.count,
            "coverage": self.coverage,
        }


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
        name: error_stats(error[:, columns], answered[:, columns], labelled[:, columns])
        for name, columns in _groups().items()
    }
    return ErrorTable(groups, reference)


@dataclass(frozen=True)
class RasterAnswers:
    """What a model says of rasters.

    Attributes:
        points_cm: Six points each, frame car; NaN where nothing is marked in the raster.
        sigma_cm: Their standard deviations; NaN where the model does not tell them.
        presence: Probability that the left and the right line are there; NaN likewise.
    """

    points_cm: Float[np.ndarray, "n 6"]
    sigma_cm: Float[np.ndarray, "n 6"]
    presence: Float[np.ndarray, "n 2"]


class RasterModel:
    """A model file that answers rasters, as they come from label sets.

    The camera is not compared: a label set's edges are already on the road.

    Attributes:
        path: The file.
        meta: What it says about itself.
    """

    def __init__(self, path: Path, threads: int = 1) -> None:
        """Open a file.

        Raises:
            ModelMismatchError: If it cannot be used.
        """
        self.path = path
        self._session, self.meta = open_model(path, threads)
        outputs = {output.name for output in self._session.get_outputs()}
        # Models of the first kind tell points alone.
        self._names = [name for name in ("points_cm", "sigma_cm", "presence") if name in outputs]

    def check_rasters(self, window: BirdseyeWindow, perception: PerceptionSettings) -> None:
        """Refuse rasters of another window, or of edges that were found in another way.

        Raises:
            ModelMismatchError: Naming both.
        """
        if window != self.meta.window:
            raise ModelMismatchError(
                f"{self.path}: made for the window {self.meta.window}, but the label set has {window}; "
                "give the map or the drive itself, which has edges for any window"
            )
        unlike = perception.unlike(self.meta.perception)
        if unlike:
            raise ModelMismatchError(
                f"{self.path}: made for edges found in another way than those of the label set ({unlike}); "
                "give the map or the drive itself, or label it with another --colour-weight"
            )

    def answer(
        self, rasters: UInt8[np.ndarray, "n 1 r c"], lane_cm: Float[np.ndarray, "n"] | None = None
    ) -> RasterAnswers:
        """Answer rasters of 0 and 255.

        Args:
            rasters: Bird's-eye rasters.
            lane_cm: Width of the lane of each, for a model that can be told it; None keeps it from it.
        """
        n = len(rasters)
        found = {"points_cm": N_POINTS, "sigma_cm": N_POINTS, "presence": len(SIDES)}
        values = {name: np.full((n, width), np.nan) for name, width in found.items()}
        for start in range(0, n, _CHUNK):
            part = rasters[start : start + _CHUNK]
            feed = {INPUT_NAME: part}
            if self.meta.takes_width and lane_cm is not None:
                feed[WIDTH_NAME] = lane_cm[start : start + _CHUNK].astype(np.float32)
            # As on the car: where nothing is seen there is no answer.
            seen = np.asarray(part.any(axis=(1, 2, 3)))[:, None]
            for name, answer in zip(self._names, self._session.run(self._names, feed), strict=True):
                values[name][start : start + _CHUNK] = np.where(seen, answer, np.nan)
        if "presence" in self._names:
            # An empty raster shows no line; that is an answer.
            values["presence"][~rasters.any(axis=(1, 2, 3))] = 0.0
        return RasterAnswers(**values)

    def answer_labels(self, labels: LabelSet) -> RasterAnswers:
        """Answer the frames of a label set, whose lane's width is known.

        Raises:
            ModelMismatchError: If it has another window or other edges.
        """
        self.check_rasters(labels.meta.window, labels.meta.perception)
        rasters = [labels.raster(i)[None] for i in range(len(labels.points_cm))]
        lane_cm = np.full(len(rasters), labels.meta.lane_width_cm)
        return self.answer(np.array(rasters, np.uint8).reshape(-1, 1, *self._shape), lane_cm)

    @property
    def _shape(self) -> tuple[int, int]:
        return self.meta.window.rows, self.meta.window.columns


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
