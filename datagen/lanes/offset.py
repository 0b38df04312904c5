"""A smooth offset d(s) through the edge points of one marking, with its uncertainty.

The middle of a marking is fitted to the edge points themselves: those of its left border lie half a width to
the left of it, those of its right border half a width to the right. The width is measured where both are
seen, so that a border that is seen alone does not pull the middle towards itself.

Cubic B-splines over the position along a path, open or periodic, as sparse linear maps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.interpolate import BSpline
from scipy.sparse import csc_array, csr_array, diags_array
from scipy.sparse.linalg import SuperLU, splu

from datagen.lanes.path import Path
from datagen.lanes.support import bare_share, seen_samples, stretches, within

_DEGREE = 3


@dataclass(frozen=True)
class CubicBasis:
    """Cubic B-splines with given breaks.

    A periodic basis has as many functions as intervals: those that reach over the seam are one and the same
    on both sides of it, so that value, slope and second derivative agree there by construction.

    Attributes:
        breaks_cm: Ends of the cubic pieces, growing.
        periodic: Whether the last break is the first one again.
    """

    breaks_cm: Float[np.ndarray, "b"]
    periodic: bool

    @property
    def size(self) -> int:
        """Number of free coefficients."""
        return len(self.breaks_cm) - 1 if self.periodic else len(self.breaks_cm) + 2

    @property
    def knots_cm(self) -> Float[np.ndarray, "k"]:
        """Knots, with three more on either side of the breaks."""
        b = self.breaks_cm
        if self.periodic:
            period = b[-1] - b[0]
            return np.concatenate([b[-4:-1] - period, b, b[1:4] + period])
        return np.concatenate([np.full(3, b[0]), b, np.full(3, b[-1])])

    def design(self, s_cm: Float[np.ndarray, "m"], derivative: int = 0) -> csr_array:
        """Matrix that turns coefficients into values, or a derivative of them, at given places."""
        if not len(s_cm):
            return csr_array((0, self.size))
        b, knots = self.breaks_cm, self.knots_cm
        s = np.mod(s_cm - b[0], b[-1] - b[0]) + b[0] if self.periodic else np.clip(s_cm, b[0], b[-1])
        inner = knots[derivative : len(knots) - derivative]
        matrix = csr_array(BSpline.design_matrix(s, inner, _DEGREE - derivative))
        for order in range(derivative, 0, -1):
            # Coefficients of the derivative are differences of coefficients over the span of their knots.
            degree, t = _DEGREE - order + 1, knots[order - 1 : len(knots) - order + 1]
            count = len(t) - degree - 1
            slope = degree / np.maximum(t[degree + 1 : degree + count] - t[1:count], 1e-12)
            matrix = matrix @ diags_array([-slope, slope], offsets=[0, 1], shape=(count - 1, count))
        return csr_array(matrix @ self._unfold()) if self.periodic else csr_array(matrix)

    def fitted(
        self, s_cm: Float[np.ndarray, "m"], values: Float[np.ndarray, "m *d"]
    ) -> Float[np.ndarray, "c *d"]:
        """Coefficients that come closest to values at given places, of which every interval holds some."""
        design = self.design(s_cm)
        return np.asarray(splu(csc_array(design.T @ design)).solve(np.asarray(design.T @ values)))

    def unfolded(self, coefficients: Float[np.ndarray, "c *d"]) -> Float[np.ndarray, "c2 *d"]:
        """Coefficients for the full list of knots."""
        return np.concatenate([coefficients, coefficients[:_DEGREE]]) if self.periodic else coefficients

    def _unfold(self) -> csr_array:
        count = self.size + _DEGREE
        columns = np.arange(count) % self.size
        return csr_array((np.ones(count), (np.arange(count), columns)), shape=(count, self.size))


def adapted_breaks(
    curvature_per_cm: Float[np.ndarray, "m"], step_cm: float, widest_cm: float, narrowest_cm: float
) -> Float[np.ndarray, "b"]:
    """Breaks along a path, denser in bends.

    Args:
        curvature_per_cm: Curvature at even samples of the path.
        step_cm: Distance between these.
        widest_cm: Spacing where the path is straight.
        narrowest_cm: Spacing in the tightest bends.

    Returns:
        From 0 to the end of the last step, at least eight intervals.
    """
    # A cubic over an interval that turns by a quarter of a radian stays within a thousandth of its length.
    spacing = np.clip(0.25 / np.maximum(np.abs(curvature_per_cm), 1e-9), narrowest_cm, widest_cm)
    count = np.concatenate([[0.0], np.cumsum(step_cm / spacing)])
    breaks = np.linspace(0.0, count[-1], max(8, round(count[-1])) + 1)
    return np.interp(breaks, count, np.arange(len(count)) * step_cm)


_ROUNDS = 5
#: Frames whose errors count as one: their poses hang together.
_FRAMES_TOGETHER = 10
_CHUNK = 256
#: What is left however often a line is seen, in camera heights: paint and lens are not perfect.
_FLOOR = 0.005
#: Precision of the edge points that tell a marking's width, and of those that tell dashes from a solid line.
_NEAR, _TELLS_DASHES = 0.2, 0.04
#: Length without edges that counts as bare, and what one frame sees of a line at most, in camera heights.
_BARE, _IN_FRAME = 0.1, 4.0
#: How far from both borders of a marking one alone is believed, in camera heights: next to a gap it may be
#: the border of something else.
_ALONE = 1.0
#: Gaps at whose ends paint is not trusted, and how much of it, in camera heights.
_LONG_GAP, _TURNS_OFF = 2.0, 0.4


@dataclass(frozen=True)
class Borders:
    """Edge points near one marking.

    Attributes:
        s_cm: Position along the path.
        d_cm: Offset from the path.
        border: 1 for the marking's left border, -1 for its right one.
        weight: Trust that the point is there.
        precision: Inverse variance of its place, 1 near the car.
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
    """What is known of a line before it is seen.

    Attributes:
        guess_cm: Where it should be at each path sample, by the line beside it.
        shape_cm: Offset whose bends it shares; zeros for those of the path.
        sigma_cm: How well it keeps to that at each sample, independently once per lane width.
        lane_cm: Lane width.
        bend_per_cm: Typical second derivative of the offset, beyond that of the shape.
        knot_cm: Length over which that hangs together.
        height_cm: Height of the camera, which sets the scale of errors.
    """

    guess_cm: Float[np.ndarray, "m"]
    shape_cm: Float[np.ndarray, "m"]
    sigma_cm: Float[np.ndarray, "m"]
    lane_cm: float
    bend_per_cm: float
    knot_cm: float
    height_cm: float


