"""From scans and commands to an open-loop trajectory: the usual step, then two passes of the filter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from pydantic import Field

from datagen.slam.filter import FilterSettings, Trajectory, run_filter
from datagen.slam.motion import MotionModel
from datagen.slam.scans import Progress, Scans
from datagen.slam.speed import STEPS_HEIGHTS, profile_speed
from lanenet.config import Settings
from lanenet.data.drive import Commands, Drive
from lanenet.geometry.camera import Camera
from lanenet.geometry.frames import left_from_donkey

_MAX_LAG = 10  # frames
_LONGEST_STEP = 3.0  # usual times between frames
#: Factors to try on a recorded speed, whose gain is not known exactly.
_GAINS = np.array([0.75, 0.82, 0.9, 1.0, 1.1, 1.21, 1.33])


class MotionSettings(Settings):
    """How far the car may stray from what the commands predict; lengths in camera heights.

    The defaults come from real drives with a throttle only, where speed is a slow, unknown state about the
    usual one that :mod:`datagen.slam.speed` finds: a wider walk or a weaker pull lets the filter creep.
    """

    factor_walk_heights: float = Field(default=0.006, gt=0.0)
    factor_pull: float = Field(default=0.1, ge=0.0, lt=1.0)
    distance_noise: float = Field(default=0.02, gt=0.0)
    curvature_noise_heights: float = Field(default=0.01, gt=0.0)
    max_curvature_heights: float = Field(default=0.8, gt=0.0)


@dataclass(frozen=True)
class CommandedMotion:
    """What was commanded, in the form that the motion model predicts from.

    Attributes:
        distance_cm: Commanded distance per frame; relative time steps where no speed was recorded.
        speed_known: Whether ``distance_cm`` is in centimetres.
        turn: Per frame, something proportional to curvature (tan of steering over wheelbase, [1/cm], or
            Donkeycar's angle), or None.
    """

    distance_cm: Float[np.ndarray, "n"]
    speed_known: bool
    turn: Float[np.ndarray, "n"] | None


@dataclass(frozen=True)
class SteeringFit:
    """Curvature as found from the pictures, against the command: curvature = gain * turn(t - lag) + trim."""

    gain: float
    trim_per_cm: float
    lag_frames: int
    correlation: float


def commands_of(drive: Drive, wheelbase_cm: float) -> CommandedMotion:
    """Turn a drive's recorded commands into distances and turns."""
    step_s = np.diff(drive.t_s)
    return commanded_motion(
        drive.commands, drive.t_s, float(np.median(step_s)) if len(step_s) else 1.0, wheelbase_cm
    )


def commanded_motion(
    recorded: Commands, t_s: Float[np.ndarray, "n"], usual_s: float, wheelbase_cm: float
) -> CommandedMotion:
    """Turn the commands of frames that follow each other into distances and turns.

    Args:
        recorded: The commands.
        t_s: Times of the frames.
        usual_s: Usual time between frames.
        wheelbase_cm: Distance between the axles.
    """
    speed_cm_s, steering_rad, angle, yaw_rate_rad_s = (
        None if values is None else _held(values)
        for values in (recorded.speed_cm_s, recorded.steering_rad, recorded.angle, recorded.yaw_rate_rad_s)
    )
    step_s = np.diff(t_s, prepend=t_s[:1])
    usual = max(usual_s, 1e-6)
    # A longer step is a stop, whose frames were left out: the car has driven for about one of them.
    step_s = np.where(step_s > _LONGEST_STEP * usual, usual, step_s)
    if speed_cm_s is not None:
        distance, known = speed_cm_s * step_s, True
    else:
        distance, known = step_s / usual, False
    turn = None
    if steering_rad is not None:
        turn = np.tan(steering_rad) / wheelbase_cm
    elif angle is not None:
        # The gain is found from the pictures, so that the unknown full lock does not matter.
        turn = left_from_donkey(angle)
    elif yaw_rate_rad_s is not None and speed_cm_s is not None:
        # Standing still, a yaw rate says nothing of the curvature.
        moving = np.abs(speed_cm_s) >= 1.0
        turn = np.where(moving, yaw_rate_rad_s / np.where(moving, speed_cm_s, 1.0), 0.0)
    return CommandedMotion(distance, known, turn)


def _held(values: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Carry the last known command over rows that lack one; zero before the first."""
    known = np.isfinite(values)
    last = np.maximum.accumulate(np.where(known, np.arange(len(values)), -1))
    return np.where(last >= 0, values[np.maximum(last, 0)], 0.0)


def track(
    scans: Scans,
    commands: CommandedMotion,
    camera: Camera,
    filter_settings: FilterSettings,
    motion_settings: MotionSettings,
    rng: np.random.Generator,
    progress: Progress | None = None,
) -> tuple[Trajectory, SteeringFit | None]:
    """Estimate all poses without closing loops.

    First the usual step is found, with the speed held. The first pass knows nothing of the steering and gives
    how curvature answers to the command: gain, trim and delay. The second pass uses that as prediction.
    """
    height = camera.mounting.height_cm
    n, m = len(scans), motion_settings

    def run(motion: MotionModel, offset: int) -> Trajectory:
        report = None if progress is None else lambda k, _: progress(offset + k, 2 * n)
        return run_filter(scans, motion, filter_settings, height, camera.wheelbase_cm, rng, report)

    step = usual_factor(scans, commands, camera, rng)
    trajectory = run(motion_of(commands, None, step, height, m), 0)
    fit = fit_steering(trajectory, commands, height)
    if fit is None or commands.turn is None:
        if progress is not None:
            progress(2 * n, 2 * n)
        return trajectory, None
    predicted = fit.gain * delayed(commands.turn, fit.lag_frames) + fit.trim_per_cm
    return run(motion_of(commands, predicted, step, height, m), n), fit


def usual_factor(scans: Scans, commands: CommandedMotion, camera: Camera, rng: np.random.Generator) -> float:
    """Find the usual distance factor of a drive (see :class:`MotionModel`).

    Returns:
        Gain of a recorded speed; the usual way per frame, [cm], where none was recorded.
    """
    height = camera.mounting.height_cm
    factors = _GAINS if commands.speed_known else height * np.array(STEPS_HEIGHTS)
    seed = int(rng.integers(2**31))
    return profile_speed(scans, commands.distance_cm, factors, height, camera.wheelbase_cm, seed).step_cm


def motion_of(
    commands: CommandedMotion,
    curvature_per_cm: Float[np.ndarray, "n"] | None,
    factor: float,
    height_cm: float,
    settings: MotionSettings,
) -> MotionModel:
    """Return how a car may move.

    Args:
        commands: What was commanded.
        curvature_per_cm: Curvature that the steering predicts; None where it predicts nothing.
        factor: Usual distance factor.
        height_cm: Of the camera.
        settings: How far the car may stray.
    """
    predicted = curvature_per_cm is not None
    return MotionModel(
        distance_cm=commands.distance_cm,
        curvature_per_cm=np.zeros(len(commands.distance_cm))
        if curvature_per_cm is None
        else curvature_per_cm,
        factor_start=(factor, 0.05 * factor),
        factor_walk=0.005 if commands.speed_known else settings.factor_walk_heights * height_cm,
        factor_pull=settings.factor_pull,
        distance_noise=settings.distance_noise,
        offset_walk_per_cm=(0.004 if predicted else 0.012) / height_cm,
        offset_decay=0.02 if predicted else 0.0,
        curvature_noise_per_cm=(1.0 if predicted else 2.0) * settings.curvature_noise_heights / height_cm,
        max_curvature_per_cm=settings.max_curvature_heights / height_cm,
    )


def delayed(values: Float[np.ndarray, "n"], frames: int) -> Float[np.ndarray, "n"]:
    """Shift a signal later by some frames; the first value fills the front."""
    return np.concatenate([np.full(frames, values[0]), values])[: len(values)]


def fit_steering(
    trajectory: Trajectory, commands: CommandedMotion, camera_height_cm: float
) -> SteeringFit | None:
    """Regress the found curvature on the command, at the delay where they correlate best.

    Returns:
        None where there is no command, it hardly changes, or it does not explain the curvature.
    """
    if commands.turn is None or np.std(commands.turn) < 1e-6:
        return None
    delta = np.diff(trajectory.poses, axis=0)
    step = np.hypot(delta[:, 0], delta[:, 1])
    moving = step > 0.3 * np.median(step)
    if moving.sum() < 50:
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
    return (
        best
        if best is not None and best.correlation > 0.6 and abs(best.trim_per_cm) < 0.3 / camera_height_cm
        else None
    )
