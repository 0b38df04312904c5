"""The plane in which the painter follows curves: the road of a camera, or the trapezoid as a unit square."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from lanenet.geometry.camera import Camera
from lanenet.perception.birdseye import RangeSettings, RoadTable


@runtime_checkable
class Plane(Protocol):
    """Between pixels and the plane, x right and y ahead."""

    def from_image(self, pixels_px: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Move pixels to the plane; those that do not lie on it are not finite."""
        ...

    def edge_points(self, edges: UInt8[np.ndarray, "h w"]) -> Float[np.ndarray, "n 2"]:
        """Move all edge pixels to the plane."""
        ...

    def to_image(self, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Move points of the plane into the image; those that are not seen are not finite."""
        ...


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
        """See :class:`Plane`."""
        return self._camera.intersect_ground(np.asarray(pixels_px, np.float64))

    def edge_points(self, edges: UInt8[np.ndarray, "h w"]) -> Float[np.ndarray, "n 2"]:
        """See :class:`Plane`."""
        return self._points_cm[np.flatnonzero((edges & self._keep) > 0)]

    def to_image(self, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """See :class:`Plane`."""
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
        """See :class:`Plane`."""
        return _mapped(self._square_from_image, pixels_px)

    def edge_points(self, edges: UInt8[np.ndarray, "h w"]) -> Float[np.ndarray, "n 2"]:
        """See :class:`Plane`."""
        v, u = np.nonzero(edges)
        return finite_rows(self.from_image(np.stack([u, v], axis=1).astype(np.float64)))

    def to_image(self, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """See :class:`Plane`."""
        return _mapped(np.linalg.inv(self._square_from_image), points)


def finite_rows(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "m 2"]:
    """Return the points without those that lie off the plane or are not seen."""
    return points[np.isfinite(points).all(axis=1)]


def move_lines(
    move: Callable[[Float[np.ndarray, "n 2"]], Float[np.ndarray, "n 2"]],
    lines: Sequence[Float[np.ndarray, "_ 2"]],
) -> list[Float[np.ndarray, "_ 2"]]:
    """Move many lines at once: the call costs more than the points, above all into a fisheye and out of it.

    Args:
        move: :meth:`Plane.from_image` or :meth:`Plane.to_image`.
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
