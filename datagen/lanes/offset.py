"""Fit a smooth offset d(s) to the edge points of one marking, with its uncertainty.

The spline for the middle of the marking is fitted to the edge points themselves. Points of the left border
lie half the marking's width to the left of it, points of the right border half a width to the right. The
width is measured where both borders are seen, so that a border seen alone does not bias the middle.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.interpolate import BSpline
from scipy.ndimage import distance_transform_edt, gaussian_filter1d
from scipy.sparse import csc_array, csr_array, diags_array
from scipy.sparse.linalg import SuperLU, splu

from datagen.lanes.path import Path, SampleMask, Samples

_DEGREE = 3
#: Turn of the path within one cubic, [rad]. Derived: a cubic over such an arc deviates by less than a
#: thousandth of its length.
_TURN_PER_CUBIC = 0.25
#: Rounds of reweighting. Chosen: reweighting usually settles within a handful.
_ROUNDS = 5
#: Consecutive frames whose errors count as one. Chosen: poses of neighbouring frames err together, and ten
#: frames typically cover a camera height.
_FRAMES_TOGETHER = 10
#: Columns per block of a dense solve. Chosen: bounds memory; any value gives the same result.
_CHUNK = 256
#: Sigma that remains however often a line is seen, in camera heights. Chosen: 0.75 mm at 15 cm, by uneven
#: tape and imperfect lens models.
_LEAST_SIGMA = 0.005
#: Least precision of edge points that count for a marking's width, and for its share without paint. Derived
#: from ``precise_heights`` of the fit's settings: points closer than 1.26 and 1.7 times that distance.
_FOR_WIDTH, _FOR_DASHES = 0.2, 0.04
#: Length without edges that counts as unpainted, and the length of a line that one frame sees, in camera
#: heights. Chosen: a tenth is 1.5 cm at 15 cm, half of a short gap between dashes.
_UNPAINTED, _IN_FRAME = 0.1, 4.0
#: Largest distance of a border seen alone from a place with both borders, in camera heights. Chosen: next to
#: a gap, a single border may belong to something else.
_ALONE = 1.0
#: Length of a gap at whose ends paint is not used, and how much of it, in camera heights. Chosen: before a
#: junction, paint bends into the side road over about a marking's width.
_LONG_GAP, _GAP_MARGIN = 2.0, 0.4
#: Weight of one border's edge points per path sample above which it counts as seen: absolute, and relative to
#: the line's median. Chosen: paint shows several points per sample and frame, clutter one now and then.
_SEEN, _SEEN_SHARE = 0.5, 0.15
#: Weight of a gap's length where a parallel line is seen. Chosen: that line fixes the offset, not the kinks.
_GUIDED_GAP = 0.4
#: Least number of painted cells in a frame for its share without paint to count. Chosen: two dashes.
_MIN_CELLS = 4


@dataclass(frozen=True)
class Borders:
    """Edge points near one marking.

    Attributes:
        s_cm: Position along the path.
        d_cm: Offset from the path.
        border: 1 for the marking's left border, -1 for its right one.
        weight: Weight of the point.
        precision: Inverse variance of its position, relative to a point at the car.
        frame: Frame that saw it.
    """

    s_cm: Float[np.ndarray, "n"]
    d_cm: Float[np.ndarray, "n"]
    border: Float[np.ndarray, "n"]
    weight: Float[np.ndarray, "n"]
    precision: Float[np.ndarray, "n"]
    frame: Int[np.ndarray, "n"]


@dataclass(frozen=True)
class Prior:
    """What is assumed of a line before it is seen.

    Attributes:
        guess_cm: Expected offset at each path sample.
        shape_cm: Offset whose bends the line shares; zeros for the bends of the path.
        sigma_cm: Sigma of the guess at each sample, independent once per lane width.
        lane_cm: Lane width.
        bend_per_cm: Typical second derivative of the offset, beyond that of the shape.
        knot_cm: Length over which bends are correlated.
        height_cm: Height of the camera, which sets the scale of errors.
    """

    guess_cm: Samples
    shape_cm: Samples
    sigma_cm: Samples
    lane_cm: float
    bend_per_cm: float
    knot_cm: float
    height_cm: float


@dataclass(frozen=True)
class FittedOffset:
    """A fitted offset at the samples of a path.

    Attributes:
        d_cm: Offset.
        sigma_cm: Its sigma.
        seen: Where the marking was seen.
        marking_cm: Width of the marking; the given one if it was never seen.
        residual_cm: Robust standard deviation of the borders about the fit; NaN if it was never seen.
        unpainted: Share without paint, see :func:`datagen.lanes.offset.unpainted_share`.
    """

    d_cm: Samples
    sigma_cm: Samples
    seen: SampleMask
    marking_cm: float
    residual_cm: float
    unpainted: float


def fit_offset(
    path: Path, basis: CubicBasis, points: Borders, start_cm: Samples, tape_cm: float, prior: Prior
) -> FittedOffset:
    """Fit a cubic spline to the borders of one marking, robustly.

    Args:
        path: The path.
        basis: Splines over its length.
        points: Edge points near the marking.
        start_cm: Approximate offset of the marking at each path sample.
        tape_cm: Approximate width of the marking.
        prior: What determines the line where it is not seen.

    Source:
        Penalised splines (Eilers and Marx 1996) with iterative reweighting (Cauchy). The variance is inflated
        by the errors that frames have in common (design effect, Kish 1965); checked in
        ``tests/unit/lanes/test_fit.py``.
    """
    equations = _Equations.of(path, basis, points, prior)
    height_cm = prior.height_cm
    marking, scale = tape_cm, 0.02 * height_cm
    seen = np.zeros(len(path.xy_cm), dtype=bool)
    trust = points.precision
    solution = basis.fitted(path.s_cm, start_cm)
    residual = points.d_cm
    for _ in range(_ROUNDS):
        off = points.d_cm - equations.at_points @ solution
        marking = _width(off, points, trust, marking, tape_cm)
        residual = off - 0.5 * points.border * marking
        robust = 1.0 / (1.0 + points.precision * (residual / (2.0 * scale)) ** 2)
        found = points.weight * robust
        seen = seen_samples(path, points.s_cm, points.border, found, 0.1 * height_cm, _ALONE * height_cm)
        kept = _at(path, seen & _away_from_gaps(path, seen, height_cm), points.s_cm)
        trust = np.where(kept, points.precision * robust, 0.0)
        if not trust.any():
            break
        spread = (np.sqrt(points.precision) * np.abs(residual))[trust > 0.0]
        low, high = 1e-3 * height_cm, 0.05 * height_cm
        scale = float(np.clip(1.4826 * np.median(spread), low, high))
        middle = points.d_cm - 0.5 * points.border * marking
        solution, _, _ = equations.solve(trust / scale**2, middle, seen)
    middle = points.d_cm - 0.5 * points.border * marking
    weight = trust / scale**2
    solution, factor, data = equations.solve(weight, middle, seen)
    pull = weight * (middle - equations.at_points @ solution)
    excess = _design_effect(factor, data, equations.at_points, pull, points.frame)
    solution, factor, _ = equations.solve(weight / excess, middle, seen)
    near = trust > 0.5 * points.precision
    near_dashes = points.precision > _FOR_DASHES
    return FittedOffset(
        d_cm=np.asarray(equations.at_samples @ solution),
        sigma_cm=np.sqrt(_variance(factor, equations.at_samples) + (_LEAST_SIGMA * height_cm) ** 2),
        seen=seen,
        marking_cm=marking,
        residual_cm=1.4826 * float(np.median(np.abs(residual[near]))) if near.any() else float("nan"),
        unpainted=unpainted_share(
            points.s_cm[near_dashes], points.frame[near_dashes], _UNPAINTED * height_cm, _IN_FRAME * height_cm
        ),
    )


@dataclass(frozen=True)
class _Equations:
    """Normal equations of the penalised spline of one line.

    Attributes:
        at_samples: Turns coefficients into offsets at the path samples.
        at_points: The same at the edge points.
        stiffness: Penalty of the second derivative.
        shape: Coefficients of the offset whose bends cost nothing.
        prior: See :class:`Prior`.
        step_cm: Distance between path samples.
    """

    at_samples: csr_array
    at_points: csr_array
    stiffness: csc_array
    shape: Float[np.ndarray, "c"]
    prior: Prior
    step_cm: float

    @classmethod
    def of(cls, path: Path, basis: CubicBasis, points: Borders, prior: Prior) -> _Equations:
        bend = basis.design(path.s_cm, 2)
        stiffness = csc_array(bend.T @ bend) * (path.step_cm / prior.knot_cm / prior.bend_per_cm**2)
        shape = basis.fitted(path.s_cm, prior.shape_cm)
        return cls(basis.design(path.s_cm), basis.design(points.s_cm), stiffness, shape, prior, path.step_cm)

    def solve(
        self, weight: Float[np.ndarray, "n"], middle_cm: Float[np.ndarray, "n"], seen: SampleMask
    ) -> tuple[Float[np.ndarray, "c"], SuperLU, csc_array]:
        """Return the coefficients, the factorised normal matrix, and the data's share of that matrix."""
        prior, at_samples, at_points = self.prior, self.at_samples, self.at_points
        # Where paint is seen, the guess counts for nothing; a trace of it keeps the matrix regular.
        guide = np.where(seen, 1e-6, 1.0) * self.step_cm / prior.lane_cm / prior.sigma_cm**2
        data = csc_array(at_points.T @ diags_array(weight) @ at_points)
        normal = data + self.stiffness + csc_array(at_samples.T @ diags_array(guide) @ at_samples)
        factor = splu(csc_array(normal))
        right = at_points.T @ (weight * middle_cm) + at_samples.T @ (guide * prior.guess_cm)
        right = right + self.stiffness @ self.shape
        return factor.solve(np.asarray(right)), factor, data


