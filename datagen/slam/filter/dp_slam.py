"""DP-SLAM: a particle filter over trajectories, in which all particles share one map.

Source:
    Eliazar and Parr, "DP-SLAM: fast, robust simultaneous localization and mapping without predetermined
    landmarks" (IJCAI 2003) and "DP-SLAM 2.0" (ICRA 2004); for a car with one camera: Kozlowski et al. 2024,
    sections 3.1-3.3.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, no_type_check

import numpy as np
from jaxtyping import Float, Int
from numba import njit
from pydantic import Field

from datagen.slam.filter.ancestry import AncestryMap, Likelihood, MapLayout
from datagen.slam.filter.motion import FACTOR, MotionModel, widen_steps
from datagen.slam.odometry.scans import Progress, Scan, Scans, condense
from lanenet.config import Settings

#: Factor between the temperatures that are tried, and how many: 1.4^20 = 840 flattens any scores of 80
#: points.
_COOLER, _TEMPERATURES = 1.4, 20


class FilterSettings(Settings):
    """Size of the filter and sharpness of its likelihood.

    Lengths are in camera heights, because the road in one pixel, and with it every tolerance, scales with it.
    Values were chosen on ``donkey_circuit`` and on simulated drives (docs/mapping.md); what they cost is
    measured by ``tests/bench/bench_filter.py``.

    Attributes:
        particles: Number of particles.
        likelihood: ``direction`` scores edges that brighten in the same direction; ``count`` is the paper's
            number of matched points.
        maps: ``lineage`` is DP-SLAM: a particle's map is what its own ancestors saw from where they were.
            ``mean`` enters every frame once, at the particles' mean pose. That is cheaper, but it drifted
            more on the simulated drives where both were run.
        cell_heights: Side of a map cell: about what a car moves per frame.
        field_size: Cells along each side of the map, which wraps around; a power of two. 512 cells are 41
            camera heights, more than a frame sees.
        memory_frames: Frames after which a map entry has faded to 1/e. Far more than the four frames that the
            odometry compares, so that headings drift less.
        patch_heights: Side of the patches whose edge points are averaged: a map cell.
        max_points: Patches per frame that are scored and mapped, the heaviest first.
        window: Frames for which the map tells lineages apart.
        effective_share: Least effective share of the particles; scores are tempered until it is reached.
        resample_below: Effective share below which the particles are resampled; half is customary (Liu and
            Chen 1998).
        stray_every: One of so many particles strays from the predicted step further than the others; 0: none.
        stray_factor: How many times as far (see :func:`datagen.slam.filter.motion.widen_steps`).
    """

    particles: int = Field(default=300, ge=10, lt=1 << 16)
    likelihood: Likelihood = "direction"
    maps: Literal["lineage", "mean"] = "lineage"
    cell_heights: float = Field(default=0.08, gt=0.0)
    field_size: int = Field(default=512, ge=64)
    memory_frames: float = Field(default=40.0, gt=0.0)
    patch_heights: float = Field(default=0.08, gt=0.0)
    max_points: int = Field(default=80, ge=20)
    window: int = Field(default=64, ge=2, lt=1 << 15)
    effective_share: float = Field(default=0.15, gt=0.0, lt=1.0)
    resample_below: float = Field(default=0.5, gt=0.0, le=1.0)
    stray_every: int = Field(default=5, ge=0)
    stray_factor: float = Field(default=4.0, ge=1.0)


@dataclass(frozen=True)
class Estimate:
    """What is known when a frame has been filtered.

    Attributes:
        pose: Weighted mean of the particles: rear-axle x, y and heading (unwrapped), [cm], [cm], [rad],
            frame map.
        match: Matched share of the frame's edge points, 0..1; NaN where it has none and in the first frame.
        spread_cm: Standard deviation of the particles' position.
    """

    pose: Float[np.ndarray, "3"]
    match: float
    spread_cm: float


@dataclass(frozen=True)
class Survivors:
    """Particles of a frame that have descendants after its resampling, in their order.

    Attributes:
        states: Their states.
        parents: Which survivor of the frame before each descends from.
    """

    states: Float[np.ndarray, "u 5"]
    parents: Int[np.ndarray, "u"]


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


class ParticleFilter:
    """The filter, a frame at a time; its memory is bounded, so that it can run for as long as a car drives.

    Attributes:
        states: Particles after the last step (columns as in :mod:`datagen.slam.filter.motion`).
        weights: Their weights.
        map: The map that they share.
        survivors: Of the last step's resampling.
        survivor_of: Which of them each particle descends from.
        frame: Number of the next frame.
    """

    def __init__(
        self,
        motion: MotionModel,
        settings: FilterSettings,
        camera_height_cm: float,
        wheelbase_cm: float,
        rng: np.random.Generator,
    ) -> None:
        count, s = settings.particles, settings
        self.settings, self.rng = settings, rng
        self.patch_cm = s.patch_heights * camera_height_cm
        self.states = motion.start(count, rng)
        self.weights = np.full(count, 1.0 / count)
        cell_cm, memory = s.cell_heights * camera_height_cm, s.memory_frames
        layout = MapLayout(cell_cm, s.field_size, memory, wheelbase_cm, s.max_points, s.window, s.likelihood)
        self.map = AncestryMap(count, layout)
        self.survivors = Survivors(self.states[:0], np.zeros(0, np.int64))
        self.survivor_of = np.zeros(count, np.int64)
        self.frame = 0

    def step(self, scan: Scan, motion: MotionModel, k: int) -> Estimate:
        """Take in the next frame: predict, weigh, estimate, resample, update the map.

        Args:
            scan: Edge points of the frame.
            motion: How the car may have moved since the last frame; a live car may pass a model of one row.
            k: Row of the motion model.
        """
        scan = condense(scan, self.patch_cm, self.settings.max_points)
        match = np.nan
        if self.frame > 0:
            self._predict(motion, k)
            log_likelihoods = self.map.score(self.states[:, :3], scan, self.frame)
            self.weights = reweigh(self.weights, log_likelihoods, self.settings.effective_share)
            match = log_likelihoods.max() / scan.weights.sum() if scan.weights.size else np.nan
        estimate = self._estimate(match)
        chosen = self._resample()
        self._update_ancestry(chosen, estimate.pose)
        self.map.enter(scan, self.frame)
        self.frame += 1
        return estimate

    def _predict(self, motion: MotionModel, k: int) -> None:
        before = self.states.copy()
        motion.predict(self.states, k, self.rng)
        widen_steps(before, self.states, self.settings.stray_every, self.settings.stray_factor)

    def _estimate(self, match: float) -> Estimate:
        # Headings are unwrapped and close together: a plain mean serves.
        mean = self.weights @ self.states
        spread = np.sqrt(self.weights @ np.sum((self.states[:, :2] - mean[:2]) ** 2, axis=1))
        return Estimate(mean[:3], float(match), float(spread))

    def _resample(self) -> Int[np.ndarray, "p"]:
        """Resample if too few particles count; return the parent of each new particle."""
        count = len(self.weights)
        if self.frame == 0 or effective_number(self.weights) >= self.settings.resample_below * count:
            return np.arange(count)
        chosen: Int[np.ndarray, "p"] = systematic_resample(self.weights, self.rng.random())
        self.weights = np.full(count, 1.0 / count)
        return chosen

    def _update_ancestry(self, chosen: Int[np.ndarray, "p"], mean_pose: Float[np.ndarray, "3"]) -> None:
        """Keep the particles with descendants, and let the ancestry of the map follow."""
        count = len(chosen)
        survived = np.bincount(chosen, minlength=count) > 0
        self.survivors = Survivors(self.states[survived], self.survivor_of[survived])
        self.survivor_of = (np.cumsum(survived) - 1)[chosen]
        if self.settings.maps == "lineage":
            self.map.descend(self.states, chosen, self.frame)
        else:
            self.map.descend(np.tile(mean_pose, (count, 1)), np.zeros(count, np.int64), self.frame)
        self.states = self.states[chosen]


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
    """
    n = len(scans)
    particles = ParticleFilter(motion, settings, camera_height_cm, wheelbase_cm, rng)
    history: list[Survivors] = []
    match, spread = np.full(n, np.nan), np.zeros(n)
    for k in range(n):
        estimate = particles.step(scans.scan(k), motion, k)
        match[k], spread[k] = estimate.match, estimate.spread_cm
        history.append(particles.survivors)
        if progress is not None:
            progress(k + 1, n)
    final = np.bincount(particles.survivor_of, particles.weights) if n else np.zeros(0)
    smoothed = smooth_lineages(history, final)
    return Trajectory(smoothed[:, :3], smoothed[:, FACTOR], match, spread)


