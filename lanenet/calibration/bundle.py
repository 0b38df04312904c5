"""Lens and board poses together, from corners in several views: one robust least-squares problem."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from lanenet.calibration.chessboard import BoardView
from lanenet.calibration.lens import (
    N_DISTORTION,
    N_INTRINSIC,
    camera_of_lens,
    moved_points,
    pose_of_plane,
    project_points,
    standard_deviations,
)
from lanenet.geometry.camera import CameraModel

#: Angles between the axis and the image corner at which a search starts, [deg]. Chosen: from telephoto to the
#: widest lens of each model, in steps of 20 to 50 %, so that some start is near every lens.
_START_ANGLES_DEG: dict[CameraModel, tuple[float, ...]] = {
    "fisheye": (15.0, 25.0, 35.0, 50.0, 65.0, 80.0, 95.0, 110.0, 130.0),
    "pinhole": (12.0, 20.0, 28.0, 36.0, 45.0, 54.0, 63.0),
}
#: Starts that are refined; chosen: neighbours of the best one, since the ranking is rough.
_STARTS_KEPT = 3
#: Largest correlation between the residuals of neighbouring corners that is believed. Chosen: at 0.8 a corner
#: still counts for 1/81 of one; without a bound, a bent board would leave no evidence at all.
_MAX_CORRELATION = 0.8


@dataclass(frozen=True)
class _Search:
    """How a least-squares search weighs residuals, and when it ends.

    Attributes:
        scale_px: Scale of the soft L1 loss, [px].
        most_evaluations: Most points that are tried.
        least_gain: Least share by which a step lowers the cost.
    """

    scale_px: float
    most_evaluations: int
    least_gain: float


#: From a start that may be far off: corners count up to a few pixels, and a few digits are enough.
_ROUGH_SEARCH = _Search(scale_px=3.0, most_evaluations=25, least_gain=1e-4)
#: Close to the solution: half a pixel is an error of a corner finder, more is an outlier.
_FINE_SEARCH = _Search(scale_px=0.5, most_evaluations=60, least_gain=1e-8)
#: Damping of the first step, as a share of the diagonal; factors by which a step that fails raises and one
#: that succeeds lowers it; its bounds. Usual values of the method, the least one against rounding.
_FIRST_DAMPING, _MORE_DAMPING, _LESS_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-4, 5.0, 10.0, 1e-10, 1e8
#: A step that fails and is shorter than this share of the solution ends the search.
_LEAST_MOVE = 1e-8


@dataclass(frozen=True)
class LensFit:
    """A lens and where the boards were.

    Attributes:
        model: Lens model.
        lens: fx, fy, cx, cy, D.
        free: Which of these were fitted; the others are zero.
        poses: Rotation vector and translation of each board, [rad], [cm], frame camera.
        residuals_px: Per view, measured minus projected corners.
        lens_sigma: Standard deviation of each number of the lens; 0 where it was not fitted.
        robust_cost: Sum of the robust loss, [px^2].
    """

    model: CameraModel
    lens: Float[np.ndarray, "p"]
    free: Bool[np.ndarray, "p"]
    poses: Float[np.ndarray, "v 6"]
    residuals_px: list[Float[np.ndarray, "_ 2"]]
    lens_sigma: Float[np.ndarray, "p"]
    robust_cost: float

    @property
    def view_rms_px(self) -> Float[np.ndarray, "v"]:
        """Root mean square distance of each view's corners."""
        return np.array([np.sqrt(np.mean(np.sum(r**2, axis=1))) for r in self.residuals_px])

    @property
    def rms_px(self) -> float:
        """Root mean square distance over all corners, as OpenCV states it."""
        return float(np.sqrt(np.mean(np.sum(np.concatenate(self.residuals_px) ** 2, axis=1))))

    def bic(self, correlation: float) -> float:
        """Bayesian information criterion of the lens; the lower of two models is the better supported.

        Args:
            correlation: Of the residuals of neighbouring corners. A board that is not quite flat moves a
                whole patch of corners, which then counts for few.
        """
        n = 2 * sum(len(r) for r in self.residuals_px)
        independent = n * ((1.0 - correlation) / (1.0 + correlation)) ** 2
        misfit = np.log(max(self.robust_cost, 1e-12) / n)
        return float(independent * misfit + np.count_nonzero(self.free) * np.log(max(independent, 2.0)))


