"""A camera's lens from views of a chessboard: views are judged, the model chosen, nonsense refused."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from lanenet.calibration.bundle import LensFit, free_numbers, poses_of_views, refine, start_fit
from lanenet.calibration.chessboard import BoardView
from lanenet.calibration.lens import N_INTRINSIC, camera_of_lens, project_points
from lanenet.calibration.pose import moved_points, rotation_from_vector
from lanenet.calibration.views import MIN_VIEWS, check_count, usable_views
from lanenet.errors import CalibrationError
from lanenet.geometry.camera import Camera, CameraModel, Mounting

ModelChoice = Literal["fisheye", "pinhole", "auto"]

#: Entries of D that are fitted, in steps: a lens gets the further ones only if the views support them.
_STEPS: dict[CameraModel, tuple[tuple[int, ...], ...]] = {
    "fisheye": ((0,), (0, 1), (0, 1, 2), (0, 1, 2, 3)),
    "pinhole": ((0,), (0, 1), (0, 1, 2, 3), (0, 1, 2, 3, 4)),
}
#: A view is dropped if its RMS is beyond this multiple of the median view's, and beyond the floor.
_BAD_VIEW_RATIO, _BAD_VIEW_FLOOR_PX = 3.5, 0.3
#: A model whose rough fit costs this many times the other's is not refined.
_HOPELESS_RATIO = 30.0
#: In units of the Bayesian information criterion: 20 is overwhelming evidence.
_FOLD_COST = 20.0
_MAX_FOCAL_SIGMA, _MAX_CENTRE_SIGMA = 0.02, 0.03
_MIN_NORMAL_SPREAD_DEG = 10.0
#: Largest believable RMS as a share of the image's diagonal, but never below half a pixel. A pinhole forced
#: on a fisheye, or two lenses in one set of views, can be bent to fit within twice as much.
_MAX_RMS, _LEAST_LIMIT_PX = 0.0015, 0.5


@dataclass(frozen=True)
class ChessboardCalibration:
    """A calibrated lens and what speaks for it.

    Attributes:
        camera: The camera; its mounting is the nominal one that was passed in.
        views: The views that were used.
        fit: The fit over these views.
        dropped: Views that were not used, each with the reason.
        notes: Further findings that a user should read.
        seen_angle_rad: Largest angle from the axis at which a corner was seen.
        bic: Evidence for each model that was tried; the lowest is best.
    """

    camera: Camera
    views: list[BoardView]
    fit: LensFit
    dropped: dict[str, str]
    notes: list[str]
    seen_angle_rad: float
    bic: dict[str, float]

    @property
    def residuals(self) -> dict[str, float]:
        """Figures of the fit for the camera file; each name ends in its unit."""
        s = self.fit.lens_sigma
        return {
            "rms_px": self.fit.rms_px,
            "worst_view_rms_px": float(self.fit.view_rms_px.max()),
            "views_count": float(len(self.views)),
            "fx_sigma_px": float(s[0]),
            "fy_sigma_px": float(s[1]),
            "cx_sigma_px": float(s[2]),
            "cy_sigma_px": float(s[3]),
            "seen_angle_rad": self.seen_angle_rad,
        }


def calibrate_lens(
    views: Sequence[BoardView],
    model: ModelChoice = "auto",
    mounting: Mounting | None = None,
    wheelbase_cm: float = 26.0,
    progress: Callable[..., Any] | None = None,
) -> ChessboardCalibration:
    """Find the lens of a camera from views of a chessboard.

    Args:
        views: Views of one camera; those of another size than most are left out and named.
        model: Lens model, or ``auto`` for the one with more evidence.
        mounting: Nominal mounting to write into the camera; boards in the hand say nothing about it.
        wheelbase_cm: Distance between the car's axles.
        progress: Called with steps done and their number.

    Returns:
        The camera, its uncertainty, and the views that were left out.

    Raises:
        CalibrationError: If there are too few views, the views are too alike to determine the lens, too many
            of them contradict each other, or the lens that fits best is not one that can exist.
    """
    dropped: dict[str, str] = {}
    kept = usable_views(views, dropped)
    check_count(kept, dropped)
    models: tuple[CameraModel, ...] = ("fisheye", "pinhole") if model == "auto" else (model,)
    fits: dict[CameraModel, LensFit] = {}
    reasons: list[str] = []
    steps = 2 * len(models) + 1
    starts: dict[CameraModel, LensFit] = {}
    for done, candidate in enumerate(models):
        start = start_fit(candidate, kept)
        if start is not None:
            starts[candidate] = start
        else:
            reasons.append(f"{candidate}: no focal length explains the corners")
        if progress is not None:
            progress(done + 1, steps)
    least = min((start.robust_cost for start in starts.values()), default=0.0)
    for done, (candidate, start) in enumerate(starts.items()):
        if start.robust_cost > _HOPELESS_RATIO * least:
            reasons.append(f"{candidate}: misses the corners by {start.rms_px:.1f} px")
            continue
        used = _consistent(start, kept)
        fit = _best_step(candidate, replace(start, poses=start.poses[used]), [kept[k] for k in used])
        if progress is not None:
            progress(len(models) + done + 1, steps)
        problem = _impossible(fit, [kept[k] for k in used])
        if problem is None:
            fits[candidate] = fit
        else:
            reasons.append(f"{candidate}: {problem}")
    if not fits:
        raise CalibrationError(f"no lens fits these views ({'; '.join(reasons)})")
    chosen, used_views, fits = _judged(fits, kept)
    fit = fits[chosen]
    for view in kept:
        if view not in used_views:
            dropped[view.name] = "its corners contradict the other views"
    check_count(used_views, dropped)
    if 2 * len(used_views) < len(kept):
        raise CalibrationError(
            f"only {len(used_views)} of {len(kept)} views agree with each other; are they of one camera with "
            "fixed focus, and of one flat board?"
        )
    camera = camera_of_lens(chosen, fit.lens, (kept[0].width, kept[0].height), mounting, wheelbase_cm)
    angles = _angles_rad(fit, used_views)
    _check_sound(fit, camera)
    if progress is not None:
        progress(steps, steps)
    return ChessboardCalibration(
        camera=camera,
        views=used_views,
        fit=fit,
        dropped=dropped,
        notes=_notes(camera, used_views, float(angles.max()), reasons),
        seen_angle_rad=float(angles.max()),
        bic={name: candidate.bic for name, candidate in fits.items()},
    )


def _consistent(fit: LensFit, views: Sequence[BoardView], floor_px: float | None = None) -> list[int]:
    """Views whose residuals are of the size of the others'."""
    floor = 0.004 * np.hypot(views[0].width, views[0].height) if floor_px is None else floor_px
    rms = fit.view_rms_px
    return [int(k) for k in np.flatnonzero(rms <= max(_BAD_VIEW_RATIO * float(np.median(rms)), floor))]


