"""Piecewise cubic lane lines through the traced markings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float
from pydantic import Field
from scipy.interpolate import BSpline, make_lsq_spline

from datagen.lanes.path import Path
from datagen.lanes.trace import TracedLane
from lanenet.config import Settings

Side = Literal["left", "right"]


class FitSettings(Settings):
    """Spacing of the cubics and length of the gaps that they bridge, in camera heights."""

    knot_heights: float = Field(default=1.0, gt=0.0)
    bridge_heights: float = Field(default=4.0, gt=0.0)
    outlier_heights: float = Field(default=0.06, gt=0.0)


@dataclass(frozen=True)
class LaneLine:
    """One lane line: cubic B-splines x(s), y(s) over the position s along the driven path.

    Attributes:
        side: Left or right line of the driven lane.
        knots_cm: Knots in s, with the ends repeated.
        coefficients_cm: Control points, frame map.
        supported_cm: Stretches of s, (from, to), where the map has seen the line or bridges a gap.
        residual_cm: Robust standard deviation of the marking's middle about the fit.
    """

    side: Side
    knots_cm: Float[np.ndarray, "k"]
    coefficients_cm: Float[np.ndarray, "c 2"]
    supported_cm: Float[np.ndarray, "g 2"]
    residual_cm: float

    def points(self, s_cm: Float[np.ndarray, "m"]) -> Float[np.ndarray, "m 2"]:
        """Evaluate the line, [cm], frame map; NaN where it is not supported."""
        low, high = self.knots_cm[0], self.knots_cm[-1]
        spline = BSpline(self.knots_cm, self.coefficients_cm, 3)
        points = np.asarray(spline(np.clip(s_cm, low, high)))
        points[~self.supported(s_cm)] = np.nan
        return points

    def supported(self, s_cm: Float[np.ndarray, "m"]) -> Bool[np.ndarray, "m"]:
        """Tell where the line can be relied on."""
        inside = np.zeros(len(s_cm), dtype=bool)
        for start, end in self.supported_cm:
            inside |= (s_cm >= start) & (s_cm <= end)
        return inside

    def scaled(self, factor: float) -> LaneLine:
        """Return the line with every length multiplied."""
        return LaneLine(
            self.side,
            self.knots_cm * factor,
            self.coefficients_cm * factor,
            self.supported_cm * factor,
            self.residual_cm * factor,
        )


def fit_lines(path: Path, lane: TracedLane, camera_height_cm: float, settings: FitSettings) -> list[LaneLine]:
    """Fit both lines of the driven lane.

    Where one line has a gap, the other one, a lane's width away, guides the cubic through it with a small
    weight; the gap only counts as supported when it is short.
    """
    width = _smooth_width(lane)
    left_guide = np.where(np.isfinite(lane.right_cm), lane.right_cm + width, lane.centre_cm + 0.5 * width)
    right_guide = np.where(np.isfinite(lane.left_cm), lane.left_cm - width, lane.centre_cm - 0.5 * width)
    return [
        _fit_line("left", path, lane.left_cm, left_guide, camera_height_cm, settings),
        _fit_line("right", path, lane.right_cm, right_guide, camera_height_cm, settings),
    ]


def _smooth_width(lane: TracedLane) -> Float[np.ndarray, "m"]:
    """Lane width along the path: interpolated where one line is missing."""
    both = lane.left_cm - lane.right_cm
    known = np.isfinite(both) & (np.abs(both - lane.lane_cm) < 0.25 * lane.lane_cm)
    if not known.any():
        return np.full(len(both), lane.lane_cm)
    index = np.arange(len(both))
    return np.interp(index, index[known], both[known])


def _fit_line(
    side: Side,
    path: Path,
    offset_cm: Float[np.ndarray, "m"],
    guide_cm: Float[np.ndarray, "m"],
    camera_height_cm: float,
    settings: FitSettings,
) -> LaneLine:
    seen = np.isfinite(offset_cm)
    points = path.points(np.where(seen, offset_cm, guide_cm))
    s = path.s_cm
    spacing = settings.knot_heights * camera_height_cm
    inner = np.linspace(s[0], s[-1], max(2, int((s[-1] - s[0]) / spacing)) + 1)[1:-1]
    knots = np.concatenate([np.full(4, s[0]), inner, np.full(4, s[-1])])
    weight = np.where(seen, 1.0, 0.1)
    scale = settings.outlier_heights * camera_height_cm
    for _ in range(4):
        spline = make_lsq_spline(s, points, knots, 3, w=weight)
        # Only the distance across the path matters: along it, a line's points slide freely.
        across = np.sum((points - np.asarray(spline(s))) * path.left, axis=1)
        weight = np.where(seen, 1.0, 0.1) / (1.0 + (across / scale) ** 2)
    trusted = seen & (np.abs(across) < 4.0 * scale)
    residual = float(1.4826 * np.median(np.abs(across[trusted]))) if trusted.any() else float("nan")
    supported = _supported_stretches(s, trusted, settings.bridge_heights * camera_height_cm)
    return LaneLine(side, knots, np.asarray(spline.c), supported, residual)


def _supported_stretches(
    s_cm: Float[np.ndarray, "m"], seen: Bool[np.ndarray, "m"], bridge_cm: float
) -> Float[np.ndarray, "g 2"]:
    """Stretches between seen samples whose gaps are no longer than the bridge."""
    at = s_cm[seen]
    if at.size < 2:
        return np.empty((0, 2))
    cuts = np.flatnonzero(np.diff(at) > bridge_cm)
    starts = np.concatenate([[0], cuts + 1])
    ends = np.concatenate([cuts, [len(at) - 1]])
    stretches = np.stack([at[starts], at[ends]], axis=1)
    # A stretch shorter than a bridge between two gaps is as likely clutter as line.
    return stretches[stretches[:, 1] - stretches[:, 0] > 0.5 * bridge_cm]
