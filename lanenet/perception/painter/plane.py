"""The plane in which the painter follows curves: the road of a camera, or the trapezoid as a unit square."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from lanenet.geometry.camera import Camera
from lanenet.perception.birdseye import RangeSettings, RoadTable


@runtime_checkable
class Plane(Protocol):
    """Between pixels and the plane, x right and y ahead."""

    def from_image(self, pixels_px: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "m 2"]:
        """Move pixels to the plane; those that do not lie on it are left out."""
        ...

    def edge_points(self, edges: UInt8[np.ndarray, "h w"]) -> Float[np.ndarray, "n 2"]:
        """Move all edge pixels to the plane."""
        ...

    def to_image(self, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "m 2"]:
        """Move points of the plane into the image; those that are not seen are left out."""
        ...


class RoadPlane:
    """The road in cm, frame car."""

    def __init__(self, camera: Camera) -> None:
        """Compute where each pixel meets the road.

        Raises:
            CalibrationError: If no pixel sees the road.
        """
        self._camera = camera
        self._table = RoadTable(camera, RangeSettings())

    def from_image(self, pixels_px: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "m 2"]:
        """See :class:`Plane`."""
        points = self._camera.intersect_ground(np.asarray(pixels_px, np.float64))
        return points[np.isfinite(points).all(axis=1)]

    def edge_points(self, edges: UInt8[np.ndarray, "h w"]) -> Float[np.ndarray, "n 2"]:
        """See :class:`Plane`."""
        return self._table.points_cm[(edges > 0) & (self._table.keep > 0)]

    def to_image(self, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "m 2"]:
        """See :class:`Plane`."""
        pixels = self._camera.project_ground(points)
        return pixels[np.isfinite(pixels).all(axis=1)]


class SquarePlane:
    """The trapezoid stretched to the unit square: its bottom is y = 0, its top y = 1."""

    def __init__(self, trapezoid_px: Float[np.ndarray, "4 2"]) -> None:
        """Find the homography that takes the trapezoid's corners to the square's."""
        square = np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]], np.float32)
        self._square_from_image = np.asarray(
            cv2.getPerspectiveTransform(trapezoid_px.astype(np.float32), square)
        )

    def from_image(self, pixels_px: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "m 2"]:
        """See :class:`Plane`."""
        return _mapped(self._square_from_image, pixels_px)

    def edge_points(self, edges: UInt8[np.ndarray, "h w"]) -> Float[np.ndarray, "n 2"]:
        """See :class:`Plane`."""
        v, u = np.nonzero(edges)
        return self.from_image(np.stack([u, v], axis=1).astype(np.float64))

    def to_image(self, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "m 2"]:
        """See :class:`Plane`."""
        return _mapped(np.linalg.inv(self._square_from_image), points)


def _mapped(
    homography: Float[np.ndarray, "3 3"], points: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "m 2"]:
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1) @ homography.T
    with np.errstate(divide="ignore", invalid="ignore"):
        mapped = homogeneous[:, :2] / homogeneous[:, 2:]
    return np.asarray(mapped[np.isfinite(mapped).all(axis=1)])