@dataclass(frozen=True)
class FittedOffset:
    """A fitted offset at the samples of a path.

    Attributes:
        d_cm: Offset.
        sigma_cm: Its standard deviation.
        seen: Where the marking was seen.
        marking_cm: Width of the marking; what was given where it was never seen.
        residual_cm: Robust standard deviation of the borders about the fit; NaN where it was never seen.
        bare: Share of it that is bare between pieces of paint, see :func:`datagen.lanes.support.bare_share`.
    """

    d_cm: Float[np.ndarray, "m"]
    sigma_cm: Float[np.ndarray, "m"]
    seen: Bool[np.ndarray, "m"]
    marking_cm: float
    residual_cm: float
    bare: float


def fit_offset(
    path: Path,
    basis: CubicBasis,
    points: Borders,
    start_cm: Float[np.ndarray, "m"],
    tape_cm: float,
    prior: Prior,
) -> FittedOffset:
    """Fit a cubic spline to the borders of one marking, robustly.

    Args:
        path: The path.
        basis: Splines over its length.
        points: Edge points near the marking.
        start_cm: Where the marking is, about, at each path sample.
        tape_cm: Width of the marking, about.
        prior: What carries the line where it is not seen.

    Source:
        Penalised splines (Eilers and Marx 1996) with iterative reweighting (Cauchy). The uncertainty is
        inflated by what neighbouring frames err in common (design effect, Kish 1965);
        ``tests/unit/lanes/test_fit.py`` checks it.
    """
    at_samples, at_points = basis.design(path.s_cm), basis.design(points.s_cm)
    stiff = basis.design(path.s_cm, 2)
    stiffness = csc_array(stiff.T @ stiff) * (path.step_cm / prior.knot_cm / prior.bend_per_cm**2)
    marking, scale = tape_cm, 0.02 * prior.height_cm
    seen = np.zeros(len(path.xy_cm), dtype=bool)
    trust = points.precision
    solution = basis.fitted(path.s_cm, start_cm)
    shape = basis.fitted(path.s_cm, prior.shape_cm)
    residual = points.d_cm
    for _ in range(_ROUNDS):
        off = points.d_cm - at_points @ solution
        marking = _width(off, points, trust, marking, tape_cm)
        residual = off - 0.5 * points.border * marking
        robust = 1.0 / (1.0 + points.precision * (residual / (2.0 * scale)) ** 2)
        found = points.weight * robust
        seen = seen_samples(
            path, points.s_cm, points.border, found, 0.1 * prior.height_cm, _ALONE * prior.height_cm
        )
        kept = _at(path, seen & _before_ends(path, seen, prior.height_cm), points.s_cm)
        trust = np.where(kept, points.precision * robust, 0.0)
        if not trust.any():
            break
        spread = (np.sqrt(points.precision) * np.abs(residual))[trust > 0.0]
        low, high = 1e-3 * prior.height_cm, 0.05 * prior.height_cm
        scale = float(np.clip(1.4826 * np.median(spread), low, high))
        middle = points.d_cm - 0.5 * points.border * marking
        solution, _, _ = _solve(
            at_samples, stiffness, shape, at_points, trust / scale**2, middle, prior, seen, path
        )
    middle = points.d_cm - 0.5 * points.border * marking
    weight = trust / scale**2
    solution, factor, data = _solve(
        at_samples, stiffness, shape, at_points, weight, middle, prior, seen, path
    )
    excess = _in_common(factor, data, at_points, weight * (middle - at_points @ solution), points.frame)
    solution, factor, _ = _solve(
        at_samples, stiffness, shape, at_points, weight / excess, middle, prior, seen, path
    )
    near = trust > 0.5 * points.precision
    robust_sd = 1.4826 * float(np.median(np.abs(residual[near]))) if near.any() else float("nan")
    sigma = np.sqrt(_variance(factor, at_samples) + (_FLOOR * prior.height_cm) ** 2)
    near = points.precision > _TELLS_DASHES
    height_cm = prior.height_cm
    bare = bare_share(points.s_cm[near], points.frame[near], _BARE * height_cm, _IN_FRAME * height_cm)
    return FittedOffset(np.asarray(at_samples @ solution), sigma, seen, marking, robust_sd, bare)


