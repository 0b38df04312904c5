"""A lane line on the map: a piecewise cubic with support and uncertainty along its length."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import BSpline

Side = Literal["left", "right"]

#: Share of a line that is bare from which it is dashed. On ten simulated drives and three real ones, 0.18 to
#: 0.47 of every dashed line and no more than 0.09 of every solid one, worn or not, was bare.
_DASHED = 0.12


def _none() -> Float[np.ndarray, "0"]:
    return np.empty(0)


@dataclass(frozen=True)
class LaneLine:
    """One lane line: cubic B-splines x(s), y(s) over the position s along the path.

    Attributes:
        side: On which side of the driven lane it lies, seen in the path's direction.
        knots_cm: Knots in s, with three more on either side of the first and last break.
        coefficients_cm: Control points, frame map.
        supported_cm: Stretches of s, (from, to), where the map has seen the line or bridges a gap; on a lap
            a stretch over the seam ends beyond the period.
        residual_cm: Robust standard deviation of the marking's borders about the fit.
        rank: 0 for the line that bounds the driven lane, 1 for the next one outwards.
        period_cm: Length of the lap where the line is closed; None where it is open.
        sigma_s_cm: Places at which the uncertainty is given; empty where it is not known.
        sigma_at_cm: Standard deviation of the line's position across the path there.
        marking_cm: Width of the marking as measured; NaN where it is not known.
        bare: Share of the line that is bare between pieces of paint, where frames see it from near; NaN
            where it is not known.
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
    bare: float = float("nan")

    @property
    def index(self) -> int:
        """Number of the line from left to right; 0 and 1 bound the driven lane."""
        return -self.rank if self.side == "left" else 1 + self.rank

    @property
    def dashed(self) -> bool:
        """Whether it is a line of dashes, which may be crossed: there is a lane on either side of it."""
        return self.bare > _DASHED

    def points(self, s_cm: Float[np.ndarray, "m"], derivative: int = 0) -> Float[np.ndarray, "m 2"]:
        """Evaluate the line or a derivative of it along s, frame map; NaN where it is not supported."""
        points = self.everywhere(s_cm, derivative)
        points[~self.supported(s_cm)] = np.nan
        return points

    def everywhere(self, s_cm: Float[np.ndarray, "m"], derivative: int = 0) -> Float[np.ndarray, "m 2"]:
        """Evaluate the line, also where nothing supports it."""
        low, high = self.knots_cm[3], self.knots_cm[-4]
        spline = BSpline(self.knots_cm, self.coefficients_cm, 3)
        s = np.clip(s_cm, low, high) if self.period_cm is None else low + np.mod(s_cm - low, self.period_cm)
        return np.array(spline(s, nu=derivative))

    def supported(self, s_cm: Float[np.ndarray, "m"]) -> Bool[np.ndarray, "m"]:
        """Tell where the line can be relied on."""
        inside = np.zeros(len(s_cm), dtype=bool)
        for start, end in self.supported_cm:
            if self.period_cm is None:
                inside |= (s_cm >= start) & (s_cm <= end)
            else:
                inside |= np.mod(s_cm - start, self.period_cm) <= end - start
        return inside

    def sigma_cm(self, s_cm: Float[np.ndarray, "m"]) -> Float[np.ndarray, "m"]:
        """Standard deviation of the line's position across the path; NaN where it is not known."""
        if not len(self.sigma_s_cm):
            return np.full(len(s_cm), np.nan)
        return np.interp(s_cm, self.sigma_s_cm, self.sigma_at_cm, period=self.period_cm)

    def scaled(self, factor: float) -> LaneLine:
        """Return the line with every length multiplied."""
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
        )
