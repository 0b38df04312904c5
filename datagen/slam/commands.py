"""What was commanded from frame to frame, and how the car's curvature answers to the steering.

Time is part of it: Donkeycar records only while the throttle is pressed, and the car rolls on unrecorded in
between. A step over such a gap is as long as the time that it took. Over a short gap, images bridge it; over
a long one the motion is open, and the frames on either side belong to different parts of the drive.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from lanenet.data.drives import Commands, Drive
from lanenet.geometry.frames import left_from_donkey

#: Delays of the steering to try, frames: half a second at 20 frames a second; the real drives show 4.
_MAX_LAG = 10
#: A time step longer than this many typical ones is a gap of the recording.
GAP_PERIODS = 1.5
#: Steps between frames that are longer than so many typical ones are pauses, and a habit where they are more
#: than this share. Measured: 0, 0, 0.6 and 0 % of the frames of four recorded drives, and 12 % where the
#: throttle is pressed in pulses.
_PAUSE_PERIODS, _PAUSE_SHARE = 2.5, 0.02
#: The longest gap, in typical time steps, that images bridge. Measured on ``donkey_circuit`` with gaps: the
#: turn over 2 to 6 steps is found within 0.025 rad (rms), over 6 to 11 within 0.12, over more within 0.5,
#: which is as good as unknown.
MOST_BRIDGED = 12.0
#: A step over a longer gap counts as this many typical ones, and a break as so long a time that nothing is
#: assumed across it. Chosen: the car may have been put elsewhere.
LONGEST_STEP, BREAK_PERIODS = 20.0, 1e4
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
        periods: Time from the frame before to each frame, in typical time steps; 1 where there is no gap.
        uneven: Where that time is another one, by the images, though none was recorded; None for nowhere.
    """

    distance_cm: Float[np.ndarray, "n"]
    speed_known: bool
    turn: Float[np.ndarray, "n"] | None
    periods: Float[np.ndarray, "n"]
    uneven: Bool[np.ndarray, "n"] | None = None

    @classmethod
    def without_gaps(
        cls, distance_cm: Float[np.ndarray, "n"], speed_known: bool, turn: Float[np.ndarray, "n"] | None
    ) -> CommandedMotion:
        """Commands of frames that follow one another, each a typical time step after the one before."""
        return cls(distance_cm, speed_known, turn, np.ones(len(distance_cm)))

    def only(self, rows: Int[np.ndarray, "m"]) -> CommandedMotion:
        """Return the commands of some parts, given by all of their rows; nothing lies before the first."""
        periods = self.periods[rows]
        periods[:1] = 1.0
        return replace(
            self,
            distance_cm=self.distance_cm[rows],
            turn=None if self.turn is None else self.turn[rows],
            periods=periods,
            uneven=None if self.uneven is None else self.uneven[rows],
        )

    @property
    def relative_steps(self) -> Float[np.ndarray, "n"]:
        """Commanded step lengths relative to the typical one; 0 where the car was commanded to stand."""
        moving = self.distance_cm[self.distance_cm > 0.0]
        return self.distance_cm / (float(np.median(moving)) if moving.size else 1.0)

    @property
    def part(self) -> Int[np.ndarray, "n"]:
        """Number of the part that each frame belongs to: images bridge every gap within a part."""
        return np.cumsum(self.periods > MOST_BRIDGED)


def commands_of(drive: Drive, wheelbase_cm: float) -> CommandedMotion:
    """Turn a drive's recorded commands into distances and turns."""
    step_s = np.diff(drive.driven_s)
    typical_s = float(np.median(step_s)) if len(step_s) else 1.0
    commands = commanded_motion(drive.commands, drive.driven_s, typical_s, wheelbase_cm)
    periods = np.where(drive.breaks, BREAK_PERIODS, commands.periods)
    return replace(commands, periods=periods)


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
    periods = np.where(step_s > GAP_PERIODS * typical, step_s / typical, 1.0)
    step_s = np.minimum(step_s, LONGEST_STEP * typical)
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
    return CommandedMotion(distance, speed_cm_s is not None, turn, periods)


def habitual_pauses(drive: Drive) -> int:
    """Return how often a recording pauses if it does so again and again; 0 for a few stops or lost frames.

    Args:
        drive: As it was recorded: frames that are left out later are no pauses.
    """
    step_s = np.diff(drive.driven_s)
    if not len(step_s):
        return 0
    pauses = int(np.count_nonzero(step_s > _PAUSE_PERIODS * np.median(step_s)))
    return pauses if pauses > _PAUSE_SHARE * len(drive) else 0


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
    moving = (step > _LEAST_STEP * np.median(step)) & (commands.periods[1:] <= GAP_PERIODS)
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
