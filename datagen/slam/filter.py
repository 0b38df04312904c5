"""The particle filter over trajectories: predict, weigh, estimate, resample, map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from pydantic import Field

from datagen.slam.field import DirectionField
from datagen.slam.motion import HEADING, MotionModel
from datagen.slam.scans import Progress, Scans
from lanenet.config import Settings
from lanenet.geometry.frames import map_from_car, map_from_car_directions


class FilterSettings(Settings):
    """Size of the filter and sharpness of its likelihood.

    Lengths are in camera heights, because the road in one pixel, and with it every tolerance, scales with it.
    """

    particles: int = Field(default=300, ge=10)
    cell_heights: float = Field(default=0.04, gt=0.0)
    field_size: int = Field(default=1024, ge=64)
    memory_frames: float = Field(default=40.0, gt=0.0)
    max_points: int = Field(default=250, ge=20)
    effective_share: float = Field(default=0.15, gt=0.0, lt=1.0)
    resample_below: float = Field(default=0.5, gt=0.0, le=1.0)


@dataclass(frozen=True)
class Trajectory:
    """Poses of a drive.

    Attributes:
        poses: Rear-axle x, y and heading (unwrapped) per frame, [cm], [cm], [rad], frame map.
        factor: Distance factor per frame (see :class:`MotionModel`).
        match: Matched share of the frame's edge points, 0..1; NaN where a frame has none.
        spread_cm: Standard deviation of the particles' position when the frame was filtered.
    """

    poses: Float[np.ndarray, "n 3"]
    factor: Float[np.ndarray, "n"]
    match: Float[np.ndarray, "n"]
    spread_cm: Float[np.ndarray, "n"]


def run_filter(
    scans: Scans,
    motion: MotionModel,
    settings: FilterSettings,
    camera_height_cm: float,
    wheelbase_cm: float,
    rng: np.random.Generator,
    progress: Progress | None = None,
) -> Trajectory:
    """Estimate the pose of every frame.

    Returns:
        The smoothed trajectory: the mean over the lineages of the particles that survived to the end.

    Source:
        Kozlowski et al. 2024, sections 3.1-3.3; likelihood by direction instead of counted points.
    """
    n, count = len(scans), settings.particles
    field = DirectionField.empty(
        settings.cell_heights * camera_height_cm, settings.field_size, settings.memory_frames
    )
    states = motion.start(count, rng)
    weights = np.full(count, 1.0 / count)
    history = np.empty((n, count, 5), np.float32)
    parents = np.empty((n, count), np.int32)
    parents[0] = np.arange(count)
    match = np.full(n, np.nan)
    spread = np.zeros(n)
    for k in range(n):
        points, normals, trust = thin_scan(scans, k, settings.max_points, rng)
        if k > 0:
            motion.predict(states, k, rng)
            scores = field.score(states[:, :3], wheelbase_cm, points, normals, trust, k)
            weights = reweigh(weights, scores, settings.effective_share)
            match[k] = scores.max() / trust.sum() if trust.size else np.nan
        pose = mean_pose(states, weights)
        spread[k] = np.sqrt(np.sum(weights[:, None] * (states[:, :2] - pose[:2]) ** 2))
        history[k] = states
        if k > 0 and 1.0 / np.sum(weights**2) < settings.resample_below * count:
            chosen = systematic_resample(weights, rng)
            states, weights = states[chosen], np.full(count, 1.0 / count)
        else:
            chosen = np.arange(count)
        if k + 1 < n:
            parents[k + 1] = chosen
        frame = scans.frame(k)
        field.insert(
            map_from_car(scans.points_cm[frame], pose, wheelbase_cm),
            map_from_car_directions(scans.normals[frame], pose[HEADING]),
            scans.weights[frame],
            k,
        )
        if progress is not None:
            progress(k + 1, n)
    # The last step may have resampled: its weights then belong to the chosen particles.
    final = np.bincount(chosen, weights, minlength=count)
    smoothed = smooth_lineages(history, parents, final)
    return Trajectory(smoothed[:, :3], smoothed[:, 3], match, spread)


def thin_scan(
    scans: Scans, k: int, max_points: int, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m 2"], Float[np.ndarray, "m"]]:
    """Return frame k's points, normals and weights, at most ``max_points`` of them, drawn evenly."""
    frame = scans.frame(k)
    size = frame.stop - frame.start
    if size <= max_points:
        return scans.points_cm[frame], scans.normals[frame], scans.weights[frame]
    chosen = frame.start + np.sort(rng.choice(size, max_points, replace=False))
    return scans.points_cm[chosen], scans.normals[chosen], scans.weights[chosen]


def reweigh(
    weights: Float[np.ndarray, "p"], scores: Float[np.ndarray, "p"], effective_share: float
) -> Float[np.ndarray, "p"]:
    """Turn match scores into weights, as sharply as the particles can bear.

    Edge points of one line are not independent, so that the plain likelihood would leave one particle. The
    scores are tempered until the effective number of particles is at least ``effective_share`` of them.
    """
    relative = scores - scores.max()
    temperature = 1.0
    for _ in range(20):
        new = weights * np.exp(relative / temperature)
        new /= new.sum()
        if 1.0 / np.sum(new**2) >= effective_share * len(new):
            break
        temperature *= 1.4
    return new


def systematic_resample(weights: Float[np.ndarray, "p"], rng: np.random.Generator) -> Int[np.ndarray, "p"]:
    """Draw as many particles as there are, each N times its weight on average, with one random number.

    Source:
        Kitagawa 1996; copies of each particle differ from N * weight by less than one.
    """
    n = len(weights)
    positions = (np.arange(n) + rng.random()) / n
    cumulative = np.cumsum(weights)
    cumulative[-1] = 1.0
    return np.searchsorted(cumulative, positions, side="right").clip(0, n - 1)


def mean_pose(states: Float[np.ndarray, "p 5"], weights: Float[np.ndarray, "p"]) -> Float[np.ndarray, "3"]:
    """Weighted mean pose; headings are unwrapped and close together, so that a plain mean serves."""
    return weights @ states[:, :3]


def smooth_lineages(
    history: Float[np.ndarray, "n p 5"], parents: Int[np.ndarray, "n p"], final: Float[np.ndarray, "p"]
) -> Float[np.ndarray, "n 5"]:
    """Mean state per frame over the lineages of the final particles.

    Args:
        history: Every particle at every frame, before resampling.
        parents: Index of each particle's ancestor in the frame before.
        final: Weights of the particles at the last frame.
    """
    n = len(history)
    smoothed = np.empty((n, 5))
    weights = final
    for k in range(n - 1, -1, -1):
        smoothed[k] = weights @ history[k]
        weights = np.bincount(parents[k], weights, minlength=history.shape[1])
    return smoothed
