"""Points of the ground with their pixels: read off a board on the floor, and checked before they are used."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from lanenet.calibration.chessboard import Board, BoardView
from lanenet.errors import CalibrationError
from lanenet.geometry.camera import Camera

MIN_POINTS = 4
#: Narrower than this share of their length, points are a line.
_MIN_FLATNESS = 0.02


def points_of_floor_board(
    view: BoardView, board: Board, near_left_cm: tuple[float, float]
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
    """Turn a board that lies on the floor, its edges along the car's axes, into ground points.

    Args:
        view: The board as the camera saw it, upright: what is ahead is higher in the image.
        board: The board.
        near_left_cm: Its inner corner nearest to the car on the left, frame car.

    Returns:
        Ground points, [cm], frame car, and their pixels.

    Raises:
        CalibrationError: If the board is cut off, or turned so far that its sides cannot be told apart.
    """
    if not view.complete:
        raise CalibrationError(f"{view.name}: the board on the floor is cut off, expected all its corners")
    grid = view.corners_px.reshape(board.rows, board.columns, 2)
    along = (grid[:, -1] - grid[:, 0]).mean(axis=0)
    if abs(along[0]) < abs(along[1]):
        grid = grid.transpose(1, 0, 2)
    if (grid[:, -1] - grid[:, 0]).mean(axis=0)[0] < 0.0:
        grid = grid[:, ::-1]
    if (grid[-1] - grid[0]).mean(axis=0)[1] > 0.0:
        grid = grid[::-1]
    right, ahead = (grid[:, -1] - grid[:, 0]).mean(axis=0), (grid[-1] - grid[0]).mean(axis=0)
    if abs(right[0]) < 1.5 * abs(right[1]) or abs(ahead[1]) < 0.5 * abs(ahead[0]):
        raise CalibrationError(
            f"{view.name}: the board is turned, expected its edges along and across the car"
        )
    y, x = np.mgrid[: grid.shape[0], : grid.shape[1]]
    steps = np.stack([x.ravel(), y.ravel()], axis=1) * board.square_cm
    return np.array(near_left_cm) + steps, grid.reshape(-1, 2).copy()


def check_points(
    camera: Camera, points_cm: Float[np.ndarray, "n 2"], pixels_px: Float[np.ndarray, "m 2"]
) -> None:
    """Refuse points from which no mounting can follow.

    Args:
        camera: The camera with its lens.
        points_cm: Points of the ground, frame car.
        pixels_px: Where the image shows them.

    Raises:
        CalibrationError: If there are too few, one is not finite or outside the image, or they lie on a line.
    """
    if len(points_cm) != len(pixels_px):
        raise CalibrationError(f"{len(points_cm)} ground points but {len(pixels_px)} pixels")
    if len(points_cm) < MIN_POINTS:
        raise CalibrationError(f"{len(points_cm)} ground point(s), expected at least {MIN_POINTS}, better 10")
    both = np.concatenate([points_cm, pixels_px], axis=1)
    bad = np.flatnonzero(~np.isfinite(both).all(axis=1))
    if bad.size:
        raise CalibrationError(f"point {bad[0] + 1}: not finite")
    outside = (pixels_px < -1.0).any(axis=1) | (pixels_px > [camera.width, camera.height]).any(axis=1)
    if outside.any():
        k = int(np.flatnonzero(outside)[0])
        raise CalibrationError(
            f"point {k + 1}: pixel {pixels_px[k, 0]:.1f}, {pixels_px[k, 1]:.1f} is outside the image of "
            f"{camera.width}x{camera.height} px{_swap_hint(camera, points_cm, pixels_px)}"
        )
    for values, what in ((points_cm, "points"), (pixels_px, "pixels")):
        size = np.linalg.svd(values - values.mean(axis=0), compute_uv=False)
        if size[1] < _MIN_FLATNESS * size[0] or size[0] == 0.0:
            raise CalibrationError(f"the {what} lie on one line, expected them spread over the ground")


def _swap_hint(
    camera: Camera, points_cm: Float[np.ndarray, "n 2"], pixels_px: Float[np.ndarray, "n 2"]
) -> str:
    size = [camera.width, camera.height]
    if ((pixels_px[:, ::-1] >= -1.0) & (pixels_px[:, ::-1] <= size)).all():
        return "; are the columns u_px and v_px swapped?"
    if ((points_cm >= -1.0) & (points_cm <= size)).all():
        return "; do the columns x_cm, y_cm hold the pixels, and u_px, v_px the centimetres?"
    return ""
