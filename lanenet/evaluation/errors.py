"""Errors in cm: per point, row and side, by condition of the frame; and whether sigma and presence fit."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from lanenet.geometry.lane import N_POINTS, PARABOLA_FROM_POINTS, POINT_NAMES, ROWS_CM, SIDES

#: By condition: what its groups mean, and name and lower limit of each; the last one has no upper limit. The
#: limits are chosen: sharp bends, light and distances as they occur on model roads.
GROUPS: dict[str, tuple[str, tuple[tuple[str, float], ...]]] = {
    "bend": (
        "radius of the lane at y = 15 cm",
        (("over 3 m", 0.0), ("1 to 3 m", 1.0 / 300.0), ("under 1 m", 0.01)),
    ),
    "lines": (
        "lines of the lane that the frame shows",
        (("none", 0.0), ("partly", 0.5), ("one", 1.0), ("both", 2.0)),
    ),
    # The car's limits: lanenet.onboard.safety.SafetySettings.
    "confidence": (
        "confidence of the first detector (a car slows down below 0.5 and stops below 0.2)",
        (("under 0.2", 0.0), ("0.2 to 0.5", 0.2), ("over 0.5", 0.5)),
    ),
    "light": (
        "mean grey level of the frame, 0 to 255",
        (("under 60", 0.0), ("60 to 140", 60.0), ("over 140", 140.0)),
    ),
    "place": (
        "distance to the nearest pose of the training frames of the same map, cm",
        (("under 2 cm", 0.0), ("2 to 5 cm", 2.0), ("5 to 15 cm", 5.0), ("over 15 cm", 15.0)),
    ),
}
#: Intervals of a normal distribution by the share within them, in sigmas to each side.
INTERVALS = {"68": 1.0, "95": 1.959964}
#: Of the reliability diagram: sigmas, and the share of a normal distribution within them.
RELIABILITY_SIGMAS = (0.1257, 0.2533, 0.3853, 0.5244, 0.6745, 0.8416, 1.0364, 1.2816, 1.6449, 1.96, 2.5758)
RELIABILITY_SHARES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99)

#: Frames of a segment, where there are too few drives to draw from. Chosen: two seconds at 20 frames/s.
SEGMENT_FRAMES = 40
#: Draws of the bootstrap. Chosen: the ends of a 95 % interval are then right to some per cent of its width.
_RESAMPLES = 2000
#: Fewer drives or segments give no interval. Chosen.
_FEWEST = 3
#: From this probability on a line counts as predicted.
_LIKELY = 0.5
_MIDDLE_ROW = 1


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


@dataclass(frozen=True)
class PresenceStats:
    """How well a detector predicts whether lines can be seen; from a probability of 0.5 on it predicts one.

    Attributes:
        precision: Share of the predicted lines that can be seen.
        recall: Share of the lines that can be seen and are predicted.
        absent_recall: Share of the absent lines that are not predicted.
        there: Lines that can be seen.
        absent: Lines that cannot.
    """

    precision: float
    recall: float
    absent_recall: float
    there: int
    absent: int


@dataclass(frozen=True)
class SigmaStats:
    """Whether a detector's sigmas are right.

    Attributes:
        coverage: By interval (``68``, ``95``): the share of the errors within it.
        reliability: Share of the errors within each of ``RELIABILITY_SIGMAS`` sigmas.
        median_sigma_cm: Median of the predicted sigmas.
        count: Points with a label, an answer and a sigma.
    """

    coverage: dict[str, float]
    reliability: tuple[float, ...]
    median_sigma_cm: float
    count: int

    def as_dict(self) -> dict[str, object]:
        """Return plain values for JSON."""
        return {
            **{f"coverage_{name}": share for name, share in self.coverage.items()},
            "reliability": list(self.reliability),
            "median_sigma_cm": self.median_sigma_cm,
            "count": self.count,
        }


def lane_curvature(points_cm: Float[np.ndarray, "n 6"]) -> Float[np.ndarray, "n"]:
    """Return the absolute curvature of the lane at y = 15 cm, [1/cm]; NaN where no line has three labels.

    Source:
        Curvature of a graph: |x''| / (1 + x'^2)^1.5; the mean of the lines that have all three labels.
    """
    a, b, _ = np.moveaxis(points_cm.reshape(-1, 2, len(ROWS_CM)) @ PARABOLA_FROM_POINTS.T, -1, 0)
    slope = 2.0 * a * ROWS_CM[_MIDDLE_ROW] + b
    curvature = 2.0 * a / (1.0 + slope * slope) ** 1.5
    known = np.isfinite(curvature)
    total = np.where(known, curvature, 0.0).sum(axis=1)
    with np.errstate(invalid="ignore"):
        return np.abs(np.where(known.any(axis=1), total / known.sum(axis=1), np.nan))


def lines_shown(visible: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
    """Return how many lines frames show: a section that is too short to count as seen is half a line."""
    shown: Float[np.ndarray, "n"] = np.where(np.isfinite(visible), visible, 0.5).sum(axis=1)
    return np.where(np.isfinite(visible).any(axis=1), shown, np.nan)


def errors_by_group(
    condition: str, values: Float[np.ndarray, "n"], errors_cm: Float[np.ndarray, "n 6"], labelled: np.ndarray
) -> dict[str, ErrorStats]:
    """Summarise errors by groups of frames; frames whose condition is unknown (NaN) belong to none.

    Args:
        condition: One of ``GROUPS``.
        values: Of each frame.
        errors_cm: Absolute errors, NaN without a label or an answer.
        labelled: True where there is a label.
    """
    names, limits = zip(*GROUPS[condition][1], strict=True)
    with np.errstate(invalid="ignore"):
        group = np.where(np.isfinite(values), np.searchsorted(limits, values, side="right") - 1, -1)
    result = {}
    for k, name in enumerate(names):
        rows = group == k
        result[name] = error_stats(errors_cm[rows], np.isfinite(errors_cm[rows]), labelled[rows])
    return result


def rmse_interval_cm(
    errors_cm: Sequence[Float[np.ndarray, "_ 6"]], rng: np.random.Generator
) -> tuple[float, float] | None:
    """Return the 95 % interval of the RMSE over drives like these, by bootstrap over drives or segments.

    Neighbouring frames are alike, so that drawing frames would give an interval that is far too narrow.

    Args:
        errors_cm: Absolute errors of each drive or segment, see :func:`bootstrap_segments`.
        rng: Source of randomness.

    Returns:
        Lower and upper end, [cm]; None for fewer than three drives with an answer.
    """
    squares = [float(np.nansum(e * e)) for e in errors_cm]
    ends = share_interval(squares, [float(np.isfinite(e).sum()) for e in errors_cm], rng)
    return None if ends is None else (math.sqrt(ends[0]), math.sqrt(ends[1]))


def share_interval(
    parts: Sequence[float], wholes: Sequence[float], rng: np.random.Generator
) -> tuple[float, float] | None:
    """Return the 95 % interval of a ratio of sums over drives, by bootstrap over the drives.

    Args:
        parts: Numerator of each drive or segment.
        wholes: Denominator; those of 0 do not count.
        rng: Source of randomness.

    Returns:
        Lower and upper end; None for fewer than three drives that count.
    """
    part, whole = np.asarray(parts), np.asarray(wholes)
    part, whole = part[whole > 0.0], whole[whole > 0.0]
    n = len(whole)
    if n < _FEWEST:
        return None
    times = rng.multinomial(n, np.full(n, 1.0 / n), _RESAMPLES)
    low, high = np.percentile((times @ part) / (times @ whole), [2.5, 97.5])
    return float(low), float(high)


def bootstrap_segments(frames: Sequence[int]) -> tuple[Int[np.ndarray, "_"], str]:
    """Return what the bootstrap draws: whole drives, or if there are too few, segments of them.

    Segments of a single drive show the effect of chance on this road, not what another road would bring.

    Args:
        frames: Number of frames of each drive, in their order.

    Returns:
        Where to cut, by frame, and what is drawn, in words.
    """
    ends = np.cumsum(np.asarray(frames, np.int64))
    if len(ends) >= _FEWEST:
        return ends[:-1], "drives like these"
    starts = ends - np.asarray(frames, np.int64)
    cuts = [
        np.append(np.arange(a + SEGMENT_FRAMES, b - SEGMENT_FRAMES // 2, SEGMENT_FRAMES), b)
        for a, b in zip(starts, ends, strict=True)
    ]
    return np.concatenate(cuts)[:-1], f"segments of {SEGMENT_FRAMES} frames"


def sigma_stats(errors_cm: Float[np.ndarray, "n 6"], sigma_cm: Float[np.ndarray, "n 6"]) -> SigmaStats | None:
    """Compare sigmas with errors; None where the detector predicts none."""
    known = np.isfinite(errors_cm) & np.isfinite(sigma_cm)
    if not known.any():
        return None
    ratio = errors_cm[known] / np.maximum(sigma_cm[known], 1e-9)
    return SigmaStats(
        coverage={name: float(np.mean(ratio <= sigmas)) for name, sigmas in INTERVALS.items()},
        reliability=tuple(float(np.mean(ratio <= sigmas)) for sigmas in RELIABILITY_SIGMAS),
        median_sigma_cm=float(np.median(sigma_cm[known])),
        count=int(known.sum()),
    )


def presence_stats(
    presence: Float[np.ndarray, "n 2"], visible: Float[np.ndarray, "n 2"]
) -> PresenceStats | None:
    """Compare probabilities of lines with which lines can be seen; None where nothing is known."""
    known = np.isfinite(presence) & np.isfinite(visible)
    if not known.any():
        return None
    said, there = presence[known] >= _LIKELY, visible[known] > 0.5

    def share(part: np.ndarray, whole: np.ndarray) -> float:
        return float((part & whole).sum() / whole.sum()) if whole.any() else float("nan")

    return PresenceStats(
        precision=share(there, said),
        recall=share(said, there),
        absent_recall=share(~said, ~there),
        there=int(there.sum()),
        absent=int((~there).sum()),
    )


@dataclass(frozen=True)
class Breakdown:
    """What a comparison finds beyond its errors.

    Attributes:
        groups: By condition and detector, the errors of each group of frames.
        interval_cm: By detector, the 95 % interval of its RMSE; None where the frames are too few.
        interval_over: What the intervals are over, in words: drives, or segments of one or two drives.
        sigma: By detector that predicts sigmas.
        presence: By detector that predicts which lines can be seen.
    """

    groups: Mapping[str, Mapping[str, Mapping[str, ErrorStats]]]
    interval_cm: Mapping[str, tuple[float, float] | None]
    interval_over: str
    sigma: Mapping[str, SigmaStats]
    presence: Mapping[str, PresenceStats]

    def of(self, detector: str) -> dict[str, object]:
        """Return plain values for JSON of one detector."""
        sigma, presence = self.sigma.get(detector), self.presence.get(detector)
        interval = self.interval_cm[detector]
        return {
            "rmse_95_interval_cm": None if interval is None else list(interval),
            "rmse_95_interval_over": self.interval_over,
            "doubt": None if sigma is None else sigma.as_dict(),
            "presence": None if presence is None else vars(presence),
            "conditions": {
                condition: {name: stats.as_dict() for name, stats in by_detector[detector].items()}
                for condition, by_detector in self.groups.items()
            },
        }
