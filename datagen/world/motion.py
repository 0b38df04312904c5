"""Where the car is while a frame is taken: each image row has its own moment."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def row_poses(
    height: int, heading_rad: float, speed_cm_s: float, yaw_rate_rad_s: float, readout_s: float
) -> Float[np.ndarray, "h 4"]:
    """Return the car when each image row is read.

    The frame's pose holds for the middle of the image, so that the truth is the same with and without.

    Args:
        height: Rows of the image.
        heading_rad: Heading of the frame's pose.
        speed_cm_s: Of the rear axle, along the heading.
        yaw_rate_rad_s: Positive left.
        readout_s: From the first row to the last.

    Returns:
        x and y of the rear axle from the frame's pose, [cm], axes of the map; cos and sin of the heading.
    """
    at_s = readout_s * (np.arange(height) / max(height - 1, 1) - 0.5)
    turn = yaw_rate_rad_s * at_s
    chord_cm = speed_cm_s * at_s * np.sinc(0.5 * turn / np.pi)
    direction, heading = heading_rad + 0.5 * turn, heading_rad + turn
    return np.stack(
        [chord_cm * np.cos(direction), chord_cm * np.sin(direction), np.cos(heading), np.sin(heading)], axis=1
    )


def shake_rotation(pitch_down_rad: float, roll_rad: float) -> Float[np.ndarray, "3 3"]:
    """Return how a shake turns the camera's rays in the car frame (right, ahead, up).

    Args:
        pitch_down_rad: The view goes down by this.
        roll_rad: The camera's right side goes down by this.
    """
    cp, sp = np.cos(pitch_down_rad), np.sin(pitch_down_rad)
    cr, sr = np.cos(roll_rad), np.sin(roll_rad)
    pitch = np.array([[1.0, 0.0, 0.0], [0.0, cp, sp], [0.0, -sp, cp]])
    roll = np.array([[cr, 0.0, sr], [0.0, 1.0, 0.0], [-sr, 0.0, cr]])
    return np.asarray(pitch @ roll)