def _away_from_gaps(path: Path, seen: SampleMask, height_cm: float) -> SampleMask:
    """Return the samples that are not at the ends of paint before long gaps.

    There, paint may turn off into a side road. The ends of an open path are no gaps.
    """
    trim = _GAP_MARGIN * height_cm
    ends = supported_sections(path, seen, _LONG_GAP * height_cm, -trim)
    if not path.closed:
        ends[:, 0] = np.where(ends[:, 0] < 2.0 * trim, 0.0, ends[:, 0])
        ends[:, 1] = np.where(ends[:, 1] > path.s_cm[-1] - 2.0 * trim, path.s_cm[-1], ends[:, 1])
    return within(path, ends)


def _at(path: Path, mask: SampleMask, s_cm: Float[np.ndarray, "n"]) -> Bool[np.ndarray, "n"]:
    """Look up a mask of path samples at positions between them."""
    row = np.rint(s_cm / path.step_cm).astype(np.intp)
    return mask[row % len(mask) if path.closed else np.clip(row, 0, len(mask) - 1)]


def _width(
    off_cm: Float[np.ndarray, "n"],
    points: Borders,
    trust: Float[np.ndarray, "n"],
    before_cm: float,
    typical_cm: float,
) -> float:
    """Distance between the medians of the two borders, from near points only."""
    good = (points.precision > _FOR_WIDTH) & (trust > 0.5 * points.precision)
    left, right = off_cm[good & (points.border > 0.0)], off_cm[good & (points.border < 0.0)]
    if min(len(left), len(right)) < 10:
        return before_cm
    return float(np.clip(np.median(left) - np.median(right), 0.4 * typical_cm, 1.6 * typical_cm))


