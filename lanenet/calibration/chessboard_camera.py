"""A camera's lens from views of a chessboard: check views, choose the model, refuse what no lens is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from lanenet.calibration.bundle import (
    LensFit,
    free_numbers,
    neighbour_correlation,
    poses_of_views,
    refine,
    start_fit,
)
from lanenet.calibration.chessboard import BoardView
from lanenet.calibration.lens import (
    N_INTRINSIC,
    camera_of_lens,
    moved_points,
    project_points,
    rotation_from_vector,
)
from lanenet.calibration.views import (
    BAD_VIEW_RATIO,
    MIN_VIEWS,
    best_split,
    check_count,
    focal_scales,
    usable_views,
)
from lanenet.errors import CalibrationError
from lanenet.geometry.camera import NOMINAL_WHEELBASE_CM, Camera, CameraModel, Mounting

ModelChoice = Literal["fisheye", "pinhole", "auto"]

#: Largest sigma of the focal length as a share of it, and of the principal point as a share of the image.
#: Chosen: 2 % of focal length is 6 mm at 30 cm, as exact as six labels are on a real drive.
_MAX_FOCAL_SIGMA, _MAX_CENTRE_SIGMA = 0.02, 0.03
#: Least angle between the most different boards. Chosen; 20 to 45 degrees are recommended to users.
_MIN_NORMAL_SPREAD_DEG = 10.0
#: Largest believable RMS as a share of the image's diagonal, but never below half a pixel.
_MAX_RMS, _LEAST_LIMIT_PX = 0.0015, 0.5
#: An RMS beyond this is worth a note.
_GOOD_RMS_PX = 0.5
_ASK = "is the board flat, its size right, the focus fixed, and are all views of one camera?"


@dataclass(frozen=True)
class ChessboardCalibration:
    """A calibrated lens with its evidence.

    Attributes:
        camera: The camera; its mounting is the nominal one that was passed in.
        views: The views that were used.
        fit: The fit over these views.
        dropped: Views that were not used, each with the reason.
        notes: Further findings that a user should read.
        seen_angle_rad: Largest angle from the axis at which a corner was seen.
    """

    camera: Camera
    views: list[BoardView]
    fit: LensFit
    dropped: dict[str, str]
    notes: list[str]
    seen_angle_rad: float

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
    wheelbase_cm: float = NOMINAL_WHEELBASE_CM,
    progress: Callable[..., Any] | None = None,
) -> ChessboardCalibration:
    """Find the lens of a camera from views of a chessboard.

    Args:
        views: Views of one camera; those of another size than most are left out and named.
        model: Lens model, or ``auto`` for the one with more evidence. A model asked for has to hold its own
            against the other.
        mounting: Nominal mounting to write into the camera; boards in the hand say nothing about it.
        wheelbase_cm: Distance between the car's axles.
        progress: Called with steps done and their number.

    Returns:
        The camera, its uncertainty, and the views that were left out.

    Raises:
        CalibrationError: If there are too few views, the views are too alike to determine the lens, too many
            of them contradict each other, they are of two lenses, the model asked for is far worse than the
            other, or the lens that fits best is not one that can exist.
    """
    kept, dropped = usable_views(views)
    check_count(kept, dropped)
    # Both models are fitted even if one is asked for: only a comparison shows that it was the wrong one.
    fits, reasons = first_fits(kept, progress)
    if not fits:
        tried = "; ".join(f"{name}: {reason}" for name, reason in reasons.items())
        raise CalibrationError(f"the views do not fit one board: no lens explains them ({tried}); {_ASK}")
    _check_one_lens(min(fits.values(), key=lambda fit: fit.robust_cost), kept)
    chosen, used_views, fits = judged_fits(fits, kept)
    notes = [f"not considered: {name}: {reason}" for name, reason in reasons.items() if model == "auto"]
    if model != "auto" and model != chosen:
        note = check_wanted_model(model, chosen, fits, reasons.get(model))
        notes += [] if note is None else [note]
        chosen, used_views, fits = judged_fits({model: fits[model]}, kept)
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
    seen_rad = float(angles_rad(fit, used_views).max())
    _check_sound(fit, camera)
    return ChessboardCalibration(
        camera=camera,
        views=used_views,
        fit=fit,
        dropped=dropped,
        notes=[*notes, *_notes(camera, used_views, seen_rad, fit.rms_px)],
        seen_angle_rad=seen_rad,
    )


def _check_one_lens(fit: LensFit, views: Sequence[BoardView]) -> None:
    """Refuse views of two lenses, the ones that a single lens would leave out included."""
    poses = poses_of_views(fit.model, fit.lens, views)
    scales = None if poses is None else focal_scales(replace(fit, poses=poses), views)
    split = None if scales is None else best_split(scales)
    if split is None or not split.is_clear:
        return
    longer, shorter, unsure = (
        ", ".join(views[k].name for k in group) for group in (split.longer, split.shorter, split.unsure)
    )
    rest = f" ({unsure}: unclear)" if unsure else ""
    raise CalibrationError(
        "the views are of two lenses, or the focus or zoom has moved: the focal length is "
        f"{100.0 * split.difference:.1f} % longer in {longer} than in {shorter}{rest}; calibrate each "
        "group on its own"
    )


def _check_sound(fit: LensFit, camera: Camera) -> None:
    limit_px = max(_LEAST_LIMIT_PX, _MAX_RMS * float(np.hypot(camera.width, camera.height)))
    if fit.rms_px > limit_px:
        raise CalibrationError(
            f"the views do not fit one board: the best {fit.model} lens misses the corners by "
            f"{fit.rms_px:.2f} px RMS, expected below {limit_px:.2f} px; {_ASK}"
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


def _notes(camera: Camera, views: Sequence[BoardView], seen_rad: float, rms_px: float) -> list[str]:
    notes = []
    if rms_px > _GOOD_RMS_PX:
        notes.append(
            f"RMS {rms_px:.2f} px, sharp photos of a flat board give less than {_GOOD_RMS_PX:g} px; {_ASK}"
        )
    if folds_inside(camera):
        notes.append(
            f"the lens sees up to {np.rad2deg(camera.max_angle_rad):.0f} degrees from the axis; the image's "
            "corners lie beyond and stay without a ray"
        )
    partial = [view.name for view in views if not view.complete]
    if partial:
        notes.append(f"cut-off boards used in part: {', '.join(partial)}")
    corners = np.concatenate([view.corners_px for view in views])
    centre = np.array([camera.K[0, 2], camera.K[1, 2]])
    rim = np.array([[0.0, 0.0], [camera.width, 0.0], [0.0, camera.height], [camera.width, camera.height]])
    share = np.linalg.norm(corners - centre, axis=1).max() / np.linalg.norm(rim - centre, axis=1).min()
    if share < 0.7:
        notes.append(
            f"the boards reach {100.0 * share:.0f} % of the distance to the image's corners; beyond "
            f"{np.rad2deg(seen_rad):.0f} degrees from the axis the lens is extrapolated"
        )
    return notes


def view_errors_px(result: ChessboardCalibration) -> dict[str, float]:
    """Return the RMS of each used view, [px], by name."""
    return dict(zip([view.name for view in result.views], result.fit.view_rms_px.tolist(), strict=True))


def reprojected(result: ChessboardCalibration, index: int) -> Float[np.ndarray, "n 2"]:
    """Project the corners of a used view with the lens found, [px]."""
    view, pose = result.views[index], result.fit.poses[index]
    points_cm = moved_points(pose, view.points_cm)[0]
    return project_points(result.fit.model, result.fit.lens, points_cm)[0]


#: Entries of D that are fitted, step by step; a lens gets the later ones only if the views support them.
_STEPS: dict[CameraModel, tuple[tuple[int, ...], ...]] = {
    "fisheye": ((0,), (0, 1), (0, 1, 2), (0, 1, 2, 3)),
    "pinhole": ((0,), (0, 1), (0, 1, 2, 3), (0, 1, 2, 3, 4)),
}
#: A view is dropped if its RMS exceeds ``BAD_VIEW_RATIO`` times the median view's, and this floor. Chosen:
#: above what a sharp photo of a flat board leaves.
_BAD_VIEW_FLOOR_PX = 0.3
#: A model whose rough fit costs this many times the other's is not refined. Chosen, with a wide margin.
_HOPELESS_RATIO = 30.0
#: Added to the Bayesian information criterion of a lens that folds back inside the image. Kass and Raftery
#: 1995 call a difference of 10 very strong; chosen: twice that.
_FOLD_COST = 20.0
#: A requested model is refused if the other one's RMS is smaller by this factor and by this much, and noted
#: from the lower factor on. Chosen: half again as large an error shows in cm, 15 % hardly.
_FAR_BETTER_RATIO, _FAR_BETTER_PX, _BETTER_RATIO = 1.5, 0.1, 1.15


def first_fits(
    views: Sequence[BoardView], progress: Callable[..., Any] | None = None
) -> tuple[dict[CameraModel, LensFit], dict[CameraModel, str]]:
    """Fit each lens model from nothing.

    Args:
        views: Views of one camera.
        progress: Called with steps done and their number.

    Returns:
        The fits of the models that may be, and for the others the reason why not.
    """
    starts: dict[CameraModel, LensFit] = {}
    reasons: dict[CameraModel, str] = {}
    steps = 2 * len(_STEPS)
    for done, candidate in enumerate(_STEPS):
        start = start_fit(candidate, views)
        if start is None:
            reasons[candidate] = "no focal length explains the corners"
        else:
            starts[candidate] = start
        if progress is not None:
            progress(done + 1, steps)
    least = min((start.robust_cost for start in starts.values()), default=0.0)
    fits: dict[CameraModel, LensFit] = {}
    for done, (candidate, start) in enumerate(starts.items()):
        if start.robust_cost > _HOPELESS_RATIO * least:
            reasons[candidate] = miss_text(start.rms_px, views)
            continue
        used = _consistent(start, views)
        fit = _best_step(candidate, replace(start, poses=start.poses[used]), [views[k] for k in used])
        problem = _impossible(fit, [views[k] for k in used])
        if problem is None:
            fits[candidate] = fit
        else:
            reasons[candidate] = problem
        if progress is not None:
            progress(len(_STEPS) + done + 1, steps)
    return fits, reasons


def judged_fits(
    fits: dict[CameraModel, LensFit], views: Sequence[BoardView]
) -> tuple[CameraModel, list[BoardView], dict[CameraModel, LensFit]]:
    """Drop views until the rest agree, then choose the model on the same views for all.

    Args:
        fits: First fit of each model.
        views: All views.

    Returns:
        The better model, the views that were used, and each model's fit over them.

    Raises:
        CalibrationError: If no views agree.
    """
    used = list(range(len(views)))
    for _ in range(len(views)):
        subset = [views[k] for k in used]
        current: dict[CameraModel, LensFit] = {}
        for name, fit in fits.items():
            poses = poses_of_views(name, fit.lens, subset)
            if poses is not None:
                current[name] = _best_step(name, replace(fit, poses=poses), subset)
        current = {k: f for k, f in current.items() if _impossible(f, subset) is None} or current
        if not current:
            # None of the lenses can see these views at all.
            break
        best = best_supported(list(current.values()), subset)
        chosen = next(name for name, fit in current.items() if fit is best)
        good = _consistent(current[chosen], subset, _BAD_VIEW_FLOOR_PX)
        if len(good) == len(used) or len(good) < MIN_VIEWS:
            return chosen, subset, current
        # At most a quarter at a time: a bad view also raises the residuals of good ones.
        rms = current[chosen].view_rms_px
        bad = sorted(set(range(len(used))) - set(good), key=lambda k: -rms[k])
        gone = set(bad[: max(1, len(used) // 4)])
        used = [k for i, k in enumerate(used) if i not in gone]
    raise CalibrationError("the views contradict each other: no lens explains them together")


def check_wanted_model(
    wanted: CameraModel, better: CameraModel, fits: dict[CameraModel, LensFit], reason: str | None
) -> str | None:
    """Compare a model that was asked for with the one that the views support.

    Args:
        wanted: The model asked for.
        better: The model with more evidence.
        fits: Fits over the same views.
        reason: Why the model asked for was not fitted, if it was not.

    Returns:
        A note for the user, or None if the two are alike.

    Raises:
        CalibrationError: If the other model is far better, or the one asked for cannot be.
    """
    advice = f"use --model {better} or --model auto"
    other_px = fits[better].rms_px
    if wanted not in fits:
        why = reason or "it explains none of the views"
        raise CalibrationError(
            f"a {wanted} lens does not fit these views ({why}); a {better} lens does, to {other_px:.2f} px "
            f"RMS: {advice}"
        )
    wanted_px = fits[wanted].rms_px
    if wanted_px > _FAR_BETTER_RATIO * other_px and wanted_px - other_px > _FAR_BETTER_PX:
        raise CalibrationError(
            f"a {wanted} lens misses the corners by {wanted_px:.2f} px RMS, a {better} lens by only "
            f"{other_px:.2f} px: {advice}"
        )
    if wanted_px > _BETTER_RATIO * other_px:
        return f"RMS {wanted_px:.2f} px as {wanted}, {other_px:.2f} px as {better}: {advice}"
    return None


def angles_rad(fit: LensFit, views: Sequence[BoardView]) -> Float[np.ndarray, "n"]:
    """Angle of each corner from the optical axis."""
    points = np.concatenate(
        [moved_points(pose, view.points_cm)[0] for pose, view in zip(fit.poses, views, strict=True)]
    )
    return np.arctan2(np.hypot(points[:, 0], points[:, 1]), points[:, 2])


def miss_text(rms_px: float, views: Sequence[BoardView]) -> str:
    """Say by how much a lens misses; a lens that is off altogether has no meaningful figure."""
    size_px = float(np.hypot(views[0].width, views[0].height))
    return f"misses the corners by {rms_px:.1f} px" if rms_px < size_px else "misses the corners altogether"


def _consistent(fit: LensFit, views: Sequence[BoardView], floor_px: float | None = None) -> list[int]:
    """Views whose residuals are of the size of the others'."""
    floor = 0.004 * np.hypot(views[0].width, views[0].height) if floor_px is None else floor_px
    rms = fit.view_rms_px
    return [int(k) for k in np.flatnonzero(rms <= max(BAD_VIEW_RATIO * float(np.median(rms)), floor))]


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
    return best_supported(believable or fits, views)


