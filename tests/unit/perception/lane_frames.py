"""Frames of a painted lane with a known place, for the tests of the image detectors."""

from __future__ import annotations

import cv2
import numpy as np

from lanenet.geometry.camera import Camera, Mounting

K = np.array([[110.0, 0.0, 159.5], [0.0, 110.0, 119.5], [0.0, 0.0, 1.0]])
CAMERA = Camera("pinhole", 320, 240, K, np.zeros(5), Mounting(20.0, float(np.deg2rad(30.0))), 26.0)


def lane_frame(
    centre_cm: float = 0.0,
    slope: float = 0.0,
    bend: float = 0.0,
    sides: tuple[float, ...] = (-20.0, 20.0),
    floor_bgr: tuple[int, int, int] = (110, 60, 60),
    line_bgr: tuple[int, int, int] = (40, 220, 230),
) -> np.ndarray:
    """Yellow markings of 3 cm on a blue-gray floor, x = side + centre + slope y + bend y^2."""
    scale = 3
    u, v = np.meshgrid(
        (np.arange(CAMERA.width * scale) + 0.5) / scale - 0.5,
        (np.arange(CAMERA.height * scale) + 0.5) / scale - 0.5,
    )
    road = CAMERA.intersect_ground(np.stack([u.ravel(), v.ravel()], axis=1))
    x, y = np.nan_to_num(road, nan=1e6).T
    across = x - centre_cm - slope * y - bend * y * y
    on_line = np.zeros(len(x), bool)
    for side in sides:
        on_line |= (np.abs(across - side) <= 1.5) & (y < 200.0)
    fine = np.where(on_line[:, None], np.array(line_bgr), np.array(floor_bgr)).astype(np.uint8)
    picture = fine.reshape(*u.shape, 3)
    return np.asarray(cv2.resize(picture, (CAMERA.width, CAMERA.height), interpolation=cv2.INTER_AREA))
