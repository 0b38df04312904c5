"""Which views of a chessboard can take part in a calibration: complete, alike in size, distinct, of one lens.

Two lenses whose focal lengths differ by a few per cent fit one distorted lens to a fraction of a pixel. They
are recognised by a focal length per view: the views form two groups with nothing in between.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float

from lanenet.calibration.bundle import LensFit, neighbour_correlation
from lanenet.calibration.chessboard import BoardView
from lanenet.calibration.lens import moved_points, project_points
from lanenet.errors import CalibrationError

#: Fewest views. Zhang 2000 needs 3 for the focal lengths and centre alone; chosen: two more for the
#: distortion.
MIN_VIEWS = 5
#: Views whose corners differ by less than this share of the diagonal are one view. Chosen.
_SAME_VIEW = 0.01
#: The corners are in the wrong order if the other order gives a grid shorter by this factor. For a 9 x 6
#: board seen from straight ahead the right order is shorter by 0.35.
_TURNED_SHARE = 0.7
#: Sigma of a view's focal length against the common one, as a share: keeps a frontal board, which does not
#: determine it, finite. Views with a larger posterior sigma than the second number take no part. Chosen.
_PRIOR, _UNKNOWN = 0.15, 0.06
#: Most Gauss-Newton steps, and the change of log focal length at which they end; chosen: a hundredth of
#: ``_BREATHING``.
_STEPS, _STEP_TOLERANCE = 8, 1e-4
#: Smallest believable error of a corner finder.
_LEAST_SIGMA_PX = 0.05
#: Each group has at least this many views: a single odd view is a bad view, not a lens. Few views that know
#: their focal length fall into two groups by chance.
_MIN_GROUP, _MIN_KNOWN = 2, 7
#: Sigma by which a focal length changes from view to view: focus, warmth, a board that is not quite flat.
_BREATHING = 0.01
#: Smallest difference that counts, and the evidence it needs. Measured over subsets of real and rendered
#: views: below 18 for one lens, above 25 for two rendered ones.
_MIN_DIFFERENCE, _MIN_EVIDENCE = 0.04, 18.0
#: Twice the log likelihood ratio per view that the best cut through normal numbers gains.
_BEST_CUT = float(-np.log(1.0 - 2.0 / np.pi))
#: A view that misses its corners by this multiple of the median view's, even with its own focal length, is
#: bad.
BAD_VIEW_RATIO = 3.5


def usable_views(views: Sequence[BoardView]) -> tuple[list[BoardView], dict[str, str]]:
    """Choose the complete views of the size that most have, each place of the board once.

    Args:
        views: Views of one camera.

    Returns:
        The chosen views, and the name of each other one with the reason.

    Raises:
        CalibrationError: If most views number their corners for a board that lies across.
    """
    dropped: dict[str, str] = {}
    kept = list(views)
    for find in (_incomplete, _turned, _of_other_size, _repeated):
        found = find(kept)
        kept = [view for view in kept if view.name not in found]
        dropped |= found
    return kept, dropped


def _incomplete(views: list[BoardView]) -> dict[str, str]:
    return {
        view.name: "its corners are incomplete"
        for view in views
        if not np.isfinite(view.corners_px).all() or not len(view.corners_px) == len(view.points_cm) >= 9
    }


def _turned(views: list[BoardView]) -> dict[str, str]:
    """Views whose corners do not come row by row, as the board's points do."""
    turned: dict[str, str] = {}
    for view in views:
        columns, rows = (len(np.unique(view.points_cm[:, axis].round(6))) for axis in (0, 1))
        if columns * rows == len(view.corners_px) and (
            _grid_length(view.corners_px, columns, rows)
            < _TURNED_SHARE * _grid_length(view.corners_px, rows, columns)
        ):
            turned[view.name] = f"come in the order of a {rows}x{columns} board, expected {columns}x{rows}"
    if 2 * len(turned) > len(views):
        name, what = next(iter(turned.items()))
        raise CalibrationError(
            f"the views do not fit one board: the corners of {len(turned)} of {len(views)} views, {name} "
            f"among them, {what} (columns x rows)"
        )
    return {name: f"its corners {what}" for name, what in turned.items()}


def _grid_length(corners_px: Float[np.ndarray, "n 2"], rows: int, columns: int) -> float:
    """Length of all edges of the corners' grid; the true order has by far the shortest."""
    grid = corners_px.reshape(rows, columns, 2)
    steps = [np.linalg.norm(np.diff(grid, axis=axis), axis=2) for axis in (0, 1)]
    return float(sum(step.sum() for step in steps))