def best_supported(fits: Sequence[LensFit], views: Sequence[BoardView]) -> LensFit:
    """The fit with the most evidence; a lens that folds back inside the image needs clear evidence.

    What the best of the fits leaves tells how alike neighbouring residuals are.
    """
    size = (views[0].width, views[0].height)
    alike = neighbour_correlation(views, min(fits, key=lambda fit: fit.robust_cost).residuals_px)

    def cost(fit: LensFit) -> float:
        folds = folds_inside(camera_of_lens(fit.model, fit.lens, size))
        return fit.bic(alike) + (_FOLD_COST if folds else 0.0)

    return min(fits, key=cost)


def folds_inside(camera: Camera) -> bool:
    """Whether the distortion folds the image back before its corners."""
    x, y = 0.5 * (camera.width - 1), 0.5 * (camera.height - 1)
    rim = np.array([[0.0, 0.0], [x, 0.0], [0.0, y], [2.0 * x, y], [x, 2.0 * y], [2.0 * x, 2.0 * y]])
    return not bool(np.isfinite(camera.unproject(rim)).all())


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
    camera = camera_of_lens(fit.model, fit.lens, (width, height))
    fold = f"folds the image back at {np.rad2deg(camera.max_angle_rad):.0f} degrees"
    if angles_rad(fit, views).max() > camera.max_angle_rad:
        return f"{fold}, inside the board"
    # A fisheye's image may end before the image's corners do, a pinhole's may not.
    nearest = np.array([[0.0, cy], [width - 1.0, cy], [cx, 0.0], [cx, height - 1.0]])
    edge = nearest[[int(np.argmin(np.linalg.norm(nearest - [cx, cy], axis=1)))]]
    if (fit.model == "pinhole" and folds_inside(camera)) or not np.isfinite(camera.unproject(edge)).all():
        return f"{fold}, inside the image"
    return None
