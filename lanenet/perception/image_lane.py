"""A lane as lines of the image: what the Hough tracker and the lane painter see, with or without a camera."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from lanenet.errors import CalibrationError
from lanenet.geometry.camera import Camera
from lanenet.geometry.lane import ROWS_CM
from lanenet.perception.edges.canny import check_frame

#: A line is continued towards the car by no more than this, nor by more than the length that is seen.
_MAX_CONTINUED_CM = 30.0
#: The stretch at the near end that gives the direction of the part that no frame sees.
_NEAR_STRETCH_CM = 20.0
_SAMPLES = 41

Polyline = Float[np.ndarray, "_ 2"]


@dataclass(frozen=True)
class ImageLane:
    """A frame's lane lines in the image, for drawing and for cars without a calibrated camera.

    Attributes:
        left_px: Left line, near to far, [px], frame image; None where it was not found.
        right_px: Right line.
        memory_px: Lines that the detector remembers from earlier frames.
        filled: The area between the lines is to be filled.
        text: What else the detector has to say, for people.
    """

    left_px: Polyline | None = None
    right_px: Polyline | None = None
    memory_px: tuple[Polyline, ...] = ()
    filled: bool = False
    text: str = ""


def to_bgr(frame_bgr: UInt8[np.ndarray, "h w *c"]) -> UInt8[np.ndarray, "h w 3"]:
    """Return a colour or gray frame as colour.

    Raises:
        DriveFormatError: If the array is not an image of one or three uint8 channels.
    """
    frame = check_frame(frame_bgr)
    return frame if frame.ndim == 3 else np.asarray(cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR))


def check_size(frame_bgr: UInt8[np.ndarray, "h w 3"], camera: Camera | None) -> None:
    """Refuse a frame that is not of the camera's size.

    Raises:
        CalibrationError: With both sizes.
    """
    height, width = frame_bgr.shape[:2]
    if camera is not None and (width, height) != (camera.width, camera.height):
        raise CalibrationError(
            f"frame of {width}x{height} px, but the camera is calibrated for {camera.width}x{camera.height}"
        )


def sample_segment(
    near_px: tuple[float, float], far_px: tuple[float, float]
) -> Float[np.ndarray, "samples 2"]:
    """Return points along a straight line of the image, near to far, [px]."""
    return np.linspace(np.array(near_px, np.float64), np.array(far_px, np.float64), _SAMPLES)


def rows_on_road(line_px: Float[np.ndarray, "n 2"], camera: Camera) -> Float[np.ndarray, "3"]:
    """Move a line of the image to the road and find where it crosses the label rows.

    Between the nearest and the farthest point that is seen, x is interpolated. Rows nearer than that lie on
    the straight line through the nearest 20 cm, if they are no more than 30 cm and no more than the length
    seen away from it; rows nearer still, and rows farther, are not known.

    Args:
        line_px: Polyline, [px], frame image.
        camera: Calibrated camera.

    Returns:
        x at y = 0, 15, 30 cm, [cm], frame car; NaN where unknown.

    Source:
        Own derivation; tested against lines of the road projected into the image.
    """
    points = camera.intersect_ground(np.asarray(line_px, np.float64))
    return rows_of_points(points[np.isfinite(points).all(axis=1)])


def rows_of_points(points_cm: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "3"]:
    """As :func:`rows_on_road`, from points of one line on the road, [cm], frame car, in any order."""
    result = np.full(len(ROWS_CM), np.nan)
    order = np.argsort(points_cm[:, 1], kind="stable")
    x, y = points_cm[order, 0], points_cm[order, 1]
    if len(y) < 2 or y[-1] - y[0] < 1.0:
        return result
    rows = np.array(ROWS_CM)
    seen = (rows >= y[0]) & (rows <= y[-1])
    result[seen] = np.interp(rows[seen], y, x)
    stretch = y <= max(y[0] + _NEAR_STRETCH_CM, y[1])
    centred = y[stretch] - y[stretch].mean()
    if (centred @ centred) > 1e-9:
        slope = float(centred @ x[stretch]) / float(centred @ centred)
        nearer = (rows < y[0]) & (y[0] - rows <= min(_MAX_CONTINUED_CM, y[-1] - y[0]))
        result[nearer] = x[0] + slope * (rows[nearer] - y[0])
    return result