def _best_step(model: CameraModel, start: LensFit, views: Sequence[BoardView]) -> LensFit:
    """The number of distortion coefficients that the views support."""
    fits: list[LensFit] = []
    lens, poses = start.lens, start.poses
    for distortion in _STEPS[model]:
        free = free_numbers(model, distortion)
        fit = refine(model, np.where(free, lens, 0.0), poses, views, free)
        fits.append(fit)
        lens, poses = fit.lens, fit.poses
    believable = [fit for fit in fits if _impossible(fit, views) is None]
    return min(believable or fits, key=lambda fit: _cost(fit, views))


def _cost(fit: LensFit, views: Sequence[BoardView]) -> float:
    """Evidence against a lens; one that folds back inside the image needs clear evidence for itself."""
    width, height = views[0].width, views[0].height
    x, y = 0.5 * (width - 1), 0.5 * (height - 1)
    rim = np.array([[0.0, 0.0], [x, 0.0], [0.0, y], [2.0 * x, y], [x, 2.0 * y], [2.0 * x, 2.0 * y]])
    seen = camera_of_lens(fit.model, fit.lens, (width, height)).unproject(rim)
    return fit.bic + (0.0 if np.isfinite(seen).all() else _FOLD_COST)


def _judged(
    fits: dict[CameraModel, LensFit], views: list[BoardView]
) -> tuple[CameraModel, list[BoardView], dict[CameraModel, LensFit]]:
    """Drop views until the rest agree, then choose the model on the same views for all."""
    used = list(range(len(views)))
    for _ in range(len(views)):
        current: dict[CameraModel, LensFit] = {}
        for name, fit in fits.items():
            subset = [views[k] for k in used]
            poses = poses_of_views(name, fit.lens, subset)
            if poses is not None:
                current[name] = _best_step(name, replace(fit, poses=poses), subset)
        current = {
            k: f for k, f in current.items() if _impossible(f, [views[i] for i in used]) is None
        } or current
        if not current:
            # Only views that the lens cannot see at all end here; the first fits speak for the rest.
            raise CalibrationError("the views contradict each other: no lens explains them together")
        chosen = min(current, key=lambda name: _cost(current[name], [views[k] for k in used]))
        good = _consistent(current[chosen], [views[k] for k in used], _BAD_VIEW_FLOOR_PX)
        if len(good) == len(used) or len(good) < MIN_VIEWS:
            return chosen, [views[k] for k in used], current
        # The worst quarter at a time: a bad view spoils the residuals of good ones.
        rms = current[chosen].view_rms_px
        bad = sorted(set(range(len(used))) - set(good), key=lambda k: -rms[k])
        gone = set(bad[: max(1, len(used) // 4)])
        used = [k for i, k in enumerate(used) if i not in gone]
    raise CalibrationError("the views contradict each other: no lens explains them together")


def _angles_rad(fit: LensFit, views: Sequence[BoardView]) -> Float[np.ndarray, "n"]:
    """Angle of each corner from the optical axis."""
    solid = [np.column_stack([view.points_cm, np.zeros(len(view.points_cm))]) for view in views]
    points = np.concatenate([moved_points(p, s)[0] for p, s in zip(fit.poses, solid, strict=True)])
    return np.arctan2(np.hypot(points[:, 0], points[:, 1]), points[:, 2])


def _impossible(fit: LensFit, views: Sequence[BoardView]) -> str | None:
    """Why no real lens is like this one; None if it may exist."""
    width, height = views[0].width, views[0].height
    fx, fy, cx, cy = fit.lens[:N_INTRINSIC]
    if not np.isfinite(fit.lens).all() or not 0.05 * width < min(fx, fy) <= max(fx, fy) < 50.0 * width:
        return f"focal lengths {fx:.4g} and {fy:.4g} px for an image of {width} px"
    if not 0.67 < fx / fy < 1.5:
        return f"focal lengths {fx:.4g} and {fy:.4g} px differ by more than half"
    if not (0.1 * width < cx < 0.9 * width and 0.1 * height < cy < 0.9 * height):
        return f"principal point {cx:.1f}, {cy:.1f} at the rim of {width}x{height} px"
    angles = _angles_rad(fit, views)
    camera = camera_of_lens(fit.model, fit.lens, (width, height))
    if angles.max() > camera.max_angle_rad:
        return f"folds the image back at {np.rad2deg(camera.max_angle_rad):.0f} degrees, inside the board"
    return None


def _check_sound(fit: LensFit, camera: Camera) -> None:
    limit_px = max(_LEAST_LIMIT_PX, _MAX_RMS * float(np.hypot(camera.width, camera.height)))
    if fit.rms_px > limit_px:
        raise CalibrationError(
            f"the best lens misses the corners by {fit.rms_px:.2f} px RMS, expected below "
            f"{limit_px:.2f} px; is the board flat, its size right, the focus fixed, the lens model the "
            "right one, and are all views of one lens?"
        )
    normals = np.array([rotation_from_vector(pose[:3])[:, 2] for pose in fit.poses])
    normals *= np.sign(np.sum(normals * fit.poses[:, 3:], axis=1, keepdims=True))
    spread_deg = float(np.rad2deg(np.arccos(np.clip((normals @ normals.T).min(), -1.0, 1.0))))
    focal = float(max(fit.lens_sigma[0] / fit.lens[0], fit.lens_sigma[1] / fit.lens[1]))
    centre = float(max(fit.lens_sigma[2] / camera.width, fit.lens_sigma[3] / camera.height))
    if spread_deg < _MIN_NORMAL_SPREAD_DEG or not focal < _MAX_FOCAL_SIGMA or not centre < _MAX_CENTRE_SIGMA:
        raise CalibrationError(
            f"the views are too alike to determine the lens: boards tilted by up to {spread_deg:.0f} degrees "
            f"against each other (expected {_MIN_NORMAL_SPREAD_DEG:.0f} or more), focal length known to "
            f"{100.0 * focal:.1f} % (expected {100.0 * _MAX_FOCAL_SIGMA:.0f} %), principal point to "
            f"{100.0 * centre:.1f} % of the image; tilt the board by 20 to 45 degrees in different directions"
        )


def _notes(camera: Camera, views: Sequence[BoardView], seen_rad: float, reasons: Sequence[str]) -> list[str]:
    notes = [f"not considered: {reason}" for reason in reasons]
    partial = [view.name for view in views if not view.complete]
    if partial:
        notes.append(f"cut-off boards used in part: {', '.join(partial)}")
    corners = np.concatenate([view.corners_px for view in views])
    centre = np.array([camera.K[0, 2], camera.K[1, 2]])
    rim = np.array([[0.0, 0.0], [camera.width, 0.0], [0.0, camera.height], [camera.width, camera.height]])
    share = np.linalg.norm(corners - centre, axis=1).max() / np.linalg.norm(rim - centre, axis=1).min()
    if share < 0.7:
        notes.append(
            f"the boards reach {100.0 * share:.0f} % of the way to the image's corners; beyond "
            f"{np.rad2deg(seen_rad):.0f} degrees from the axis the lens is extrapolated"
        )
    return notes


def view_errors_px(result: ChessboardCalibration) -> dict[str, float]:
    """Return the RMS of each used view, [px], by name."""
    return dict(zip([view.name for view in result.views], result.fit.view_rms_px.tolist(), strict=True))


def reprojected(result: ChessboardCalibration, index: int) -> Float[np.ndarray, "n 2"]:
    """Project the corners of a used view with the lens found, [px]."""
    view, pose = result.views[index], result.fit.poses[index]
    solid = np.column_stack([view.points_cm, np.zeros(len(view.points_cm))])
    return project_points(result.fit.model, result.fit.lens, moved_points(pose, solid)[0])[0]