def _of_other_size(views: list[BoardView]) -> dict[str, str]:
    sizes = Counter(f"{view.width}x{view.height}" for view in views)
    usual = sizes.most_common(1)[0][0] if sizes else ""
    return {
        view.name: f"{size} px, most images have {usual}"
        for view in views
        if (size := f"{view.width}x{view.height}") != usual
    }


def _repeated(views: list[BoardView]) -> dict[str, str]:
    found: dict[str, str] = {}
    for first, second in combinations(views, 2):
        if first.name not in found and first.corners_px.shape == second.corners_px.shape:
            shift = np.abs(first.corners_px - second.corners_px).max()
            if shift < _SAME_VIEW * np.hypot(second.width, second.height):
                found.setdefault(second.name, f"shows the board where {first.name} does")
    return found


def check_count(views: Sequence[BoardView], dropped: dict[str, str]) -> None:
    """Refuse fewer views than a lens needs.

    Raises:
        CalibrationError: Naming the first views that were left out, with their reasons.
    """
    if len(views) >= MIN_VIEWS:
        return
    shown = [f"{name}: {reason}" for name, reason in list(dropped.items())[:3]]
    why = f" (left out: {'; '.join(shown)})" if shown else ""
    raise CalibrationError(
        f"{len(views)} usable view(s) of the board, expected at least {MIN_VIEWS}, better 12 to 20, with the "
        f"board tilted and in all parts of the image{why}"
    )


@dataclass(frozen=True)
class FocalScales:
    """Focal length of each view, relative to the common one.

    Attributes:
        log_scale: Natural logarithm of the ratio.
        covariance: Covariance of these numbers, lens and poses being unknown too; residuals that neighbouring
            corners share (a board that is bent, a lens that is no polynomial) count as one, not as many.
        view_rms_px: What is left of each view's residuals, [px].
    """

    log_scale: Float[np.ndarray, "v"]
    covariance: Float[np.ndarray, "v v"]
    view_rms_px: Float[np.ndarray, "v"]


@dataclass(frozen=True)
class LensSplit:
    """The division of views into two groups that explains their focal lengths best.

    Attributes:
        longer: Views with the longer focal length.
        shorter: Views with the shorter one.
        unsure: Views whose own focal length does not tell to which group they belong.
        difference: Relative difference of the focal lengths.
        evidence: Twice the log likelihood ratio against one lens, the scatter inside the groups and the free
            choice of the cut allowed for.
    """

    longer: list[int]
    shorter: list[int]
    unsure: list[int]
    difference: float
    evidence: float

    @property
    def is_clear(self) -> bool:
        """Whether the evidence for two lenses is overwhelming."""
        return self.difference > _MIN_DIFFERENCE and self.evidence > _MIN_EVIDENCE


def focal_scales(fit: LensFit, views: Sequence[BoardView]) -> FocalScales | None:
    """Fit lens, poses and a focal length per view together.

    Args:
        fit: A fit over these views with one lens, from which to start.
        views: The views.

    Returns:
        The focal lengths; None where the search leaves what a lens can be.

    Source:
        Gauss-Newton with soft-L1 weights; a view's focal length scales its pixels about the principal point.
    """
    n_lens, n_views = int(fit.free.sum()), len(views)
    measured = np.concatenate([view.corners_px for view in views])
    owner = np.repeat(np.arange(n_views), [len(view.points_cm) for view in views])
    lens, poses, log_scale = fit.lens.copy(), fit.poses.copy(), np.zeros(n_views)
    spread = max(fit.rms_px / np.sqrt(2.0), _LEAST_SIGMA_PX)
    first_scale = n_lens + 6 * n_views
    errors, inverse = np.zeros_like(measured), np.zeros((0, 0))
    for step in range(_STEPS + 1):
        boards = [moved_points(pose, view.points_cm) for pose, view in zip(poses, views, strict=True)]
        pixels, by_point, by_lens = project_points(fit.model, lens, np.concatenate([b for b, _ in boards]))
        ratio = np.exp(log_scale)[owner]
        offset = (pixels - lens[2:4]) * ratio[:, None]
        errors = lens[2:4] + offset - measured
        if not np.isfinite(errors).all():
            return None
        if step > 0:
            spread = max(1.4826 * float(np.median(np.abs(errors))), _LEAST_SIGMA_PX)
        by_lens = by_lens * ratio[:, None, None]
        by_lens[:, 0, 2] = by_lens[:, 1, 3] = 1.0
        by_pose = (by_point * ratio[:, None, None]) @ np.concatenate([d for _, d in boards])
        jacobian = np.zeros((len(measured), 2, first_scale + n_views))
        jacobian[:, :, :n_lens] = by_lens[:, :, fit.free]
        rows = np.arange(len(measured))
        for k in range(6):
            jacobian[rows, :, n_lens + 6 * owner + k] = by_pose[:, :, k]
        jacobian[rows, :, first_scale + owner] = offset
        weight = (1.0 + (errors / (2.0 * spread)) ** 2) ** -0.25 / spread
        system = (jacobian * weight[:, :, None]).reshape(-1, jacobian.shape[2])
        prior = np.zeros(system.shape[1])
        prior[first_scale:] = 1.0 / _PRIOR**2
        normal = system.T @ system + np.diag(prior)
        gradient = system.T @ (errors * weight).ravel()
        gradient[first_scale:] += log_scale / _PRIOR**2
        size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
        try:
            inverse = np.linalg.inv(normal / np.outer(size, size)) / np.outer(size, size)
        except np.linalg.LinAlgError:
            return None
        move = -inverse @ gradient
        if step == _STEPS or np.abs(move[first_scale:]).max() < _STEP_TOLERANCE:
            break
        lens[fit.free] += move[:n_lens]
        poses = poses + move[n_lens:first_scale].reshape(-1, 6)
        log_scale = log_scale + move[first_scale:]
    squares = np.bincount(owner, np.sum(errors**2, axis=1)) / np.bincount(owner)
    shared = neighbour_correlation(views, np.split(errors, np.flatnonzero(np.diff(owner)) + 1))
    covariance = inverse[first_scale:, first_scale:] * ((1.0 + shared) / (1.0 - shared)) ** 2
    if not (np.isfinite(covariance).all() and (np.diag(covariance) > 0.0).all()):
        return None
    return FocalScales(log_scale, covariance, np.sqrt(squares))