def _design_effect(
    factor: SuperLU,
    data: csc_array,
    at_points: csr_array,
    pull: Float[np.ndarray, "n"],
    frame: Int[np.ndarray, "n"],
) -> float:
    """Ratio of the fit's variance to that of independent points, since the points of a frame err together."""
    if not len(frame):
        return 1.0
    group = np.unique(frame // _FRAMES_TOGETHER, return_inverse=True)[1].reshape(-1)
    groups = int(group.max()) + 1
    member = csr_array((pull, (group, np.arange(len(pull)))), shape=(groups, len(pull)))
    pulls = np.asarray((member @ at_points).todense()).T
    common = float(np.sum(pulls * factor.solve(np.ascontiguousarray(pulls))))
    free = 0.0
    for first in range(0, data.shape[0], _CHUNK):
        block = np.asarray(data[:, first : first + _CHUNK].todense())
        free += float(np.trace(factor.solve(block)[first : first + _CHUNK]))
    return max(1.0, common / max(free, 1e-9))


def _variance(factor: SuperLU, at_samples: csr_array) -> Samples:
    variance = np.zeros(at_samples.shape[0])
    for first in range(0, len(variance), _CHUNK):
        rows = np.ascontiguousarray(at_samples[first : first + _CHUNK].todense().T)
        variance[first : first + _CHUNK] = np.sum(rows * factor.solve(rows), axis=0)
    return variance


@dataclass(frozen=True)
class CubicBasis:
    """Cubic B-splines over the position along a path, open or periodic, as sparse linear maps.

    A periodic basis has as many functions as intervals. Those that reach across the seam are the same on both
    sides, so value, slope and second derivative agree there by construction.

    Attributes:
        breaks_cm: Ends of the cubics, increasing.
        periodic: Whether the last break is the same place as the first.
    """

    breaks_cm: Float[np.ndarray, "b"]
    periodic: bool

    @property
    def size(self) -> int:
        """Number of free coefficients."""
        return len(self.breaks_cm) - 1 if self.periodic else len(self.breaks_cm) + 2

    @property
    def knots_cm(self) -> Float[np.ndarray, "k"]:
        """Knots: the breaks, with three more on either side."""
        b = self.breaks_cm
        if self.periodic:
            period = b[-1] - b[0]
            return np.concatenate([b[-4:-1] - period, b, b[1:4] + period])
        return np.concatenate([np.full(3, b[0]), b, np.full(3, b[-1])])

    def design(self, s_cm: Samples, derivative: int = 0) -> csr_array:
        """Return the matrix that turns coefficients into values, or a derivative, at the positions."""
        if not len(s_cm):
            return csr_array((0, self.size))
        b, knots = self.breaks_cm, self.knots_cm
        s = np.mod(s_cm - b[0], b[-1] - b[0]) + b[0] if self.periodic else np.clip(s_cm, b[0], b[-1])
        inner = knots[derivative : len(knots) - derivative]
        matrix = csr_array(BSpline.design_matrix(s, inner, _DEGREE - derivative))
        for order in range(derivative, 0, -1):
            # The derivative's coefficients: differences, divided by the span of their knots (de Boor 1978).
            degree, t = _DEGREE - order + 1, knots[order - 1 : len(knots) - order + 1]
            count = len(t) - degree - 1
            slope = degree / np.maximum(t[degree + 1 : degree + count] - t[1:count], 1e-12)
            matrix = matrix @ diags_array([-slope, slope], offsets=[0, 1], shape=(count - 1, count))
        return csr_array(matrix @ self._unfold()) if self.periodic else csr_array(matrix)

    def fitted(self, s_cm: Samples, values: Float[np.ndarray, "m *d"]) -> Float[np.ndarray, "c *d"]:
        """Least-squares coefficients for values at positions; every interval needs some positions."""
        design = self.design(s_cm)
        return np.asarray(splu(csc_array(design.T @ design)).solve(np.asarray(design.T @ values)))

    def unfolded(self, coefficients: Float[np.ndarray, "c *d"]) -> Float[np.ndarray, "c2 *d"]:
        """Return the coefficients for the full list of knots."""
        return np.concatenate([coefficients, coefficients[:_DEGREE]]) if self.periodic else coefficients

    def _unfold(self) -> csr_array:
        count = self.size + _DEGREE
        columns = np.arange(count) % self.size
        return csr_array((np.ones(count), (np.arange(count), columns)), shape=(count, self.size))


def adapted_breaks(
    curvature_per_cm: Samples, step_cm: float, widest_cm: float, narrowest_cm: float
) -> Float[np.ndarray, "b"]:
    """Place breaks along a path, more densely in bends.

    Args:
        curvature_per_cm: Curvature at even samples of the path.
        step_cm: Distance between samples.
        widest_cm: Spacing where the path is straight.
        narrowest_cm: Spacing in the tightest bends.

    Returns:
        Breaks from 0 to the end of the last step; at least eight intervals.
    """
    spacing = np.clip(_TURN_PER_CUBIC / np.maximum(np.abs(curvature_per_cm), 1e-9), narrowest_cm, widest_cm)
    count = np.concatenate([[0.0], np.cumsum(step_cm / spacing)])
    breaks = np.linspace(0.0, count[-1], max(8, round(count[-1])) + 1)
    return np.interp(breaks, count, np.arange(len(count)) * step_cm)


def seen_samples(
    path: Path,
    s_cm: Float[np.ndarray, "n"],
    border: Float[np.ndarray, "n"],
    weight: Float[np.ndarray, "n"],
    along_cm: float,
    alone_cm: float,
) -> SampleMask:
    """Return at which path samples a marking is seen.

    A single border counts only close to a place where both are seen: elsewhere it may be a joint or a shadow.

    Args:
        path: The path.
        s_cm: Position of the marking's edge points.
        border: 1 for points of the left border, -1 for the right one.
        weight: Weight of each point.
        along_cm: Smoothing along the path.
        alone_cm: Largest distance of a single border from a place with both.
    """
    m = len(path.xy_cm)
    row = np.clip(np.rint(s_cm / path.step_cm).astype(np.intp), 0, m)
    row = row % m if path.closed else np.minimum(row, m - 1)
    mode: Literal["wrap", "constant"] = "wrap" if path.closed else "constant"
    left, right = (
        gaussian_filter1d(
            np.bincount(row[border == sign], weight[border == sign], minlength=m).astype(np.float64),
            along_cm / path.step_cm,
            mode=mode,
        )
        for sign in (1.0, -1.0)
    )
    weaker = np.minimum(left, right)
    both = weaker > _SEEN
    if not both.any():
        return both
    enough = max(_SEEN, _SEEN_SHARE * float(np.median(weaker[both])))
    both = weaker > enough
    lead = m if path.closed else 0
    apart = distance_transform_edt(~np.pad(both, lead, mode="wrap"))[lead : lead + m]
    return both | ((np.maximum(left, right) > enough) & (apart * path.step_cm <= alone_cm))


def supported_sections(
    path: Path, seen: SampleMask, bridge_cm: float, extend_cm: float, guided: SampleMask | None = None
) -> Float[np.ndarray, "g 2"]:
    """Join seen samples to sections, across gaps that are no longer than the bridge.

    Args:
        path: The path.
        seen: Where the marking was seen.
        bridge_cm: Longest gap, with the marking seen on both sides.
        extend_cm: Extension beyond either end. A section shorter than this is dropped: it is as likely
            clutter as line.
        guided: Where a parallel line is seen; gaps count less there.

    Returns:
        (from, to); on a closed path a section across the seam ends beyond the period.
    """
    period, at = path.period_cm, path.s_cm[seen]
    if at.size < 2:
        return np.empty((0, 2))
    weight = np.ones(len(seen)) if guided is None else np.where(guided, _GUIDED_GAP, 1.0)
    cost = weight * path.step_cm
    travelled = np.cumsum(cost)[seen]
    if period is None:
        cuts = np.flatnonzero(np.diff(travelled) > bridge_cm)
        first, last = np.concatenate([[0], cuts + 1]), np.concatenate([cuts, [len(at) - 1]])
        found = np.stack([at[first], at[last]], axis=1)
    else:
        cuts = np.flatnonzero(np.diff(travelled, append=travelled[0] + cost.sum()) > bridge_cm)
        if not cuts.size:
            return np.array([[0.0, period]])
        first, last = (cuts + 1) % len(at), np.roll(cuts, -1)
        found = np.stack([at[first], at[first] + np.mod(at[last] - at[first], period)], axis=1)
    found = found[found[:, 1] - found[:, 0] > extend_cm] + [-extend_cm, extend_cm]
    return found if period is not None else np.clip(found, 0.0, path.s_cm[-1])


def unpainted_share(
    s_cm: Float[np.ndarray, "n"], frame: Int[np.ndarray, "n"], cell_cm: float, reach_cm: float
) -> float:
    """Share of a line without paint, as single frames see it.

    On the map, the dashes of several laps need not coincide; in one frame they do not move.

    Args:
        s_cm: Position of the line's edge points along the path.
        frame: Frame that saw each.
        cell_cm: Length without edge points that counts as unpainted.
        reach_cm: Largest length that a frame sees.

    Returns:
        0..1; NaN if no frame sees enough of the line.
    """
    seen = np.unique(np.stack([frame, np.floor(s_cm / cell_cm).astype(np.int64)], axis=1), axis=0)
    if not len(seen):
        return float("nan")
    first = np.flatnonzero(np.diff(seen[:, 0], prepend=seen[0, 0] - 1))
    cells = np.diff(first, append=len(seen))
    length = seen[first + cells - 1, 1] - seen[first, 1] + 1
    # A frame that sees both sides of a lap's seam appears to see a whole lap.
    counts = (cells >= _MIN_CELLS) & (length * cell_cm <= reach_cm)
    return 1.0 - float(cells[counts].sum() / length[counts].sum()) if counts.any() else float("nan")


def within(path: Path, sections_cm: Float[np.ndarray, "g 2"]) -> SampleMask:
    """Return which path samples lie in any of the sections."""
    inside = np.zeros(len(path.xy_cm), dtype=bool)
    for start, end in sections_cm:
        past = path.s_cm - start
        inside |= (past >= 0.0) & (past <= end - start)
        if path.period_cm is not None:
            inside |= np.mod(past, path.period_cm) <= end - start
    return inside
