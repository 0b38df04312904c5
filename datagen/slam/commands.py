"""What was commanded from frame to frame, and how the car's curvature answers to the steering."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lanenet.data.drives import Commands, Drive
from lanenet.geometry.frames import left_from_donkey

#: Delays of the steering to try, frames: half a second at 20 frames a second; the real drives show 4.
_MAX_LAG = 10
#: An interval longer than this many typical ones means that the car stood and its frames were left out.
_LONGEST_STEP = 3.0
#: Speed below which a yaw rate says nothing about curvature, [cm/s].
_MOVING_CM_S = 1.0
#: A fit of the steering needs so many frames with a step of more than this share of the median one, this
#: correlation (the real drives reach 0.97 with a camera that is right), and less trim than this curvature in
#: camera heights. Chosen: without such a fit the images alone decide.
_LEAST_FRAMES, _LEAST_STEP, _LEAST_CORRELATION, _MOST_TRIM_HEIGHTS = 50, 0.3, 0.6, 0.3


@dataclass(frozen=True)
class CommandedMotion:
    """What was commanded, in the form that the motion model predicts from.

    Attributes:
        distance_cm: Commanded step length of each frame; relative time steps where no speed was recorded.
        speed_known: Whether ``distance_cm`` is in centimetres.
        turn: Per frame, something proportional to curvature (tan of steering over wheelbase, [1/cm], or
            Donkeycar's angle), or None.
    """

    distance_cm: Float[np.ndarray, "n"]
    speed_known: bool
    turn: Float[np.ndarray, "n"] | None

    @property
    def relative_steps(self) -> Float[np.ndarray, "n"]:
        """Commanded step lengths relative to the typical one; 0 where the car was commanded to stand."""
        moving = self.distance_cm[self.distance_cm > 0.0]
        return self.distance_cm / (float(np.median(moving)) if moving.size else 1.0)


def commands_of(drive: Drive, wheelbase_cm: float) -> CommandedMotion:
    """Turn a drive's recorded commands into distances and turns."""
    step_s = np.diff(drive.t_s)
    typical_s = float(np.median(step_s)) if len(step_s) else 1.0
    return commanded_motion(drive.commands, drive.t_s, typical_s, wheelbase_cm)


def commanded_motion(
    recorded: Commands, t_s: Float[np.ndarray, "n"], typical_s: float, wheelbase_cm: float
) -> CommandedMotion:
    """Turn the commands of consecutive frames into distances and turns.

    Args:
        recorded: The commands.
        t_s: Times of the frames.
        typical_s: Typical time between frames.
        wheelbase_cm: Distance between the axles.
    """
    speed_cm_s, steering_rad, angle, yaw_rate_rad_s = (
        None if values is None else _fill_gaps(values)
        for values in (recorded.speed_cm_s, recorded.steering_rad, recorded.angle, recorded.yaw_rate_rad_s)
    )
    step_s = np.diff(t_s, prepend=t_s[:1])
    typical = max(typical_s, 1e-6)
    # The frames of a stop were left out: in the long step over it the car has driven for about one frame.
    step_s = np.where(step_s > _LONGEST_STEP * typical, typical, step_s)
    distance = step_s / typical if speed_cm_s is None else speed_cm_s * step_s
    turn = None
    if steering_rad is not None:
        turn = np.tan(steering_rad) / wheelbase_cm
    elif angle is not None:
        # The gain is fitted to the images, so that the unknown full lock does not matter.
        turn = left_from_donkey(angle)
    elif yaw_rate_rad_s is not None and speed_cm_s is not None:
        moving = np.abs(speed_cm_s) >= _MOVING_CM_S
        turn = np.where(moving, yaw_rate_rad_s / np.where(moving, speed_cm_s, 1.0), 0.0)
    return CommandedMotion(distance, speed_cm_s is not None, turn)


def joined_commands(parts: Sequence[CommandedMotion]) -> CommandedMotion:
    """Commanded distances of several segments of one drive, one after the other, without the turns."""
    return CommandedMotion(np.concatenate([p.distance_cm for p in parts]), parts[0].speed_known, None)


def _fill_gaps(values: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Carry the last known command over rows that lack one; zero before the first."""
    known = np.isfinite(values)
    last = np.maximum.accumulate(np.where(known, np.arange(len(values)), -1))
    return np.where(last >= 0, values[np.maximum(last, 0)], 0.0)


@dataclass(frozen=True)
class SteeringFit:
    """Curvature found in the images against the command: curvature = gain * turn(t - lag) + trim."""

    gain: float
    trim_per_cm: float
    lag_frames: int
    correlation: float

    def curvature_per_cm(self, turn: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Predict the curvature of each frame from the commanded turns."""
        return self.gain * delayed(turn, self.lag_frames) + self.trim_per_cm


def delayed(values: Float[np.ndarray, "n"], frames: int) -> Float[np.ndarray, "n"]:
    """Shift a signal later by some frames; the first value fills the front."""
    return np.concatenate([np.full(frames, values[0]), values])[: len(values)]


def fit_steering(
    poses: Float[np.ndarray, "n 3"], commands: CommandedMotion, camera_height_cm: float
) -> SteeringFit | None:
    """Regress the curvature of a trajectory on the command, at the delay with the highest correlation.

    Returns:
        None where there is no command, it hardly changes, or it does not explain the curvature.
    """
    if commands.turn is None or np.std(commands.turn) < 1e-6:
        return None
    delta = np.diff(poses, axis=0)
    step = np.hypot(delta[:, 0], delta[:, 1])
    moving = step > _LEAST_STEP * np.median(step)
    if moving.sum() < _LEAST_FRAMES:
        return None
    curvature = delta[moving, 2] / step[moving]
    best: SteeringFit | None = None
    for lag in range(_MAX_LAG + 1):
        turn = delayed(commands.turn, lag)[1:][moving]
        if np.std(turn) < 1e-9:
            continue
        r = float(np.corrcoef(turn, curvature)[0, 1])
        if best is None or r > best.correlation:
            gain, trim = np.polyfit(turn, curvature, 1)
            best = SteeringFit(float(gain), float(trim), lag, r)
    if best is None or not best.correlation > _LEAST_CORRELATION:
        return None
    return best if abs(best.trim_per_cm) < _MOST_TRIM_HEIGHTS / camera_height_cm else None