def neighbour_correlation(views: Sequence[BoardView], errors_px: Sequence[Float[np.ndarray, "_ 2"]]) -> float:
    """Correlation of the residuals of neighbouring corners, between 0 and the largest that is believed."""
    product = square = 0.0
    for view, errors in zip(views, errors_px, strict=True):
        distance = np.linalg.norm(view.points_cm[:, None] - view.points_cm[None], axis=2)
        np.fill_diagonal(distance, np.inf)
        first, second = np.nonzero(np.triu(distance < 1.2 * distance.min()))
        centred = errors - errors.mean(axis=0)
        product += float(np.mean(np.sum(centred[first] * centred[second], axis=1)))
        square += float(np.mean(np.sum(centred**2, axis=1)))
    return min(max(product / max(square, 1e-12), 0.0), _MAX_CORRELATION)


def free_numbers(model: CameraModel, distortion: Sequence[int]) -> Bool[np.ndarray, "p"]:
    """Return the mask of a fit of fx, fy, cx, cy and these entries of D."""
    free = np.zeros(N_INTRINSIC + N_DISTORTION[model], bool)
    free[:N_INTRINSIC] = True
    free[[N_INTRINSIC + k for k in distortion]] = True
    return free


def start_fit(model: CameraModel, views: Sequence[BoardView]) -> LensFit | None:
    """Find a lens without a first guess: try several focal lengths and refine the best.

    For a fisheye each start is an equidistant lens (radius = f * angle), up to 260 degrees of view, for a
    pinhole one without distortion.

    Args:
        model: Lens model.
        views: Views of one camera.

    Returns:
        A rough fit with k1 and k2, or None if no start explains the views.
    """
    width, height = views[0].width, views[0].height
    starts: list[tuple[float, Float[np.ndarray, "p"], Float[np.ndarray, "v 6"]]] = []
    for angle_deg in _START_ANGLES_DEG[model]:
        angle = np.deg2rad(angle_deg)
        focal = 0.5 * np.hypot(width, height) / (angle if model == "fisheye" else np.tan(angle))
        lens = np.zeros(N_INTRINSIC + N_DISTORTION[model])
        lens[:N_INTRINSIC] = focal, focal, 0.5 * (width - 1), 0.5 * (height - 1)
        poses = poses_of_views(model, lens, views)
        if poses is not None:
            errors = np.concatenate(view_residuals(model, lens, poses, views))
            starts.append((float(np.median(np.abs(errors))), lens, poses))
    starts.sort(key=lambda start: start[0])
    # fx, fy, k1, k2.
    free = free_numbers(model, (0, 1))
    free[2:4] = False
    best: LensFit | None = None
    for _, lens, poses in starts[:_STARTS_KEPT]:
        fit = refine(model, lens, poses, views, free, rough=True)
        # A plane has two poses that look alike; a board in the wrong one gets a second chance.
        again = poses_of_views(model, fit.lens, views)
        if again is not None:
            fit = refine(model, fit.lens, again, views, free, rough=True)
        if best is None or fit.robust_cost < best.robust_cost:
            best = fit
    return best


def poses_of_views(
    model: CameraModel, lens: Float[np.ndarray, "p"], views: Sequence[BoardView]
) -> Float[np.ndarray, "v 6"] | None:
    """Find each board's pose directly, for a known lens; None if a view does not determine one."""
    camera = camera_of_lens(model, lens, (views[0].width, views[0].height))
    rays = camera.unproject(np.concatenate([view.corners_px for view in views]))
    ends = np.cumsum([len(view.corners_px) for view in views])[:-1]
    poses = [pose_of_plane(view.points_cm, r) for view, r in zip(views, np.split(rays, ends), strict=True)]
    found = [pose for pose in poses if pose is not None]
    return np.array(found) if len(found) == len(views) else None


def view_residuals(
    model: CameraModel,
    lens: Float[np.ndarray, "p"],
    poses: Float[np.ndarray, "v 6"],
    views: Sequence[BoardView],
) -> list[Float[np.ndarray, "_ 2"]]:
    """Return measured minus projected corners of each view, [px]."""
    moved = [moved_points(pose, view.points_cm)[0] for pose, view in zip(poses, views, strict=True)]
    # One call for all views: the call costs more than the arithmetic.
    pixels = project_points(model, lens, np.concatenate(moved))[0]
    ends = np.cumsum([len(points) for points in moved])[:-1]
    return [view.corners_px - part for view, part in zip(views, np.split(pixels, ends), strict=True)]


