"""Sections of straight pieces of tape in place of parts of a line, and the line put together anew."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from datagen.lanes.offset import CubicBasis
from lanenet.data.maps.line import LaneLine

#: Length over which the line goes over to a chain, and of agreement within which it does not go back, in
#: camera heights. Chosen: as long as the shortest piece.
BLEND = 0.6
#: Shortest cubic beside a corner, in camera heights. Chosen: as where bends are tight, or shorter.
_LEAST_CUBIC = 0.2
#: Distance from its pieces and the fitted line, in camera heights, from which a line that was put together
#: anew has strayed: its cubics may swing between knots that are close together. Measured: good ones keep
#: below 0.15, one that swung out by 10 cm had 0.6.
_STRAYED = 0.2
#: Samples per cubic with which a line is put together.
_SAMPLES = 8


@dataclass(frozen=True)
class Section:
    """Straight pieces that take the place of a line from one position along it to another.

    Attributes:
        s_cm: Positions where the pieces begin, where they are fully taken, of their corners, and likewise to
            their end; the first lies within the lap.
        points_cm: Points at these positions, frame map.
        better: Number of places that lie on the marking, compared with the fitted line.
    """

    s_cm: Float[np.ndarray, "k"]
    points_cm: Float[np.ndarray, "k 2"]
    better: int

    @property
    def corners_cm(self) -> Float[np.ndarray, "c"]:
        """Positions of its corners."""
        return self.s_cm[2:-2]

    def past(self, s_cm: Float[np.ndarray, "m"], period_cm: float | None) -> Float[np.ndarray, "m"]:
        """Distance of positions from its beginning; on a lap, up to the next time round."""
        past = s_cm - self.s_cm[0]
        return past if period_cm is None else np.mod(past, period_cm)

    def beside_seam(self, low_cm: float, period_cm: float | None, apart_cm: float) -> Section:
        """The same with its corners no nearer to the seam of a lap, where knots are simple."""
        if period_cm is None:
            return self
        off = np.mod(self.corners_cm - low_cm + 0.5 * period_cm, period_cm) - 0.5 * period_cm
        moved = np.where(np.abs(off) < apart_cm, np.copysign(apart_cm, off) - off, 0.0)
        return replace(self, s_cm=np.concatenate([self.s_cm[:2], self.corners_cm + moved, self.s_cm[-2:]]))

    def overlaps(self, other: Section, period_cm: float | None) -> bool:
        """Whether both take the place of the same part of a line."""
        starts = [one.past(two.s_cm[:1], period_cm)[0] for one, two in ((self, other), (other, self))]
        lengths = [one.s_cm[-1] - one.s_cm[0] for one in (self, other)]
        return any(0.0 <= start <= length for start, length in zip(starts, lengths, strict=True))

    def strayed(self, found: LaneLine, line: LaneLine, height_cm: float) -> bool:
        """Whether a line that was put together anew is not where the pieces and the fitted line have it."""
        if (np.diff(self.s_cm) <= 0.0).any():
            return True
        margin_cm = BLEND * height_cm
        s_cm = np.arange(self.s_cm[0] - margin_cm, self.s_cm[-1] + margin_cm, 0.5 * _STRAYED * height_cm)
        wanted = cKDTree(self.blended(s_cm, line.everywhere(s_cm)))
        apart_cm = np.asarray(wanted.query(found.everywhere(s_cm))[0])
        return bool(apart_cm.max() > _STRAYED * height_cm)

    def blended(
        self, s_cm: Float[np.ndarray, "m"], line_cm: Float[np.ndarray, "m 2"]
    ) -> Float[np.ndarray, "m 2"]:
        """Points of the line with the pieces, at positions from its beginning on."""
        pieces = np.stack([np.interp(s_cm, self.s_cm, self.points_cm[:, i]) for i in range(2)], axis=1)
        share = np.interp(s_cm, self.s_cm[[0, 1, -2, -1]], [0.0, 1.0, 1.0, 0.0])[:, None]
        return line_cm + share * (pieces - line_cm)


def through(line: LaneLine, sections: list[Section], height_cm: float) -> LaneLine:
    """Put a line together anew, with a triple knot at each corner."""
    low, high = line.span_cm
    apart_cm = _LEAST_CUBIC * height_cm
    sections = [section.beside_seam(low, line.period_cm, 0.25 * apart_cm) for section in sections]
    kinks = [in_lap(s, low, line.period_cm) for section in sections for s in section.corners_cm.tolist()]
    breaks = line.knots_cm[3:-3]
    for section in sections:
        past = section.past(breaks, line.period_cm)
        breaks = breaks[(past <= 0.0) | (past >= section.s_cm[-1] - section.s_cm[0])]
        ends = [in_lap(section.s_cm[i], low, line.period_cm) for i in (0, 1, -2, -1)]
        breaks = np.concatenate([breaks, ends])
    kept = [low, high, *kinks]
    for at in np.sort(breaks).tolist():
        if min(abs(at - other) for other in kept) > apart_cm and low < at < high:
            kept.append(at)
    basis = CubicBasis(np.sort(np.array(kept + 2 * kinks)), line.period_cm is not None)
    simple = np.sort(np.array(kept))
    share = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
    s_cm = (simple[:-1, None] + share * np.diff(simple)[:, None]).ravel()
    points, sigma_cm = line.everywhere(s_cm), line.sigma_at_cm.copy()
    supported = line.supported_cm
    known = line.supported(line.sigma_s_cm)
    usual_cm = float(np.median(sigma_cm[known])) if known.any() else np.inf
    for section in sections:
        begin, taken, left, end = section.s_cm[[0, 1, -2, -1]]
        past = section.past(s_cm, line.period_cm)
        inside = (past >= 0.0) & (past <= end - begin)
        points[inside] = section.blended(begin + past[inside], points[inside])
        # The pieces are held by their borders as the rest of the line is by its own.
        past = section.past(line.sigma_s_cm, line.period_cm)
        inside = (past >= taken - begin) & (past <= left - begin)
        sigma_cm[inside] = np.minimum(sigma_cm[inside], usual_cm)
        if not line.supported(np.linspace(begin, end, _SAMPLES)).all():
            supported = np.concatenate([supported, [[taken, left]]])
    return replace(
        line,
        knots_cm=basis.knots_cm,
        coefficients_cm=basis.unfolded(basis.fitted(s_cm, points)),
        supported_cm=supported,
        sigma_at_cm=sigma_cm,
    )


def in_lap(s_cm: float, low_cm: float, period_cm: float | None) -> float:
    """The same position within the lap."""
    return s_cm if period_cm is None else low_cm + (s_cm - low_cm) % period_cm
