"""From pictures and commands to an open-loop trajectory: odometry, the answer to the steering, the filter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from pydantic import Field

from datagen.slam.filter.dp_slam import FilterSettings, Trajectory, run_filter
from datagen.slam.filter.motion import MotionModel
from datagen.slam.odometry.image_pairs import ImagePairs
from datagen.slam.odometry.odometry import Evidence, Odometry, TypicalStep
from datagen.slam.odometry.scans import Progress, Scans
from lanenet.config import Settings
from lanenet.data.drives import Commands, Drive
from lanenet.geometry.camera import Camera
from lanenet.geometry.frames import left_from_donkey

_MAX_LAG = 10  # frames
_LONGEST_STEP = 3.0  # usual times between frames


class MotionSettings(Settings):
    """How far the car may stray from what the odometry says.

    The filter's map likes slow motion, a little in every frame: it may correct a step, but not make a habit
    of it.

    Attributes:
        factor_walk: Change of the filter's factor on the odometry's ways, per frame.
        factor_pull: Share by which that factor returns to 1 per frame.
        distance_noise: Standard deviation of a way, relative.
        curvature_noise_heights: Standard deviation of a curvature times camera height.
        offset_walk_heights: Change of the curvature's offset per frame, times camera height.
        offset_decay: Share of the offset that is forgotten per frame.
        max_curvature_heights: Bound of the curvature times camera height, so that the heading cannot spin.
    """

    factor_walk: float = Field(default=0.001, gt=0.0)
    factor_pull: float = Field(default=0.1, ge=0.0, lt=1.0)
    distance_noise: float = Field(default=0.005, gt=0.0)
    curvature_noise_heights: float = Field(default=0.01, gt=0.0)
    offset_walk_heights: float = Field(default=0.001, gt=0.0)
    offset_decay: float = Field(default=0.1, ge=0.0, le=1.0)
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

    @property
    def relative_ways(self) -> Float[np.ndarray, "n"]:
        """Commanded way per frame relative to the usual one; 0 where the car was told to stand."""
        moving = self.distance_cm[self.distance_cm > 0.0]
        return self.distance_cm / (float(np.median(moving)) if moving.size else 1.0)


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
    pictures: ImagePairs,
    scans: Scans,
    commands: CommandedMotion,
    usual: TypicalStep,
    camera: Camera,
    filter_settings: FilterSettings,
    motion_settings: MotionSettings,
    rng: np.random.Generator,
    progress: Progress | None = None,
    far_rad: Float[np.ndarray, "n"] | None = None,
) -> tuple[Trajectory, SteeringFit | None]:
    """Estimate all poses without closing loops.

    The pictures alone give each frame's motion first, and from it how curvature answers to the steering:
    gain, trim and delay. That prediction then settles what the pictures leave open, and the filter puts the
    steps together.

    Args:
        pictures: Edges of the road in every frame.
        scans: The same on the road.
        commands: What was commanded.
        usual: What that means in centimetres.
        camera: The camera.
        filter_settings: Size of the filter.
        motion_settings: How far it may stray from the odometry.
        rng: Source of randomness.
        progress: Called with (done, total).
        far_rad: Turn of each frame as the distance shows it (:mod:`datagen.slam.odometry.far_view`).
    """
    height, n = camera.mounting.height_cm, len(scans)
    compared = None if progress is None else lambda k, _: progress(k, 2 * n)
    evidence = Evidence(pictures, usual, compared, far_rad)
    odometry = evidence.motion()
    fit = fit_steering(odometry.poses, commands, height)
    if fit is not None and commands.turn is not None:
        odometry = evidence.motion(fit.gain * delayed(commands.turn, fit.lag_frames) + fit.trim_per_cm)
    motion = motion_about(odometry, motion_settings, height)
    filtered = None if progress is None else lambda k, _: progress(n + k, 2 * n)
    return run_filter(scans, motion, filter_settings, height, camera.wheelbase_cm, rng, filtered), fit


def motion_about(odometry: Odometry, settings: MotionSettings, camera_height_cm: float) -> MotionModel:
    """Return the motion of a car that does about what the odometry says."""
    m, ways = settings, odometry.steps_cm
    moving = ways > 0.0
    return MotionModel(
        distance_cm=ways,
        curvature_per_cm=np.where(moving, odometry.turns_rad / np.where(moving, ways, 1.0), 0.0),
        factor_start=(1.0, m.factor_walk),
        factor_walk=m.factor_walk,
        factor_pull=m.factor_pull,
        distance_noise=m.distance_noise,
        offset_walk_per_cm=m.offset_walk_heights / camera_height_cm,
        offset_decay=m.offset_decay,
        curvature_noise_per_cm=m.curvature_noise_heights / camera_height_cm,
        max_curvature_per_cm=m.max_curvature_heights / camera_height_cm,
    )


def delayed(values: Float[np.ndarray, "n"], frames: int) -> Float[np.ndarray, "n"]:
    """Shift a signal later by some frames; the first value fills the front."""
    return np.concatenate([np.full(frames, values[0]), values])[: len(values)]


def fit_steering(
    poses: Float[np.ndarray, "n 3"], commands: CommandedMotion, camera_height_cm: float
) -> SteeringFit | None:
    """Regress the found curvature on the command, at the delay where they correlate best.

    Returns:
        None where there is no command, it hardly changes, or it does not explain the curvature.
    """
    if commands.turn is None or np.std(commands.turn) < 1e-6:
        return None
    delta = np.diff(poses, axis=0)
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