def smooth_lineages(history: list[Survivors], final: Float[np.ndarray, "u"]) -> Float[np.ndarray, "n 5"]:
    """Mean state per frame over the lineages of the final particles.

    Args:
        history: Survivors of every frame.
        final: Weights of the last frame's survivors.
    """
    smoothed = np.empty((len(history), 5))
    weights = final
    for k in range(len(history) - 1, -1, -1):
        smoothed[k] = weights @ history[k].states
        if k > 0:
            weights = np.bincount(history[k].parents, weights, minlength=len(history[k - 1].states))
    return smoothed


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def reweigh(weights, scores, effective_share):
    """Turn match scores into weights, as sharply as the particles can bear.

    Edge points of one line are not independent, and the plain likelihood would leave one particle. The scores
    are tempered until the effective number of particles is at least ``effective_share`` of them.

    Args:
        weights: Weights before, one per particle.
        scores: Log likelihoods.
        effective_share: Least effective share of the particles, 0 to 1.

    Returns:
        Weights that add up to 1.
    """
    new = np.empty(len(weights))
    highest, temperature = scores[0], 1.0
    for p in range(len(weights)):
        highest = max(highest, scores[p])
    for _ in range(_TEMPERATURES):
        total = 0.0
        for p in range(len(weights)):
            new[p] = weights[p] * np.exp((scores[p] - highest) / temperature)
            total += new[p]
        for p in range(len(weights)):
            new[p] /= total
        if effective_number(new) >= effective_share * len(new):
            break
        temperature *= _COOLER
    return new


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def effective_number(weights):
    """Return how many equally weighted particles would be as good: 1 / sum of squares."""
    total = 0.0
    for p in range(len(weights)):
        total += weights[p] * weights[p]
    return 1.0 / total


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def systematic_resample(weights, uniform):
    """Draw as many particles as there are, each N times its weight on average, with one random number.

    Args:
        weights: Weights that add up to 1.
        uniform: The random number, in [0, 1).

    Returns:
        Indices in ascending order. The ancestry relies on it: descendants of a particle stay neighbours.

    Source:
        Kitagawa 1996; copies of each particle differ from N * weight by less than one.
    """
    n = len(weights)
    chosen = np.empty(n, np.int64)
    at, cumulative = 0, weights[0]
    for k in range(n):
        position = (k + uniform) / n
        while at < n - 1 and cumulative <= position:
            at += 1
            cumulative += weights[at]
        chosen[k] = at
    return chosen