def refine(
    model: CameraModel,
    lens: Float[np.ndarray, "p"],
    poses: Float[np.ndarray, "v 6"],
    views: Sequence[BoardView],
    free: Bool[np.ndarray, "p"],
    rough: bool = False,
) -> LensFit:
    """Fit lens and poses to all corners.

    Args:
        model: Lens model.
        lens: Where to start.
        poses: Where the boards start.
        views: Views of one camera.
        free: Which numbers of the lens may move.
        rough: The start may be far off, and a few digits are enough.

    Returns:
        The fit, with standard deviations from its Jacobian and the spread of its residuals.
    """
    n_free = int(np.count_nonzero(free))
    ends = 2 * np.cumsum([len(view.points_cm) for view in views])
    measured = np.concatenate([view.corners_px for view in views])

    def unpack(x: Float[np.ndarray, "x"]) -> tuple[Float[np.ndarray, "p"], Float[np.ndarray, "v 6"]]:
        full = lens.copy()
        full[free] = x[:n_free]
        return full, x[n_free:].reshape(-1, 6)

    def linearised(x: Float[np.ndarray, "x"]) -> tuple[Float[np.ndarray, "r"], Float[np.ndarray, "r x"]]:
        full, moved = unpack(x)
        matrix = np.zeros((int(ends[-1]), len(x)))
        boards = [moved_points(pose, view.points_cm) for pose, view in zip(moved, views, strict=True)]
        # One call for all views: the call costs more than the arithmetic.
        found, by_point, by_lens = project_points(
            model, full, np.concatenate([points for points, _ in boards])
        )
        by_pose = by_point @ np.concatenate([derivatives for _, derivatives in boards])
        matrix[:, :n_free] = by_lens[:, :, free].reshape(-1, n_free)
        for k, (start, end) in enumerate(zip([0, *ends[:-1]], ends, strict=True)):
            columns = slice(n_free + 6 * k, n_free + 6 * k + 6)
            matrix[start:end, columns] = by_pose[start // 2 : end // 2].reshape(-1, 6)
        return (found - measured).ravel(), matrix

    x = np.concatenate([lens[free], poses.ravel()])
    x, residuals, jacobian, cost = _least_squares(linearised, x, _ROUGH_SEARCH if rough else _FINE_SEARCH)
    full, moved = unpack(x)
    sigma = np.zeros(len(free))
    sigma[free] = standard_deviations(jacobian, residuals)[:n_free]
    return LensFit(
        model=model,
        lens=full,
        free=free,
        poses=moved,
        residuals_px=np.split(-residuals.reshape(-1, 2), ends[:-1] // 2),
        lens_sigma=sigma,
        robust_cost=cost,
    )


def _least_squares(
    linearised: Callable[[Float[np.ndarray, "x"]], tuple[Float[np.ndarray, "r"], Float[np.ndarray, "r x"]]],
    x: Float[np.ndarray, "x"],
    search: _Search,
) -> tuple[Float[np.ndarray, "x"], Float[np.ndarray, "r"], Float[np.ndarray, "r x"], float]:
    """Minimise the soft L1 loss of residuals by Levenberg-Marquardt steps.

    The normal equations have a row per unknown; a decomposition of the whole Jacobian, as general solvers do
    it, costs several times as much.

    Args:
        linearised: Residuals at a point, with their derivatives.
        x: Where to start; its residuals are finite.
        search: When to stop.

    Returns:
        The best point, its residuals and derivatives there, and twice its cost, [residuals^2].

    Source:
        Triggs et al. 2000, sections 4.3 and 6.1 (robust weights, step control); Marquardt 1963 (damping by
        the diagonal).
    """

    def soft(residuals: Float[np.ndarray, "r"]) -> tuple[Float[np.ndarray, "r"], float]:
        """Square roots in the loss, and twice the cost."""
        root = np.hypot(1.0, residuals / search.scale_px)
        return root, 2.0 * search.scale_px**2 * float(np.sum(root - 1.0))

    residuals, jacobian = linearised(x)
    root, cost = soft(residuals)
    damping = _FIRST_DAMPING
    for _ in range(search.most_evaluations - 1):
        weighted = jacobian * root[:, None] ** -1.5
        normal = weighted.T @ weighted
        gradient = jacobian.T @ (residuals / root)
        size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
        damped = normal / np.outer(size, size) + damping * np.eye(len(x))
        try:
            move = -np.linalg.solve(damped, gradient / size) / size
        except np.linalg.LinAlgError:
            damping *= _MORE_DAMPING
            continue
        # Where a step leads too far, the residuals are infinite.
        with np.errstate(over="ignore", invalid="ignore"):
            tried, by_tried = linearised(x + move)
            tried_root, tried_cost = soft(tried)
        if not tried_cost < cost:
            if np.linalg.norm(move) < _LEAST_MOVE * np.linalg.norm(x) or damping > _MOST_DAMPING:
                break
            damping *= _MORE_DAMPING
            continue
        gain = cost - tried_cost
        x, residuals, jacobian, root = x + move, tried, by_tried, tried_root
        damping = max(damping / _LESS_DAMPING, _LEAST_DAMPING)
        cost = tried_cost
        if gain < search.least_gain * cost:
            break
    return x, residuals, jacobian, cost
