"""Images by which a person judges a calibration: without the lens, and from above with a grid in cm."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from lanenet.calibration.lens import moved_points
from lanenet.geometry.camera import Camera
from lanenet.perception.draw import outlined_text
from lanenet.perception.edges.views import View

#: BGR of the grid's lines, of its axes, of measured and of projected points.
GRID_BGR, AXIS_BGR, MEASURED_BGR, PROJECTED_BGR = (200, 160, 60), (60, 60, 230), (60, 220, 60), (40, 60, 240)
_MAX_SIDE_PX = 1200
#: Spacing of grid lines, [cm]: the finest that leaves this many pixels between them.
_SPACINGS_CM, _MIN_SPACING_PX = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0), 28.0


def plane_picture(
    frame_bgr: UInt8[np.ndarray, "h w 3"],
    camera: Camera,
    pose: Float[np.ndarray, "6"],
    area_cm: tuple[float, float, float, float],
    px_per_cm: float | None = None,
) -> UInt8[np.ndarray, "rows columns 3"]:
    """Show a plane (the road, a board) from above, with a grid in cm.

    Args:
        frame_bgr: Frame of the camera.
        camera: The camera.
        pose: Pose of the plane in the camera frame: rotation vector and translation, [rad], [cm].
        area_cm: Left, near, right and far edge of what is shown, frame of the plane.
        px_per_cm: Scale; by default so that the longer side has 800 px.

    Returns:
        The image: x to the right, y upwards.
    """
    left, near, right, far = area_cm
    scale = 800.0 / max(right - left, far - near) if px_per_cm is None else px_per_cm
    columns = int(np.clip(round((right - left) * scale), 8, _MAX_SIDE_PX))
    rows = int(np.clip(round((far - near) * scale), 8, _MAX_SIDE_PX))
    v, u = np.mgrid[:rows, :columns].astype(np.float64)
    x, y = left + (u + 0.5) / scale, far - (v + 0.5) / scale
    plane = np.stack([x.ravel(), y.ravel()], axis=1)
    image = View.of_rays(camera, moved_points(pose, plane)[0], rows, columns).of(frame_bgr)
    _draw_grid(image, area_cm, scale)
    return image


def points_picture(
    frame_bgr: UInt8[np.ndarray, "h w 3"],
    measured_px: Float[np.ndarray, "n 2"],
    projected_px: Float[np.ndarray, "n 2"],
) -> UInt8[np.ndarray, "h w 3"]:
    """Draw measured points (green rings) and where the calibration puts them (red dots) into a frame."""
    image = frame_bgr.copy()
    size = max(2, round(image.shape[1] / 200))
    for points, colour, radius, thickness in (
        (measured_px, MEASURED_BGR, 2 * size, 1),
        (projected_px, PROJECTED_BGR, size, -1),
    ):
        for point in points[np.isfinite(points).all(axis=1)]:
            if (np.abs(point) < 1e4).all():
                centre = (round(float(point[0])), round(float(point[1])))
                cv2.circle(image, centre, radius, colour, thickness, cv2.LINE_AA)
    return image


def grid_spacing_cm(px_per_cm: float) -> float:
    """Return the spacing of the grid's lines at a scale, [cm]."""
    for spacing in _SPACINGS_CM:
        if spacing * px_per_cm >= _MIN_SPACING_PX:
            return spacing
    return _SPACINGS_CM[-1]


def _draw_grid(
    image: UInt8[np.ndarray, "rows columns 3"], area_cm: tuple[float, float, float, float], scale: float
) -> None:
    left, near, right, far = area_cm
    rows, columns = image.shape[:2]
    spacing = grid_spacing_cm(scale)
    for k in range(int(np.ceil(left / spacing)), int(np.floor(right / spacing)) + 1):
        u = round((k * spacing - left) * scale - 0.5)
        cv2.line(image, (u, 0), (u, rows - 1), AXIS_BGR if k == 0 else GRID_BGR, 1)
        _write(image, f"{k * spacing:g}", (u + 2, rows - 4))
    for k in range(int(np.ceil(near / spacing)), int(np.floor(far / spacing)) + 1):
        v = round((far - k * spacing) * scale - 0.5)
        cv2.line(image, (0, v), (columns - 1, v), AXIS_BGR if k == 0 else GRID_BGR, 1)
        _write(image, f"{k * spacing:g}", (2, v - 3))
    _write(image, "cm", (columns - 28, 14))


def _write(image: UInt8[np.ndarray, "rows columns 3"], text: str, place: tuple[int, int]) -> None:
    outlined_text(image, text, place, 0.4, (255, 255, 255), (0, 0, 0))
