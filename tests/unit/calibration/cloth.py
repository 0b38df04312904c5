"""The chequered cloth around a car, seen by its four fisheyes: the reference's mapping, and its real corners.

The reference (data set ``fisheye_ground``) undistorts an image with K and D, then takes it to a picture from
above, of 1 px per cm, by a homography from four corners that a person clicked. Squares are 40 cm.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from lanenet.geometry.camera import Camera, Mounting

NAMES = ("front", "back", "left", "right")
SQUARE = 40.0
#: The clicked corners: left, right, top and bottom edge of their rectangle, [px] of the picture from above.
CLICKED = {
    "front": (420.0, 780.0, 300.0, 460.0),
    "back": (420.0, 780.0, 300.0, 460.0),
    "left": (580.0, 1140.0, 300.0, 460.0),
    "right": (460.0, 1020.0, 300.0, 460.0),
}
#: A step along x is one of these, [px] of the picture from above; y goes down.
_DIAGONALS = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
_SIDES = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])


@dataclass(frozen=True)
class Reference:
    """One camera of the data set."""

    name: str
    camera: Camera
    homography: np.ndarray
    K_flat: np.ndarray

    def lattice(self, step: float = SQUARE) -> np.ndarray:
        """Corners of the cloth in the picture from above."""
        right = 900.0 if self.name in ("front", "back") else 1300.0
        grid = np.meshgrid(np.arange(300.0, right + 1.0, step), np.arange(300.0, 461.0, step))
        return np.stack(grid, axis=-1).reshape(-1, 2)

    def flat(self, above: np.ndarray) -> np.ndarray:
        """Pixels of the undistorted image that show points of the picture from above."""
        return cv2.perspectiveTransform(above.reshape(1, -1, 2), np.linalg.inv(self.homography))[0]

    def pixels(self, above: np.ndarray) -> np.ndarray:
        """Pixels of the camera's image that show points of the picture from above."""
        rays = (self.flat(above) - self.K_flat[:2, 2]) / np.diag(self.K_flat)[:2]
        return self.camera.project_rays(np.column_stack([rays, np.ones(len(rays))]))

    def above(self, pixels: np.ndarray) -> np.ndarray:
        """Where the reference's picture from above shows pixels of the camera's image."""
        rays = self.camera.unproject(pixels)
        flat = rays[:, :2] / rays[:, 2:] * np.diag(self.K_flat)[:2] + self.K_flat[:2, 2]
        return cv2.perspectiveTransform(flat.reshape(1, -1, 2), self.homography)[0]


def reference(folder: Path, name: str) -> Reference:
    storage = cv2.FileStorage(str(folder / "yaml" / f"{name}.yaml"), cv2.FILE_STORAGE_READ)
    K, homography = storage.getNode("camera_matrix").mat(), storage.getNode("project_matrix").mat()
    D = storage.getNode("dist_coeffs").mat().ravel()
    scale, shift = (storage.getNode(key).mat().ravel() for key in ("scale_xy", "shift_xy"))
    K_flat = np.diag([K[0, 0] * scale[0], K[1, 1] * scale[1], 1.0])
    K_flat[:2, 2] = K[:2, 2] + shift
    return Reference(name, Camera("fisheye", 960, 640, K, D, Mounting(20.0), 260.0), homography, K_flat)


def real_corners(folder: Path, of: Reference) -> tuple[np.ndarray, np.ndarray]:
    """Corners where four squares meet, found in the photo itself: their place on the cloth, and their pixels.

    The reference says where to look; the saddle point of the gray values nearby says where the corner is.
    """
    gray = cv2.imread(str(folder / "images" / f"{of.name}.png"), cv2.IMREAD_GRAYSCALE)
    smooth = cv2.GaussianBlur(gray, (3, 3), 0)
    places, pixels = [], []
    for place in of.lattice():
        start, sides = of.pixels(place[None])[0], of.pixels(place + 0.5 * SQUARE * _SIDES)
        if not (np.isfinite(start).all() and np.isfinite(sides).all()):
            continue
        size = min(np.linalg.norm(sides[0] - sides[1]), np.linalg.norm(sides[2] - sides[3]))
        if size < 7.0 or (start < 8.0).any() or (start > [951.0, 631.0]).any():
            continue
        half = int(np.clip(0.3 * size, 2, 9))
        found = start.astype(np.float32).reshape(1, 1, 2)
        for _ in range(3):
            found = cv2.cornerSubPix(gray, found, (half, half), (-1, -1), (3, 60, 1e-3))
        corner = found.reshape(2).astype(np.float64)
        around = (of.pixels(place + 0.3 * SQUARE * _DIAGONALS) + corner - start).astype(np.float32)
        if np.linalg.norm(corner - start) > 0.3 * size or not np.isfinite(around).all():
            continue
        a, b, c, d = cv2.remap(smooth, around[:, 0], around[:, 1], cv2.INTER_LINEAR).ravel().astype(float)
        if abs(a - c) < 60.0 and abs(b - d) < 60.0 and abs(a + c - b - d) > 120.0:
            places.append(place)
            pixels.append(corner)
    return np.array(places), np.array(pixels)


def bends(places: np.ndarray, above: np.ndarray) -> np.ndarray:
    """Distances of corners from straight lines through their rows and columns of the cloth."""
    left = []
    for axis in (0, 1):
        for value in np.unique(places[:, axis]):
            line = above[places[:, axis] == value]
            if len(line) >= 4:
                centred = line - line.mean(axis=0)
                left.append(np.abs(centred @ np.linalg.svd(centred)[2][1]))
    return np.concatenate(left)


def side_lengths(places: np.ndarray, above: np.ndarray) -> np.ndarray:
    """Lengths of the squares' sides of which both ends were found."""
    steps = places[None] - places[:, None]
    first, second = np.nonzero((np.abs(steps).sum(axis=2) == SQUARE) & (steps.sum(axis=2) > 0.0))
    return np.linalg.norm(above[second] - above[first], axis=1)
