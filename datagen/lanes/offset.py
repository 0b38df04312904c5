"""A smooth offset d(s) through the edge points of one marking, with its uncertainty.

The middle of a marking is fitted to the edge points themselves: those of its left border lie half a width to
the left of it, those of its right border half a width to the right. The width is measured where both are
seen, so that a border that is seen alone does not pull the middle towards itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csc_array, csr_array, diags_array
from scipy.sparse.linalg import SuperLU, splu

from datagen.lanes.path import Path
from datagen.lanes.spline import CubicBasis
from datagen.lanes.support import bare_share, seen_samples, stretches, within

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
