"""The usual step per frame of a drive whose camera is only guessed, and how well that camera fits at it.

A filter that is free to choose its speed creeps: whatever stands still in the picture (mirrored lamps, the
car's shadow, a curve that looks the same from frame to frame) rewards it for moving less, and its score
grows. With the speed held, the score does peak at the true one, roughly, and highest with the true camera.
So a few speeds are held in turn over one stretch of the drive. Once there is a camera, neighbouring pictures
tell the step to a few per cent (see :mod:`datagen.slam.odometry`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from datagen.slam.filter import FilterSettings
from datagen.slam.held import HeldStretch
from datagen.slam.motion import MotionModel
from datagen.slam.scans import Progress, Scans

#: Steps to try, in camera heights per frame: 1 cm of the paper's crawl up to a fast car at 10 Hz.
STEPS_HEIGHTS = tuple(0.05 * 1.25**k for k in range(13))
_FRAMES = 300
_SETTINGS = FilterSettings(particles=150, max_points=80)


@dataclass(frozen=True)
class SpeedProfile:
    """How well each held step matches.

    Attributes:
        steps_cm: Steps per frame that were tried, ascending.
        match: Mean matched share with each.
        step_cm: The best one, between the tried ones by a parabola.
    """

    steps_cm: Float[np.ndarray, "k"]
    match: Float[np.ndarray, "k"]
    step_cm: float


def held_motion(step_cm: float, relative_cm: Float[np.ndarray, "n"], height_cm: float) -> MotionModel:
    """Motion of a car that keeps its speed and may steer as it likes.

    Args:
        step_cm: Way per frame of usual length.
        relative_cm: Commanded way per frame, or the frame's duration relative to the usual one.
        height_cm: Of the camera.
    """
    return MotionModel(
        distance_cm=relative_cm,
        curvature_per_cm=np.zeros(len(relative_cm)),
        factor_start=(step_cm, 0.02 * step_cm),
        factor_walk=0.02 * step_cm,
        factor_pull=0.3,
        distance_noise=0.02,
        offset_walk_per_cm=0.012 / height_cm,
        offset_decay=0.0,
        curvature_noise_per_cm=0.02 / height_cm,
        max_curvature_per_cm=0.6 / height_cm,
    )


def profile_speed(
    scans: Scans,
    relative_cm: Float[np.ndarray, "n"],
    steps_cm: Float[np.ndarray, "k"],
    height_cm: float,
    wheelbase_cm: float,
    seed: int,
    settings: FilterSettings = _SETTINGS,
    progress: Progress | None = None,
) -> SpeedProfile:
    """Match a stretch of the drive with each of some held steps.

    Args:
        scans: Edge points of the drive.
        relative_cm: See :func:`held_motion`.
        steps_cm: Steps to try, ascending.
        height_cm: Of the camera.
        wheelbase_cm: Of the car.
        seed: The same for every step, so that chance favours none.
        settings: Of the filter.
        progress: Called with (done, total).
    """
    stretch = middle_stretch(scans, _FRAMES)
    held, relative = (
        HeldStretch.of(scans.cut(stretch), settings, height_cm, wheelbase_cm),
        relative_cm[stretch],
    )
    match = np.zeros(len(steps_cm))
    for i, step_cm in enumerate(steps_cm):
        motion = held_motion(float(step_cm), relative, height_cm)
        match[i] = np.nanmean(held.match(motion, seed))
        if progress is not None:
            progress(i + 1, len(steps_cm))
    # A spell of lost tracking spoils one step's match; the median of three neighbours does not fall for it.
    padded = np.concatenate([[-np.inf], match, [-np.inf]])
    smooth = np.median(np.stack([padded[:-2], padded[1:-1], padded[2:]]), axis=0)
    best = int(np.argmax(np.where(np.isfinite(smooth), smooth, -1.0) + match))
    return SpeedProfile(steps_cm, match, _peak(np.log(steps_cm), match, best))


def middle_stretch(scans: Scans, frames: int) -> slice:
    """A stretch of at most this many frames, a third of the rest before it."""
    count = min(frames, len(scans))
    start = (len(scans) - count) // 3
    return slice(start, start + count)


def _peak(log_step: Float[np.ndarray, "k"], match: Float[np.ndarray, "k"], best: int) -> float:
    """Top of the parabola through the best step and its neighbours, on the scale of logarithms."""
    if 0 < best < len(match) - 1:
        left, middle, right = match[best - 1 : best + 2]
        bend = left - 2.0 * middle + right
        if bend < 0.0:
            shift = float(np.clip(0.5 * (left - right) / bend, -0.5, 0.5))
            return float(np.exp(log_step[best] + shift * (log_step[best + 1] - log_step[best])))
    return float(np.exp(log_step[best]))