def best_split(scales: FocalScales) -> LensSplit | None:
    """Divide the views at the focal length where two groups explain them best.

    Args:
        scales: Focal length of each view.

    Returns:
        The division; None if too few views know their focal length.
    """
    covariance = scales.covariance + _BREATHING**2 * np.eye(len(scales.log_scale))
    index = np.flatnonzero(_known(covariance, scales.view_rms_px))
    if len(index) < _MIN_KNOWN:
        return None
    values = scales.log_scale[index]
    weights = np.linalg.inv(covariance[np.ix_(index, index)])
    order, n = np.argsort(values), len(index)
    together = _misfit(np.ones((n, 1)), values, weights)[0]
    best, middle = (together, 0.0, 0), 0.0
    for cut in range(_MIN_GROUP, n - _MIN_GROUP + 1):
        design = np.ones((n, 2))
        design[order[:cut], 1] = 0.0
        misfit, solution = _misfit(design, values, weights)
        if misfit < best[0] and solution[1] > 0.0:
            best, middle = (misfit, float(solution[1]), cut), float(solution[0] + 0.5 * solution[1])
    apart, difference, cut = best
    if cut == 0:
        return None
    # Scatter inside the groups beyond the noise measures how well board and lens model fit at all. Estimated
    # from few views it is uncertain, and the best cut through normal numbers explains 2 / pi of their
    # variance.
    scatter = max(apart / (n - 2), 1.0)
    ratio = (together - apart) / scatter
    if scatter > 1.0:
        excess = 1.0 - 1.0 / scatter
        freedom = (n - 2) / excess
        ratio = freedom * np.log1p(ratio / freedom) - excess * n * _BEST_CUT
    sigma = _sigma(covariance)[index]
    longer = index[values - middle > sigma].tolist()
    shorter = index[middle - values > sigma].tolist()
    return LensSplit(
        longer=longer,
        shorter=shorter,
        unsure=sorted(set(range(len(covariance))) - {*longer, *shorter}),
        difference=float(np.expm1(difference)),
        evidence=float(ratio),
    )


def _known(covariance: Float[np.ndarray, "v v"], rms_px: Float[np.ndarray, "v"]) -> Bool[np.ndarray, "v"]:
    """Views that are no bad ones and whose focal length is known."""
    bad = rms_px > max(BAD_VIEW_RATIO * float(np.median(rms_px)), 0.1)
    return np.asarray((_sigma(covariance) < _UNKNOWN) & ~bad)


def _sigma(covariance: Float[np.ndarray, "v v"]) -> Float[np.ndarray, "v"]:
    """Standard deviation of each view's focal length against the mean of all."""
    n = len(covariance)
    centred = np.eye(n) - 1.0 / n
    return np.sqrt(np.maximum(np.diag(centred @ covariance @ centred), 0.0))


def _misfit(
    design: Float[np.ndarray, "n k"], values: Float[np.ndarray, "n"], weights: Float[np.ndarray, "n n"]
) -> tuple[float, Float[np.ndarray, "k"]]:
    """Weighted sum of squares that a linear model leaves, and its solution."""
    solution = np.linalg.solve(design.T @ weights @ design, design.T @ weights @ values)
    left = values - design @ solution
    return float(left @ weights @ left), solution
