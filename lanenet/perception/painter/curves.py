"""Curves, which Pentek left for future work: sliding windows, a polynomial, its radius of curvature.

Edge points are moved to a plane; no image is warped. The plane is the road in cm if the camera is known, and
otherwise the trapezoid stretched to the unit square. In both, x points right and y ahead.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from pydantic import Field

from lanenet.config import Settings
from lanenet.geometry.camera import Camera
from lanenet.perception.edges.road import RangeSettings, RoadTable


class CurveSettings(Settings):
    """How a line of the plane is followed; the defaults were chosen on road videos and three tubs.

    Attributes:
        windows: Windows from the near to the far end.
        min_points: Points that a window needs to move the next one.
        min_span_share: Least part of the length over which a curve must have points.
        half_width_share: Half the width of a window in the unit square.
        half_width_heights: Half the width of a window on the road, in camera heights.
    """

    windows: int = Field(default=9, ge=3)
    min_points: int = Field(default=4, ge=1)
    min_span_share: float = Field(default=0.5, gt=0.0, le=1.0)
    half_width_share: float = Field(default=0.05, gt=0.0)
    half_width_heights: float = Field(default=0.3, gt=0.0)


@dataclass(frozen=True)
class Curve:
    """x = a y^2 + b y + c between two rows of the plane.

    Attributes:
        a: Half the curvature on the axis.
        b: Slope at y = 0.
        c: x at y = 0.
        near: Lowest y with points.
        far: Highest y with points.
    """

    a: float
    b: float
    c: float
    near: float
    far: float

    def sample(self, start: float | None = None, count: int = 31) -> Float[np.ndarray, "_ 2"]:
        """Return points along the curve, near to far; from ``start`` to its near end along its tangent."""
        first = self.near if start is None else min(start, self.near)
        y = np.linspace(first, self.far, count)
        on_curve = np.maximum(y, self.near)
        x = (self.a * on_curve + self.b) * on_curve + self.c
        x += (2.0 * self.a * self.near + self.b) * (y - on_curve)
        return np.stack([x, y], axis=1)


def slide_windows(
    points: Float[np.ndarray, "n 2"],
    guess: Float[np.ndarray, "m 2"],
    half_width: float,
    settings: CurveSettings,
) -> Float[np.ndarray, "k 2"]:
    """Collect the points of one line, window by window from near to far.

    Each window lies on the guessed line, shifted by the mean offset of the points in the window before, so
    that the windows follow a curve away from the straight line.

    Args:
        points: All edge points of the plane.
        guess: The line that straight segments gave, in the plane, near to far.
        half_width: Half the width of a window.
        settings: Number of windows and points.

    Returns:
        The points that fell into the windows.

    Source:
        Pentek, section 2, fourth and fifth paper described there.
    """
    if len(points) == 0 or len(guess) < 2:
        return np.empty((0, 2))
    rows = np.linspace(guess[0, 1], guess[-1, 1], settings.windows + 1)
    # By rising y, so that a window is a slice; a point on the border of two windows lies in both.
    points = points[np.argsort(points[:, 1])]
    y = points[:, 1]
    beside = points[:, 0] - np.interp(y, guess[:, 1], guess[:, 0])
    starts = np.searchsorted(y, rows[:-1], side="left").tolist()
    ends = np.searchsorted(y, rows[1:], side="right").tolist()
    offset, chosen = 0.0, np.zeros(len(points), bool)
    for start, end in zip(starts, ends, strict=True):
        window = beside[start:end]
        inside = np.abs(window - offset) <= half_width
        chosen[start:end] |= inside
        count = np.count_nonzero(inside)
        if count >= settings.min_points:
            offset = float(window[inside].sum()) / count
    return points[chosen]


def fit_curve(points: Float[np.ndarray, "n 2"], length: float, settings: CurveSettings) -> Curve | None:
    """Fit a parabola to the points of one line, or None if they cover too little of the length.

    The rows are scaled to -1..1 for the fit, so that centimetres and shares are fitted alike.
    """
    if len(points) < 3 * settings.min_points:
        return None
    near, far = float(points[:, 1].min()), float(points[:, 1].max())
    if far - near < settings.min_span_share * length:
        return None
    middle, half = 0.5 * (far + near), 0.5 * (far - near)
    t = (points[:, 1] - middle) / half
    if not np.any((points[:, 1] > near) & (points[:, 1] < far)):
        return None
    p, q, r = np.linalg.lstsq(np.stack([t * t, t, np.ones_like(t)], axis=1), points[:, 0], rcond=None)[0]
    # x = p t^2 + q t + r with t = (y - middle) / half, written out in y.
    a = p / half**2
    b = q / half - 2.0 * a * middle
    return Curve(float(a), float(b), float(r - q * middle / half + a * middle**2), near, far)


def curvature_radius(curve: Curve, y: float) -> float:
    """Return R = (1 + (2 a y + b)^2)^(3/2) / |2 a|, in the plane's unit; infinite for a straight line.

    Source:
        Radius of the osculating circle of a graph; tested with points of a circle.
    """
    if curve.a == 0.0:
        return math.inf
    return float((1.0 + (2.0 * curve.a * y + curve.b) ** 2) ** 1.5 / abs(2.0 * curve.a))


def mean_curve(left: Curve, right: Curve) -> Curve:
    """Return the middle between two curves, over the rows that either has."""
    return Curve(
        0.5 * (left.a + right.a),
        0.5 * (left.b + right.b),
        0.5 * (left.c + right.c),
        min(left.near, right.near),
        max(left.far, right.far),
    )


class RoadPlane:
    """The road in cm, frame car."""

    def __init__(self, camera: Camera) -> None:
        """Compute where each pixel meets the road.

        Raises:
            CalibrationError: If no pixel sees the road.
        """
        self._camera = camera
        table = RoadTable(camera, RangeSettings())
        self._keep = table.keep
        self._points_cm = table.points_cm.reshape(-1, 2)

    def from_image(self, pixels_px: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Move pixels to the plane; those that do not lie on it are not finite."""
        return self._camera.intersect_ground(np.asarray(pixels_px, np.float64))

    def edge_points(self, edges: UInt8[np.ndarray, "h w"]) -> Float[np.ndarray, "n 2"]:
        """Move all edge pixels to the plane."""
        return self._points_cm[np.flatnonzero((edges & self._keep) > 0)]

    def to_image(self, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Move points of the plane into the image; those that are not seen are not finite."""
        return self._camera.project_ground(points)


class SquarePlane:
    """The trapezoid stretched to the unit square: its bottom is y = 0, its top y = 1."""

    def __init__(self, trapezoid_px: Float[np.ndarray, "4 2"]) -> None:
        """Find the homography that takes the trapezoid's corners to the square's."""
        square = np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]], np.float32)
        self._square_from_image = np.asarray(
            cv2.getPerspectiveTransform(trapezoid_px.astype(np.float32), square)
        )

    def from_image(self, pixels_px: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """As in :class:`RoadPlane`."""
        return _mapped(self._square_from_image, pixels_px)

    def edge_points(self, edges: UInt8[np.ndarray, "h w"]) -> Float[np.ndarray, "n 2"]:
        """As in :class:`RoadPlane`."""
        v, u = np.nonzero(edges)
        return finite_rows(self.from_image(np.stack([u, v], axis=1).astype(np.float64)))

    def to_image(self, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """As in :class:`RoadPlane`."""
        return _mapped(np.linalg.inv(self._square_from_image), points)


#: Between pixels and the plane, x right and y ahead.
Plane = RoadPlane | SquarePlane


def finite_rows(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "m 2"]:
    """Return the points without those that lie off the plane or are not seen."""
    return points[np.isfinite(points).all(axis=1)]


def move_lines(
    move: Callable[[Float[np.ndarray, "n 2"]], Float[np.ndarray, "n 2"]],
    lines: Sequence[Float[np.ndarray, "_ 2"]],
) -> list[Float[np.ndarray, "_ 2"]]:
    """Move many lines in one call, which costs more than the points, above all for a fisheye.

    Args:
        move: ``from_image`` or ``to_image`` of a plane.
        lines: Points of each line.

    Returns:
        Each line where it was moved to, without the points that are not finite there.
    """
    if not lines:
        return []
    ends = np.cumsum([len(line) for line in lines])
    return [finite_rows(part) for part in np.split(move(np.concatenate(lines)), ends[:-1])]


def _mapped(
    homography: Float[np.ndarray, "3 3"], points: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 2"]:
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1) @ homography.T
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(homogeneous[:, :2] / homogeneous[:, 2:])
