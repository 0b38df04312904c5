"""A lane as lines of the image, as hough and painter find it, with and without a camera."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from lanenet.geometry.camera import Camera
from lanenet.geometry.lane import ROWS_CM
from lanenet.perception.edges.canny import check_frame

#: A line is extrapolated towards the car by at most this, and by at most the length that is seen. Chosen: the
#: distance between the nearest and the farthest label row.
_MAX_CONTINUED_CM = 30.0
#: Length of the near end that gives the direction of the extrapolation. Chosen; half and double leave the
#: painter's RMSE on a synthetic drive as it is (0.79 cm), as they do for the distance above.
_NEAR_END_CM = 20.0
#: Points along a straight line of the image; chosen: a row or two of a 120-row image between them.
_SAMPLES = 41

Polyline = Float[np.ndarray, "_ 2"]
#: A line of the image as numbers: its nearest and its farthest point inside the image, and between their rows
#: the polynomial u = a v^3 + b v^2 + c v + d, all in pixels. A parabola of the road is none of the image: the
#: best one missed the bend of a road photo by up to 12 px near the horizon, a cubic by up to 5.
LINE_PX_NAMES = ("near_u_px", "near_v_px", "far_u_px", "far_v_px", "a_px", "b_px", "c_px", "d_px")
#: Rows of a line that its polynomial is fitted to, evenly over the image; evenly along the road most would
#: lie near the horizon. Chosen: of a road in an image of 1080 rows, two or three rows apart.
_ROWS = 241


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

    def numbers_px(self, width: int, height: int) -> Float[np.ndarray, "2 8"]:
        """Return left and right line as the numbers of :data:`LINE_PX_NAMES`; NaN for a missing line."""
        return np.stack([describe_line(line, width, height) for line in (self.left_px, self.right_px)])


def to_bgr(frame_bgr: UInt8[np.ndarray, "h w *c"]) -> UInt8[np.ndarray, "h w 3"]:
    """Return a colour or gray frame as colour.

    Raises:
        DriveFormatError: If the array is not an image of one or three uint8 channels.
    """
    frame = check_frame(frame_bgr)
    return frame if frame.ndim == 3 else np.asarray(cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR))


def describe_line(line_px: Polyline | None, width: int, height: int) -> Float[np.ndarray, "8"]:
    """Return the numbers of :data:`LINE_PX_NAMES` for a line of the image.

    The polynomial is fitted by least squares.

    Args:
        line_px: Polyline, [px], frame image; None for a missing line.
        width: Of the image, [px].
        height: Of the image, [px].

    Returns:
        The eight numbers; NaN where less than two rows of the line lie inside the image.
    """
    missing = np.full(len(LINE_PX_NAMES), np.nan)
    if line_px is None or len(line_px) < 2:
        return missing
    points = line_px[np.argsort(line_px[:, 1], kind="stable")]
    v = np.linspace(max(points[0, 1], 0.0), min(points[-1, 1], height - 1.0), _ROWS)
    u = np.interp(v, points[:, 1], points[:, 0])
    inside = (u >= 0.0) & (u <= width - 1.0)
    u, v = u[inside], v[inside]
    if len(v) < 4 or v[-1] - v[0] < 1.0:
        return missing
    # Rows from -1 to 1 keep the fit well conditioned; the polynomial is then written out in v.
    fitted = np.polynomial.Polynomial.fit(v, u, 3).convert().coef
    coefficients = np.concatenate([fitted, np.zeros(4 - len(fitted))])[::-1]
    return np.array([u[-1], v[-1], u[0], v[0], *coefficients])


def sample_segment(
    near_px: tuple[float, float], far_px: tuple[float, float]
) -> Float[np.ndarray, "samples 2"]:
    """Return points along a straight line of the image, near to far, [px]."""
    return np.linspace(np.array(near_px, np.float64), np.array(far_px, np.float64), _SAMPLES)


def rows_on_road(line_px: Float[np.ndarray, "n 2"], camera: Camera) -> Float[np.ndarray, "3"]:
    """Move a line of the image to the road and find where it crosses the label rows.

    Between the nearest and the farthest visible point, x is interpolated. A nearer row is extrapolated from
    the nearest 20 cm of the line, over at most 30 cm and at most the visible length; other rows are NaN.

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
    near_end = y <= max(y[0] + _NEAR_END_CM, y[1])
    centred = y[near_end] - y[near_end].mean()
    if (centred @ centred) > 1e-9:
        slope = float(centred @ x[near_end]) / float(centred @ centred)
        nearer = (rows < y[0]) & (y[0] - rows <= min(_MAX_CONTINUED_CM, y[-1] - y[0]))
        result[nearer] = x[0] + slope * (rows[nearer] - y[0])
    return result
