"""A camera's lens from views of a chessboard: check views, choose the model, refuse what no lens is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from lanenet.calibration.bundle import LensFit, poses_of_views
from lanenet.calibration.chessboard import BoardView
from lanenet.calibration.lens import (
    camera_of_lens,
    moved_points,
    plane_points,
    project_points,
    rotation_from_vector,
)
from lanenet.calibration.lens_choice import (
    angles_rad,
    check_wanted_model,
    first_fits,
    folds_inside,
    judged_fits,
)
from lanenet.calibration.views import best_split, check_count, focal_scales, usable_views
from lanenet.errors import CalibrationError
from lanenet.geometry.camera import Camera, Mounting

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
    wheelbase_cm: float = 26.0,
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
    dropped: dict[str, str] = {}
    kept = usable_views(views, dropped)
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
    rest = f" ({unsure}: cannot be told)" if unsure else ""
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
    points_cm = moved_points(pose, plane_points(view.points_cm))[0]
    return project_points(result.fit.model, result.fit.lens, points_cm)[0]
