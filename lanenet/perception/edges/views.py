"""Other views of a frame: without distortion, and from above."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from lanenet.errors import CalibrationError
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.camera import Camera

#: Largest half field of an undistorted image. Chosen: a flat image of 120 degrees already shows the road at
#: half the scale of its middle.
_MAX_HALF_FIELD_RAD = float(np.deg2rad(60.0))
#: Far outside the frame; OpenCV fills such pixels with black.
_NOWHERE_PX = -1e4


class View:
    """For each pixel of a new image, its place in the frame; computed once, used often."""

    def __init__(self, camera: Camera, pixels_px: Float[np.ndarray, "rows columns 2"]) -> None:
        """Take the places in the frame.

        Args:
            camera: Camera of the frames.
            pixels_px: Where each pixel comes from, [px], frame image; NaN where the camera does not see it.
        """
        self._size = (camera.height, camera.width)
        finite = np.nan_to_num(pixels_px, nan=_NOWHERE_PX).clip(_NOWHERE_PX, -_NOWHERE_PX)
        self._maps = cv2.convertMaps(finite.astype(np.float32), None, cv2.CV_16SC2)

    @staticmethod
    def of_rays(camera: Camera, rays: Float[np.ndarray, "n 3"], rows: int, columns: int) -> View:
        """Return the view whose pixels, row by row, look along these rays of the camera frame."""
        return View(camera, camera.project_rays(rays).reshape(rows, columns, 2))

    def of(self, frame: UInt8[np.ndarray, "h w *c"]) -> UInt8[np.ndarray, "rows columns *c"]:
        """Return the new image, black where the camera does not see; the order of channels stays.

        Raises:
            CalibrationError: If the frame is not of the camera's size.
        """
        if frame.shape[:2] != self._size:
            found, expected = frame.shape[1::-1], self._size[::-1]
            raise CalibrationError(
                f"image of {found[0]}x{found[1]} px, expected {expected[0]}x{expected[1]} like the camera's"
            )
        return np.asarray(cv2.remap(frame, *self._maps, cv2.INTER_LINEAR))


def undistorting_view(camera: Camera) -> View:
    """Return the view of a lens without distortion: straight lines appear straight.

    It has the frames' size and direction, and their field of view up to 120 degrees.
    """
    width, height = camera.width, camera.height
    rim = np.array([[0.0, camera.K[1, 2]], [width - 1.0, camera.K[1, 2]]])
    rays = camera.unproject(rim)
    angles = np.arctan2(np.abs(rays[:, 0]), rays[:, 2])
    # If the lens does not reach the image's border, the largest field.
    half = min(float(np.nan_to_num(angles, nan=np.pi).max()), _MAX_HALF_FIELD_RAD)
    focal = 0.5 * width / np.tan(half)
    v, u = np.mgrid[:height, :width].astype(np.float64)
    x, y = (u - 0.5 * (width - 1)) / focal, (v - 0.5 * (height - 1)) / focal
    flat = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
    return View.of_rays(camera, flat, height, width)


def birdseye_view(camera: Camera, window: BirdseyeWindow) -> View:
    """Return the view of the road from above, a pixel for each cell of the window."""
    rows, columns = np.mgrid[: window.rows, : window.columns].astype(np.float64)
    road_cm = window.points(np.stack([rows.ravel(), columns.ravel()], axis=1))
    return View(camera, camera.project_ground(road_cm).reshape(window.rows, window.columns, 2))
