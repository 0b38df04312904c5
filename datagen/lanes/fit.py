"""Fit piecewise cubic lane lines to the edges of the traced markings.

Distances between lines are measured across them, on the map. Where the lines run at an angle to the path, as
where the car cuts a corner, the difference of their offsets is longer: by one over the cosine of that angle.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from pydantic import Field
from scipy.ndimage import distance_transform_edt, gaussian_filter1d

from datagen.lanes.offset import (
    Borders,
    CubicBasis,
    FittedOffset,
    Prior,
    adapted_breaks,
    fit_offset,
    supported_sections,
)
from datagen.lanes.path import Path, PathEdges, SampleMask, Samples, left_of
from datagen.lanes.trace import TracedLane
from lanenet.config import Settings
from lanenet.data.maps.line import LaneLine, Side

_SIGN: dict[Side, float] = {"left": 1.0, "right": -1.0}
_OTHER: dict[Side, Side] = {"left": "right", "right": "left"}
#: Reach along the path in which the point opposite is looked for, in distances between the lines. Derived: at
#: an angle a between line and path it lies sin(a) distances ahead; the rest is margin.
_OPPOSITE_REACH = 1.2
#: Distances of two lines that may be those of a lane, in lane widths: it narrows, or is wider in bends.
_APART = (0.65, 1.5)
#: Factor between the lengths over which it is measured how much a lane's width changes. Chosen: fine enough
#: for what is interpolated between them.
_LONGER = 1.4


class FitSettings(Settings):
    """Spacing of the cubics and the gaps that they bridge; lengths in camera heights where the name says so.

    Where no other origin is given, values were chosen on simulated drives.

    Attributes:
        knot_heights: Length of a cubic on straight road.
        corner_heights: Length of a cubic in tight bends (a study of three recorded drives found 0.3).
        bridge_heights: Longest gap in the paint that is bridged; where the line on the other side of the lane
            is seen, gaps count for less than half.
        extend_heights: Extension of a line beyond the end of its paint.
        reach_heights: Largest distance of edge points from the borders of the traced line, beyond 0.3 widths
            of the marking.
        bend_heights: Typical bend of a line against the path: inverse radius times camera height.
        guide_lanes: Least sigma of a line's distance from the other one, in lane widths; the variation where
            both are seen counts if it is larger.
        loose_lanes: Sigma of the lane where neither of its lines is seen, in lane widths.
        precise_heights: Distance at which an edge point has half its precision. One pixel spans road in
            proportion to the squared distance, and tilt errors move points likewise.
        min_aligned: Least cosine between a border and the traced line, 20 degrees: a line is not followed
            into the mouth of a junction.
    """

    knot_heights: float = Field(default=0.6, gt=0.0)
    corner_heights: float = Field(default=0.3, gt=0.0)
    bridge_heights: float = Field(default=7.0, gt=0.0)
    extend_heights: float = Field(default=0.5, ge=0.0)
    reach_heights: float = Field(default=0.06, gt=0.0)
    bend_heights: float = Field(default=0.08, gt=0.0)
    guide_lanes: float = Field(default=0.03, gt=0.0)
    loose_lanes: float = Field(default=0.3, gt=0.0)
    precise_heights: float = Field(default=1.5, gt=0.0)
    min_aligned: float = Field(default=0.94, gt=0.0, lt=1.0)


def fit_lines(
    path: Path,
    edges: PathEdges,
    lane: TracedLane,
    camera_height_cm: float,
    settings: FitSettings,
    adjacent_edges: PathEdges | None = None,
) -> list[LaneLine]:
    """Fit the lines of the driven lane, then those of adjacent lanes.

    Each line is first fitted alone. Where it has a gap and the other line has none, the other line then
    guides it through the gap: at the distance that the two keep elsewhere, and with the same bends.

    Args:
        path: The path.
        edges: Edge points in its coordinates.
        lane: The traced lines.
        camera_height_cm: Sets the scale of knots and bounds.
        settings: Spacing and bounds.
        adjacent_edges: Edge points for the lines of adjacent lanes; None for the same.

    Returns:
        Left and right line of the driven lane, then those of adjacent lanes.
    """
    widest = settings.knot_heights * camera_height_cm
    narrowest = settings.corner_heights * camera_height_cm
    basis = CubicBasis(adapted_breaks(_curvature(path), path.step_cm, widest, narrowest), path.closed)
    fitter = _Fitter(path, edges, basis, lane.lane_cm, camera_height_cm, settings)
    traced: dict[tuple[Side, int], Samples] = {
        ("left", 0): lane.left_cm,
        ("right", 0): lane.right_cm,
        **lane.adjacent_cm,
    }
    # A line seen only from afar does not show its width; so the width of the best seen line is used for all.
    first: Side = "left" if np.isfinite(lane.left_cm).sum() >= np.isfinite(lane.right_cm).sum() else "right"
    alone: dict[Side, FittedOffset] = {}
    tape = lane.tape_cm
    for side in (first, _OTHER[first]):
        by_centre = lane.centre_cm + 0.5 * _SIGN[side] * lane.lane_cm
        alone[side] = fitter.alone(traced[side, 0], by_centre, tape)
        tape = alone[first].marking_cm
    apart = fitter.apart(alone["right"].d_cm, alone["left"].d_cm, alone["right"].seen & alone["left"].seen)
    fitted: dict[tuple[Side, int], FittedOffset] = {}
    for side, own in alone.items():
        start = np.where(own.seen, own.d_cm, np.nan)
        fitted[side, 0] = fitter.parallel(start, alone[_OTHER[side]], _SIGN[side], apart, own.marking_cm)
    fitter = fitter if adjacent_edges is None else replace(fitter, edges=adjacent_edges)
    for side, rank in sorted(lane.adjacent_cm, key=lambda name: name[1]):
        inner, known = fitted[side, rank - 1], np.isfinite(traced[side, rank])
        apart = fitter.apart(inner.d_cm, np.where(known, traced[side, rank], inner.d_cm), known)
        fitted[side, rank] = fitter.parallel(traced[side, rank], inner, _SIGN[side], apart, tape)
    lines = []
    for side, rank in sorted(fitted, key=lambda name: (name[1], name[0])):
        guide = fitted[(side, rank - 1) if rank else (_OTHER[side], 0)]
        lines.append(fitter.line(side, rank, fitted[side, rank], guide.seen))
    return lines


@dataclass(frozen=True)
class _Fitter:
    """What the fits of all lines share."""

    path: Path
    edges: PathEdges
    basis: CubicBasis
    lane_cm: float
    height_cm: float
    settings: FitSettings

    def alone(self, traced_cm: Samples, guess_cm: Samples, tape_cm: float) -> FittedOffset:
        """Fit a line from its trace alone; the guess fills the gaps of the trace."""
        start = np.where(np.isfinite(traced_cm), traced_cm, guess_cm)
        loose = np.full(len(start), self.settings.loose_lanes * self.lane_cm)
        return self._fit(start, self._smoothed(start), np.zeros(len(start)), loose, tape_cm)

    def parallel(
        self,
        known_cm: Samples,
        other: FittedOffset,
        sign: float,
        apart: tuple[Samples, Samples],
        tape_cm: float,
    ) -> FittedOffset:
        """Fit a line that runs to the left (sign 1) or to the right (-1) of a fitted one."""
        guess = parallel_offset(self.path, self._smoothed(other.d_cm), sign * apart[0])
        sigma = np.where(
            other.seen, np.hypot(apart[1], other.sigma_cm), self.settings.loose_lanes * self.lane_cm
        )
        start = np.where(np.isfinite(known_cm), known_cm, guess)
        return self._fit(start, guess, guess, sigma, tape_cm)

    def apart(self, inner_cm: Samples, outer_cm: Samples, known: SampleMask) -> tuple[Samples, Samples]:
        """Distance of two lines, smoothed and interpolated in gaps, and the sigma of that."""
        path, lane_cm = self.path, self.lane_cm
        least = self.settings.guide_lanes * lane_cm
        inner, outer = self._smoothed(inner_cm), self._smoothed(outer_cm)
        found = distance_across(path, inner, outer, known)
        good = known & (found > _APART[0] * lane_cm) & (found < _APART[1] * lane_cm)
        if not good.any():
            loose = self.settings.loose_lanes * lane_cm
            return np.full(len(found), lane_cm), np.full(len(found), loose)
        filled = np.interp(path.s_cm, path.s_cm[good], found[good], period=path.period_cm)
        varies = 1.4826 * float(np.median(np.abs(found[good] - np.median(found[good]))))
        sigma = np.maximum(interpolation_error(path, np.where(good, found, np.nan)), max(varies, least))
        return _smoothed(path, filled, 0.5 * lane_cm), sigma

    def line(self, side: Side, rank: int, offset: FittedOffset, guided: SampleMask) -> LaneLine:
        """Turn an offset into a line on the map; ``guided`` is where a parallel line is seen."""
        path, basis = self.path, self.basis
        control = basis.fitted(path.s_cm, path.points(offset.d_cm))
        bridge = self.settings.bridge_heights * self.height_cm
        extend = self.settings.extend_heights * self.height_cm
        return LaneLine(
            side=side,
            knots_cm=basis.knots_cm,
            coefficients_cm=basis.unfolded(control),
            supported_cm=supported_sections(path, offset.seen, bridge, extend, guided),
            residual_cm=offset.residual_cm,
            rank=rank,
            period_cm=path.period_cm,
            sigma_s_cm=path.s_cm,
            sigma_at_cm=offset.sigma_cm,
            marking_cm=offset.marking_cm,
            unpainted=offset.unpainted,
        )

    def _smoothed(self, d_cm: Samples) -> Samples:
        return _smoothed(self.path, d_cm, 0.25 * self.lane_cm)

    def _fit(
        self, start_cm: Samples, guess_cm: Samples, shape_cm: Samples, sigma_cm: Samples, tape_cm: float
    ) -> FittedOffset:
        smooth = self._smoothed(start_cm)
        prior = Prior(
            guess_cm=guess_cm,
            shape_cm=shape_cm,
            sigma_cm=sigma_cm,
            lane_cm=self.lane_cm,
            bend_per_cm=self.settings.bend_heights / self.height_cm,
            knot_cm=self.settings.knot_heights * self.height_cm,
            height_cm=self.height_cm,
        )
        points = self._borders(start_cm, smooth, tape_cm)
        return fit_offset(self.path, self.basis, points, smooth, tape_cm, prior)

    def _borders(self, start_cm: Samples, smooth_cm: Samples, tape_cm: float) -> Borders:
        """Edge points that may be borders of the marking whose middle is near the given offset."""
        path, edges, settings = self.path, self.edges, self.settings
        # The left border of a bright marking brightens to the right.
        border = np.where(edges.side < 0.0, 1.0, -1.0)
        off = edges.d_cm - np.interp(edges.s_cm, path.s_cm, start_cm, period=path.period_cm)
        reach = 0.3 * tape_cm + settings.reach_heights * self.height_cm
        row = np.clip((edges.s_cm / path.step_cm).astype(np.intp), 0, len(start_cm) - 1)
        slope = (_change(path, smooth_cm) / path.step_cm)[row]
        aligned = -border * (edges.side - slope * edges.along) / np.hypot(1.0, slope)
        near = (aligned >= settings.min_aligned) & (np.abs(off - 0.5 * border * tape_cm) < reach)
        distance = edges.distance_cm[near] / (settings.precise_heights * self.height_cm)
        return Borders(
            s_cm=edges.s_cm[near],
            d_cm=edges.d_cm[near],
            border=border[near],
            weight=edges.weight[near],
            precision=1.0 / (1.0 + distance**6),
            frame=edges.frame[near],
        )


def parallel_offset(path: Path, d_cm: Samples, apart_cm: Samples) -> Samples:
    """Offset from the path of the line parallel to another one.

    Inside a corner the parallel runs back and crosses itself; its loop is left out.

    Args:
        path: The path.
        d_cm: Smooth offset of the known line at each path sample.
        apart_cm: Distance of the parallel to its left; negative to its right.
    """
    line = path.points(d_cm)
    parallel = line + apart_cm[:, None] * left_of(_change(path, line))
    rows = _around(path, float(np.abs(apart_cm).max()))
    nearest = np.argmin(np.sum((path.xy_cm[rows] - parallel[:, None]) ** 2, axis=2), axis=1)
    at = rows[np.arange(len(rows)), nearest]
    step = parallel - path.xy_cm[at]
    ahead = step[:, 0] * path.left[at, 1] - step[:, 1] * path.left[at, 0]
    offset = np.sum(step * path.left[at], axis=1)
    s = path.s_cm[at] + ahead
    order = np.argsort(s, kind="stable")
    found = np.interp(path.s_cm, s[order], offset[order], period=path.period_cm)
    ends = s, offset
    if path.period_cm is not None:
        half = 0.5 * path.period_cm
        s = path.s_cm + np.mod(s - path.s_cm + half, path.period_cm) - half
        ends = np.append(s, s[0] + path.period_cm), np.append(offset, offset[0])
    if (np.diff(ends[0]) > 0.0).all():
        return found
    sign = 1.0 if float(np.median(apart_cm)) > 0.0 else -1.0
    outer = _outermost(path, ends[0], sign * ends[1])
    return np.where(np.isfinite(outer), sign * outer, found)


def _outermost(path: Path, s_cm: Float[np.ndarray, "k"], offset_cm: Float[np.ndarray, "k"]) -> Samples:
    """Largest offset at each path sample of a line that may run back; NaN where it does not pass."""
    m, step = len(path.xy_cm), path.step_cm
    outer = np.full(m, -np.inf)
    for k in range(len(s_cm) - 1):
        low, high = sorted((s_cm[k], s_cm[k + 1]))
        rows = np.arange(int(np.ceil(low / step)), int(np.floor(high / step)) + 1)
        if not path.closed:
            rows = rows[(rows >= 0) & (rows < m)]
        if not rows.size:
            continue
        share = (rows * step - s_cm[k]) / (s_cm[k + 1] - s_cm[k] or 1.0)
        there = offset_cm[k] + share * (offset_cm[k + 1] - offset_cm[k])
        outer[rows % m] = np.maximum(outer[rows % m], there)
    return np.where(np.isfinite(outer), outer, np.nan)


def distance_across(path: Path, from_cm: Samples, to_cm: Samples, known: SampleMask) -> Samples:
    """Distance from each sample of a line to another line; NaN where that is unknown opposite.

    Args:
        path: The path.
        from_cm: Offset of the first line at each path sample.
        to_cm: Offset of the second one.
        known: Where the second one is known.
    """
    here, there = path.points(from_cm), path.points(to_cm)
    rows = _around(path, float(np.abs(from_cm - to_cm).max()))
    distance = np.linalg.norm(there[rows] - here[:, None], axis=2)
    nearest = np.argmin(distance, axis=1)
    each = np.arange(len(rows))
    return np.where(known[rows[each, nearest]], distance[each, nearest], np.nan)


def interpolation_error(path: Path, values: Samples) -> Samples:
    """RMS error of values that are interpolated in gaps, by how far the nearest known one is.

    It is measured where they are known: by how much a value differs from the mean of those that far before
    and after it. A lane that widens in bends is not interpolated across one.

    Args:
        path: The path.
        values: One at each sample; NaN where it is unknown.

    Returns:
        0 where it is known.
    """
    m, known = len(values), np.isfinite(values)
    lead = m if path.closed else 0
    away = distance_transform_edt(~np.pad(known, lead, mode="wrap"))[lead : lead + m]
    reaches, errors, reach = [0], [0.0], 2
    while reach < min(_LONGER * away.max() + 1.0, 0.25 * m):
        index = np.arange(m) if path.closed else np.arange(reach, m - reach)
        bend = values[index] - 0.5 * (values[(index - reach) % m] + values[(index + reach) % m])
        if not np.isfinite(bend).any():
            break
        reaches.append(reach)
        errors.append(max(errors[-1], float(np.sqrt(np.nanmean(bend**2)))))
        reach = int(np.ceil(_LONGER * reach))
    return np.interp(away, reaches, errors)


def _change(path: Path, values: Float[np.ndarray, "m *d"]) -> Float[np.ndarray, "m *d"]:
    """Change of values along the path, per sample."""
    if path.closed:
        return 0.5 * (np.roll(values, -1, axis=0) - np.roll(values, 1, axis=0))
    return np.asarray(np.gradient(values, axis=0))


def _around(path: Path, apart_cm: float) -> Int[np.ndarray, "m k"]:
    """Samples of the path around each one; beyond an open end, the last one repeats."""
    m = len(path.xy_cm)
    reach = min(int(_OPPOSITE_REACH * apart_cm / path.step_cm) + 2, m // 4)
    rows = np.arange(m)[:, None] + np.arange(-reach, reach + 1)
    return rows % m if path.closed else np.clip(rows, 0, m - 1)


def _curvature(path: Path) -> Samples:
    heading = np.arctan2(-path.left[:, 0], path.left[:, 1])
    if path.closed:
        turn = np.unwrap(np.concatenate([heading[-1:], heading, heading[:1]]))
        return gaussian_filter1d(0.5 * (turn[2:] - turn[:-2]) / path.step_cm, 2.0, mode="wrap")
    return gaussian_filter1d(np.gradient(np.unwrap(heading)) / path.step_cm, 2.0, mode="nearest")


def _smoothed(path: Path, values: Samples, over_cm: float) -> Samples:
    return gaussian_filter1d(values, over_cm / path.step_cm, mode="wrap" if path.closed else "nearest")
