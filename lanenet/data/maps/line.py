"""A lane line on the map: a piecewise cubic with support and uncertainty along its length."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import BSpline

Side = Literal["left", "right"]

#: Unpainted share above which a line is dashed. Measured on ten simulated and three real drives: 0.18 to 0.47
#: for dashed lines, at most 0.09 for solid ones, worn or not.
_DASHED_SHARE = 0.12
#: Positions at which the order of two lines is checked; chosen.
_SIDES_CHECKED = 64


def _none() -> Float[np.ndarray, "0"]:
    return np.empty(0)


def _no_sections() -> Float[np.ndarray, "0 2"]:
    return np.empty((0, 2))


@dataclass(frozen=True)
class LaneLine:
    """One lane line: cubic B-splines x(s), y(s) over the position s along the path.

    Where straight pieces of tape meet, it has a triple knot: a corner.

    Attributes:
        side: Side of the driven lane, seen in the path's direction.
        knots_cm: Knots in s, with three more on either side of the first and last break.
        coefficients_cm: Control points, frame map.
        supported_cm: Sections (from, to) of s where the map has seen the line or bridges a gap; on a lap, a
            section across the seam ends beyond the period.
        residual_cm: Robust standard deviation of the marking's borders about the fit; NaN if never seen.
        rank: 0 for the lines that bound the driven lane, 1 for the next ones outwards.
        period_cm: Length of the lap; None for an open line.
        sigma_s_cm: Positions at which sigma is given; empty if it is unknown.
        sigma_at_cm: Sigma of the line's position across the path there.
        marking_cm: Measured width of the marking; NaN if unknown.
        unpainted: Share of the line without paint, as near frames see it; NaN if unknown.
        contradicted_cm: Sections (from, to) of s along which the line is likely wrong, see
            :func:`datagen.quality.measure.wrong_sections`; as for support, one across the seam ends beyond
            the period.
        marking_at_cm: Width of the marking where sigma is given; empty if it is the same everywhere.
    """

    side: Side
    knots_cm: Float[np.ndarray, "k"]
    coefficients_cm: Float[np.ndarray, "c 2"]
    supported_cm: Float[np.ndarray, "g 2"]
    residual_cm: float
    rank: int = 0
    period_cm: float | None = None
    sigma_s_cm: Float[np.ndarray, "u"] = field(default_factory=_none)
    sigma_at_cm: Float[np.ndarray, "u"] = field(default_factory=_none)
    marking_cm: float = float("nan")
    unpainted: float = float("nan")
    contradicted_cm: Float[np.ndarray, "w 2"] = field(default_factory=_no_sections)
    marking_at_cm: Float[np.ndarray, "v"] = field(default_factory=_none)

    @property
    def index(self) -> int:
        """Number of the line, counted from left to right; 0 and 1 bound the driven lane."""
        return -self.rank if self.side == "left" else 1 + self.rank

    @property
    def span_cm(self) -> tuple[float, float]:
        """Positions at which the line begins and ends; of a lap, its seam."""
        return float(self.knots_cm[3]), float(self.knots_cm[-4])

    @property
    def dashed(self) -> bool:
        """Whether the line is dashed; then there is a lane on either side of it."""
        return self.unpainted > _DASHED_SHARE

    @property
    def kinks_cm(self) -> Float[np.ndarray, "n"]:
        """Positions where the line turns in a corner: its triple knots."""
        inner = self.knots_cm[4:-4]
        return np.unique(inner[2:][inner[2:] == inner[:-2]])

    def with_corners(self, s_cm: Float[np.ndarray, "m"]) -> Float[np.ndarray, "n"]:
        """Add the corners between increasing positions, which on a lap may go beyond the seam."""
        kinks = self.kinks_cm
        if not len(kinks) or not len(s_cm):
            return s_cm
        if self.period_cm is not None:
            laps = np.arange(np.floor(s_cm[0] / self.period_cm) - 1.0, s_cm[-1] / self.period_cm + 1.0)
            kinks = (kinks + self.period_cm * laps[:, None]).ravel()
        return np.union1d(s_cm, kinks[(kinks > s_cm[0]) & (kinks < s_cm[-1])])

    def points(self, s_cm: Float[np.ndarray, "m"], derivative: int = 0) -> Float[np.ndarray, "m 2"]:
        """Evaluate the line or a derivative along s, frame map; NaN where it is not supported."""
        points = self.everywhere(s_cm, derivative)
        points[~self.supported(s_cm)] = np.nan
        return points

    def everywhere(self, s_cm: Float[np.ndarray, "m"], derivative: int = 0) -> Float[np.ndarray, "m 2"]:
        """Evaluate the line or a derivative, also where it is not supported."""
        low, high = self.span_cm
        s = np.clip(s_cm, low, high) if self.period_cm is None else low + np.mod(s_cm - low, self.period_cm)
        return np.array(self._spline(s, nu=derivative))

    @cached_property
    def _spline(self) -> BSpline:
        """To be evaluated: making it takes longer than evaluating it for a frame."""
        return BSpline(self.knots_cm, self.coefficients_cm, 3)

    def lies_left_of(self, other: LaneLine) -> bool:
        """Return whether most of the line lies to the left of another one, seen in the path's direction.

        Where one of the two was not seen, its course is a guess and does not count; nor does all of it where
        they were never seen beside each other.
        """
        (low, high), (least, most) = self.span_cm, other.span_cm
        s_cm = np.linspace(max(low, least), min(high, most), _SIDES_CHECKED)
        across = self.everywhere(s_cm) - other.everywhere(s_cm)
        along = self.everywhere(s_cm, 1) + other.everywhere(s_cm, 1)
        to_left = along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]
        known = self.supported(s_cm) & other.supported(s_cm)
        return not known.any() or bool(np.median(to_left[known]) > 0.0)

    def supported(self, s_cm: Float[np.ndarray, "m"]) -> Bool[np.ndarray, "m"]:
        """Return which positions are supported."""
        return self._within(self.supported_cm, s_cm)

    def contradicted(self, s_cm: Float[np.ndarray, "m"]) -> Bool[np.ndarray, "m"]:
        """Return which positions the images contradict."""
        return self._within(self.contradicted_cm, s_cm)

    def _within(
        self, sections_cm: Float[np.ndarray, "g 2"], s_cm: Float[np.ndarray, "m"]
    ) -> Bool[np.ndarray, "m"]:
        inside = np.zeros(len(s_cm), dtype=bool)
        for start, end in sections_cm:
            if self.period_cm is None:
                inside |= (s_cm >= start) & (s_cm <= end)
            else:
                inside |= np.mod(s_cm - start, self.period_cm) <= end - start
        return inside

    def sigma_cm(self, s_cm: Float[np.ndarray, "m"]) -> Float[np.ndarray, "m"]:
        """Sigma of the line's position across the path; NaN if unknown."""
        if not len(self.sigma_s_cm):
            return np.full(len(s_cm), np.nan)
        return np.interp(s_cm, self.sigma_s_cm, self.sigma_at_cm, period=self.period_cm)

    def widths_cm(self, s_cm: Float[np.ndarray, "m"]) -> Float[np.ndarray, "m"]:
        """Width of the marking along s; NaN if unknown."""
        if not len(self.marking_at_cm):
            return np.full(len(s_cm), self.marking_cm)
        return np.interp(s_cm, self.sigma_s_cm, self.marking_at_cm, period=self.period_cm)

    def scaled(self, factor: float) -> LaneLine:
        """Return the line with every length multiplied by a factor."""
        return replace(
            self,
            knots_cm=self.knots_cm * factor,
            coefficients_cm=self.coefficients_cm * factor,
            supported_cm=self.supported_cm * factor,
            residual_cm=self.residual_cm * factor,
            period_cm=None if self.period_cm is None else self.period_cm * factor,
            sigma_s_cm=self.sigma_s_cm * factor,
            sigma_at_cm=self.sigma_at_cm * factor,
            marking_cm=self.marking_cm * factor,
            marking_at_cm=self.marking_at_cm * factor,
            contradicted_cm=self.contradicted_cm * factor,
        )