def _before_ends(path: Path, seen: Bool[np.ndarray, "m"], height_cm: float) -> Bool[np.ndarray, "m"]:
    """Leave out the ends of paint before long gaps: it may turn off into a side road before it ends.

    Where an open path ends, paint does not.
    """
    trim = _TURNS_OFF * height_cm
    ends = stretches(path, seen, _LONG_GAP * height_cm, -trim)
    if not path.closed:
        ends[:, 0] = np.where(ends[:, 0] < 2.0 * trim, 0.0, ends[:, 0])
        ends[:, 1] = np.where(ends[:, 1] > path.s_cm[-1] - 2.0 * trim, path.s_cm[-1], ends[:, 1])
    return within(path, ends)


def _solve(
    at_samples: csr_array,
    stiffness: csc_array,
    shape: Float[np.ndarray, "c"],
    at_points: csr_array,
    weight: Float[np.ndarray, "n"],
    middle_cm: Float[np.ndarray, "n"],
    prior: Prior,
    seen: Bool[np.ndarray, "m"],
    path: Path,
) -> tuple[Float[np.ndarray, "c"], SuperLU, csc_array]:
    """Coefficients, the factorised normal matrix, and the data's part of it."""
    # Where paint is seen, the guide would only smear it; a trace of it keeps the matrix regular.
    guide = np.where(seen, 1e-6, 1.0) * path.step_cm / prior.lane_cm / prior.sigma_cm**2
    data = csc_array(at_points.T @ diags_array(weight) @ at_points)
    normal = data + stiffness + csc_array(at_samples.T @ diags_array(guide) @ at_samples)
    factor = splu(csc_array(normal))
    right = at_points.T @ (weight * middle_cm) + at_samples.T @ (guide * prior.guess_cm) + stiffness @ shape
    return factor.solve(np.asarray(right)), factor, data


def _at(path: Path, mask: Bool[np.ndarray, "m"], s_cm: Float[np.ndarray, "n"]) -> Bool[np.ndarray, "n"]:
    """Look a mask of path samples up at places between them."""
    row = np.rint(s_cm / path.step_cm).astype(np.intp)
    return mask[row % len(mask) if path.closed else np.clip(row, 0, len(mask) - 1)]


def _width(
    off_cm: Float[np.ndarray, "n"],
    points: Borders,
    trust: Float[np.ndarray, "n"],
    before_cm: float,
    usual_cm: float,
) -> float:
    """Distance between the medians of the two borders; far points lie too loosely to tell."""
    good = (points.precision > _NEAR) & (trust > 0.5 * points.precision)
    left, right = off_cm[good & (points.border > 0.0)], off_cm[good & (points.border < 0.0)]
    if min(len(left), len(right)) < 10:
        return before_cm
    return float(np.clip(np.median(left) - np.median(right), 0.4 * usual_cm, 1.6 * usual_cm))


def _in_common(
    factor: SuperLU,
    data: csc_array,
    at_points: csr_array,
    pull: Float[np.ndarray, "n"],
    frame: Int[np.ndarray, "n"],
) -> float:
    """By how much the fit's variance exceeds that of independent points, because frames err as a whole."""
    if not len(frame):
        return 1.0
    group = np.unique(frame // _FRAMES_TOGETHER, return_inverse=True)[1].reshape(-1)
    groups = int(group.max()) + 1
    member = csr_array((pull, (group, np.arange(len(pull)))), shape=(groups, len(pull)))
    pulls = np.asarray((member @ at_points).todense()).T
    common = float(np.sum(pulls * factor.solve(np.ascontiguousarray(pulls))))
    free = 0.0
    for first in range(0, data.shape[0], _CHUNK):
        part = np.asarray(data[:, first : first + _CHUNK].todense())
        free += float(np.trace(factor.solve(part)[first : first + _CHUNK]))
    return max(1.0, common / max(free, 1e-9))


def _variance(factor: SuperLU, at_samples: csr_array) -> Float[np.ndarray, "m"]:
    variance = np.zeros(at_samples.shape[0])
    for first in range(0, len(variance), _CHUNK):
        rows = np.ascontiguousarray(at_samples[first : first + _CHUNK].todense().T)
        variance[first : first + _CHUNK] = np.sum(rows * factor.solve(rows), axis=0)
    return variance
