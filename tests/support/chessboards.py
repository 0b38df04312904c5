"""Chessboards before known lenses: projected corners with noise, and painted pictures."""

from __future__ import annotations

import cv2
import numpy as np

from lanenet.calibration.chessboard import Board, BoardView
from lanenet.calibration.lens import rotation_from_vector
from lanenet.geometry.camera import Camera, Mounting

BOARD = Board(9, 6, 2.5)
MOUNTING = Mounting(18.0, float(np.deg2rad(25.0)), 0.05, -0.03, 3.0, -1.0)


def fisheye_of(field_deg: float, rng: np.random.Generator, width: int = 640, height: int = 480) -> Camera:
    """A lens that sees ``field_deg`` across the image's width, with the small faults of real ones."""
    half = np.deg2rad(field_deg) / 2.0
    D = rng.normal(0.0, 1.0, 4) * [0.03, 0.01, 0.003, 0.0006]
    focal = 0.5 * width / (half * (1.0 + D @ [half**2, half**4, half**6, half**8]))
    centre = [0.5 * width - 0.5, 0.5 * height - 0.5] + rng.normal(0.0, 5.0, 2)
    K = np.array(
        [[focal, 0.0, centre[0]], [0.0, focal * rng.uniform(0.98, 1.02), centre[1]], [0.0, 0.0, 1.0]]
    )
    return Camera("fisheye", width, height, K, D, MOUNTING, 26.0)


def board_poses(
    camera: Camera, rng: np.random.Generator, count: int, near_cm: float = 9.0, far_cm: float = 20.0
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Rotation and centre of boards held in all parts of the image, whole and facing the camera."""
    flat = np.column_stack([BOARD.points_cm() - BOARD.points_cm().mean(axis=0), np.zeros(54)])
    size = np.array([camera.width, camera.height])
    poses: list[tuple[np.ndarray, np.ndarray]] = []
    while len(poses) < count:
        ray = camera.unproject(rng.uniform(0.1 * size, 0.9 * size)[None])[0]
        if not np.isfinite(ray).all():
            continue
        x = np.cross([0.0, 1.0, 0.0], -ray)
        x /= np.linalg.norm(x)
        facing = np.stack([x, np.cross(-ray, x), -ray], axis=1)
        rotation = facing @ rotation_from_vector(rng.normal(0.0, 0.35, 3))
        centre = ray * rng.uniform(near_cm, far_cm)
        corners = camera.project_rays(flat @ rotation.T + centre)
        seen = np.isfinite(corners).all() and (corners > 3.0).all() and (corners < size - 4.0).all()
        if seen and rotation[:, 2] @ ray < -0.3:
            poses.append((rotation, centre))
    return poses


def views_of(
    camera: Camera, rng: np.random.Generator, count: int = 12, noise_px: float = 0.2, **distance: float
) -> list[BoardView]:
    """Views of the board, corners projected with normal noise."""
    points = BOARD.points_cm()
    flat = np.column_stack([points - points.mean(axis=0), np.zeros(54)])
    views = []
    for k, (rotation, centre) in enumerate(board_poses(camera, rng, count, **distance)):
        corners = camera.project_rays(flat @ rotation.T + centre)
        corners = corners + rng.normal(0.0, noise_px, corners.shape)
        views.append(BoardView(f"view{k}", camera.width, camera.height, points, corners))
    return views


def painted(camera: Camera, rotation: np.ndarray, centre: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A gray picture of the board with blur and noise, painted with twice the camera's resolution."""
    v, u = np.mgrid[: 2 * camera.height, : 2 * camera.width].astype(np.float64)
    pixels = np.stack([0.5 * (u.ravel() + 0.5) - 0.5, 0.5 * (v.ravel() + 0.5) - 0.5], axis=1)
    rays = camera.unproject(pixels)
    distance = (rotation[:, 2] @ centre) / (rays @ rotation[:, 2])
    with np.errstate(invalid="ignore"):
        seen = distance > 0.0
    board_cm = np.where(seen[:, None], ((rays * distance[:, None] - centre) @ rotation)[:, :2], 1e6)
    a, b = (board_cm / BOARD.square_cm + [0.5 * (BOARD.columns - 1), 0.5 * (BOARD.rows - 1)]).T
    gray = np.full(len(pixels), 110.0)
    gray[(a > -1.6) & (a < BOARD.columns + 0.6) & (b > -1.6) & (b < BOARD.rows + 0.6)] = 225.0
    inside = (a > -1.0) & (a < BOARD.columns) & (b > -1.0) & (b < BOARD.rows)
    gray[inside & ((np.floor(a) + np.floor(b)) % 2 == 0)] = 25.0
    size = (camera.width, camera.height)
    picture = cv2.resize(gray.reshape(v.shape).astype(np.float32), size, interpolation=cv2.INTER_AREA)
    picture = cv2.GaussianBlur(picture, (0, 0), 0.7) + rng.normal(0.0, 3.0, picture.shape)
    return np.clip(picture, 0.0, 255.0).astype(np.uint8)
