"""Motion of the car from frame to frame: as it was commanded, or by its poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from lanenet.data.drives.recording import Commands
from lanenet.geometry.frames import wrap_angle


@dataclass(frozen=True, eq=False)
class Motion:
    """Motion of the rear axle since the frame before.

    Attributes:
        travel_cm: Distance, positive ahead; NaN where it is unknown.
        turn_rad: Change of heading, positive left; likewise.
        wheelbase_cm: Distance between the axles.
    """

    travel_cm: Float[np.ndarray, "n"]
    turn_rad: Float[np.ndarray, "n"]
    wheelbase_cm: float

    def only(self, rows: Int[np.ndarray, "m"]) -> Motion:
        """Return the motion of some rows, which follow one another."""
        return Motion(self.travel_cm[rows], self.turn_rad[rows], self.wheelbase_cm)


def motion_of_commands(
    commands: Commands, t_s: Float[np.ndarray, "n"], starts: Bool[np.ndarray, "n"], wheelbase_cm: float
) -> Motion | None:
    """Predict the motion from the commands of the frames before, as the car's loop does.

    Args:
        commands: Of each frame.
        t_s: Times of the frames.
        starts: True where a frame does not continue the one before.
        wheelbase_cm: Distance between the axles.

    Returns:
        The motion; None where no speed or no steering angle was recorded.
    """
    speed_cm_s, steering_rad = commands.speed_cm_s, commands.steering_rad
    if speed_cm_s is None or steering_rad is None:
        return None
    travel_cm = np.full(len(t_s), np.nan)
    travel_cm[1:] = speed_cm_s[:-1] * np.diff(t_s)
    travel_cm[starts] = np.nan
    turn_rad = travel_cm * np.tan(np.roll(steering_rad, 1)) / wheelbase_cm
    return Motion(travel_cm, turn_rad, wheelbase_cm)


def motion_of_poses(
    poses: Float[np.ndarray, "n 3"], starts: Bool[np.ndarray, "n"], wheelbase_cm: float
) -> Motion:
    """Return the motion between consecutive poses of the rear axle; see :func:`motion_of_commands`."""
    step_cm, heading = np.diff(poses[:, :2], axis=0), poses[:-1, 2]
    ahead = step_cm[:, 0] * np.cos(heading) + step_cm[:, 1] * np.sin(heading) >= 0.0
    travel_cm, turn_rad = np.full((2, len(poses)), np.nan)
    travel_cm[1:] = np.where(ahead, 1.0, -1.0) * np.hypot(*step_cm.T)
    turn_rad[1:] = wrap_angle(np.diff(poses[:, 2]))
    travel_cm[starts] = np.nan
    return Motion(travel_cm, turn_rad, wheelbase_cm)
