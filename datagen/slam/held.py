"""A drive followed at a held speed: the particle filter on one map that all share, compiled as a whole.

Held speeds are compared by the dozen, for every camera that is tried; what tells lineages apart, and keeps
the trajectory, is not needed for that. The map is that of ``filter.maps=mean``: every frame is entered once,
at the particles' mean pose.

The loop calls into other files, whose changes numba's cache does not notice (see
:mod:`datagen.slam.lens_kernels`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float, Int
from numba import njit

from datagen.slam.condense import condense
from datagen.slam.filter import FilterSettings
from datagen.slam.motion import HEADING, MotionModel, X, Y, advance
from datagen.slam.resampling import count_effective, draw_evenly, temper
from datagen.slam.scans import Scans


@dataclass(frozen=True)
class HeldStretch:
    """A stretch of a drive, ready to be followed many times.

    Attributes:
        points: Condensed edge points of all frames: x right, y ahead, normal x, normal y (frame car), weight.
        starts: First point of each frame, and one behind the last.
        settings: Size of the filter, which enters every frame at the particles' mean pose, and none of whose
            particles stray.
        camera_height_cm: Scale of the map's cells.
        wheelbase_cm: Of the car.
    """

    points: Float[np.ndarray, "m 5"]
    starts: Int[np.ndarray, "n1"]
    settings: FilterSettings
    camera_height_cm: float
    wheelbase_cm: float

    @staticmethod
    def of(
        scans: Scans, settings: FilterSettings, camera_height_cm: float, wheelbase_cm: float
    ) -> HeldStretch:
        """Condense the frames, as the filter does."""
        parts, patch_cm = [np.empty((0, 5))], settings.patch_heights * camera_height_cm
        for k in range(len(scans)):
            frame = scans.frame(k)
            seen = scans.points_cm[frame], scans.normals[frame], scans.weights[frame]
            points, normals, weights = condense(*seen, patch_cm, settings.max_points)
            parts.append(np.concatenate([points, normals, weights[:, None]], axis=1))
        starts = np.cumsum([len(part) for part in parts]).astype(np.int64)
        return HeldStretch(np.concatenate(parts), starts, settings, camera_height_cm, wheelbase_cm)

    def match(self, motion: MotionModel, seed: int) -> Float[np.ndarray, "n"]:
        """Follow the stretch.

        Args:
            motion: How the car may move.
            seed: Of the noise: the same for motions that are compared, so that chance favours none.

        Returns:
            Matched share of each frame's edge points, 0..1; NaN where it has none and in the first frame.
        """
        s, n, rng = self.settings, len(self.starts) - 1, np.random.default_rng(seed)
        states = motion.start(s.particles, rng)
        noise, uniform = rng.standard_normal((n, 4, s.particles)), rng.random(n)
        match, size = np.full(n, np.nan), s.field_size
        _follow(
            self.points,
            self.starts,
            motion.distance_cm,
            motion.curvature_per_cm,
            motion.numbers,
            states,
            noise,
            uniform,
            np.zeros((size, size, 2)),
            np.zeros((size, size, 2), np.int32),
            np.full((size, size), -1, np.int32),
            np.exp(-np.arange(n + 1) / s.memory_frames),
            np.full(s.particles, 1.0 / s.particles),
            np.empty((2, s.particles)),
            s.cell_heights * self.camera_height_cm,
            self.wheelbase_cm,
            s.effective_share,
            s.resample_below,
            match,
        )
        return match


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def _follow(
    points,
    starts,
    distance_cm,
    curvature_per_cm,
    numbers,
    states,
    noise,
    uniform,
    vectors,
    owner,
    stamp,
    fades,
    weights,
    work,
    cell_cm,
    wheelbase,
    effective_share,
    resample_below,
    match,
):
    """Predict, weigh, map at the mean pose, resample; fill ``match``."""
    count, scores, new = states.shape[0], work[0], work[1]
    chosen = np.empty(count, np.int64)
    for k in range(match.shape[0]):
        first, last = starts[k], starts[k + 1]
        if k > 0:
            advance(states, noise[k], distance_cm[k], curvature_per_cm[k], numbers)
            _score(vectors, owner, stamp, fades, states, points, first, last, k, wheelbase, cell_cm, scores)
            temper(weights, scores, effective_share, new)
            total, best = 0.0, scores[0]
            for i in range(first, last):
                total += points[i, 4]
            for p in range(count):
                weights[p] = new[p]
                best = max(best, scores[p])
            if total > 0.0:
                match[k] = best / total
        x, y, heading = 0.0, 0.0, 0.0
        for p in range(count):
            x += weights[p] * states[p, X]
            y += weights[p] * states[p, Y]
            heading += weights[p] * states[p, HEADING]
        _enter(vectors, owner, stamp, fades, x, y, heading, points, first, last, k, wheelbase, cell_cm)
        if k > 0 and count_effective(weights) < resample_below * count:
            draw_evenly(weights, uniform[k], chosen)
            states = states[chosen]
            for p in range(count):
                weights[p] = 1.0 / count


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def _score(vectors, owner, stamp, fades, states, points, first, last, frame, wheelbase, cell_cm, scores):
    """About the weighted number of matched points for each particle (see ``AncestryMap.score``)."""
    mask = stamp.shape[0] - 1
    for p in range(states.shape[0]):
        c, s = np.cos(states[p, HEADING]), np.sin(states[p, HEADING])
        total = 0.0
        for i in range(first, last):
            right, forward = points[i, 0], points[i, 1] + wheelbase
            ix = int(np.floor((states[p, X] + forward * c + right * s) / cell_cm))
            iy = int(np.floor((states[p, Y] + forward * s - right * c) / cell_cm))
            a, b = iy & mask, ix & mask
            if stamp[a, b] < 0 or owner[a, b, 0] != ix or owner[a, b, 1] != iy:
                continue
            fade = fades[frame - stamp[a, b]]
            x, y = fade * vectors[a, b, 0], fade * vectors[a, b, 1]
            nx = points[i, 3] * c + points[i, 2] * s
            ny = points[i, 3] * s - points[i, 2] * c
            # Saturate: an edge that was seen often counts once.
            total += points[i, 4] * (nx * x + ny * y) / (1.0 + np.sqrt(x * x + y * y))
        scores[p] = total


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def _enter(vectors, owner, stamp, fades, x, y, heading, points, first, last, frame, wheelbase, cell_cm):
    """Share every point's normal among the four nearest cells."""
    mask = stamp.shape[0] - 1
    c, s = np.cos(heading), np.sin(heading)
    for i in range(first, last):
        right, forward = points[i, 0], points[i, 1] + wheelbase
        gx = (x + forward * c + right * s) / cell_cm - 0.5
        gy = (y + forward * s - right * c) / cell_cm - 0.5
        nx = points[i, 3] * c + points[i, 2] * s
        ny = points[i, 3] * s - points[i, 2] * c
        cx, cy = int(np.floor(gx)), int(np.floor(gy))
        for jy in range(2):
            for jx in range(2):
                ix, iy = cx + jx, cy + jy
                a, b = iy & mask, ix & mask
                fade = 0.0
                if stamp[a, b] >= 0 and owner[a, b, 0] == ix and owner[a, b, 1] == iy:
                    fade = fades[frame - stamp[a, b]]
                owner[a, b, 0], owner[a, b, 1], stamp[a, b] = ix, iy, frame
                share = points[i, 4] * (1.0 - abs(gx - ix)) * (1.0 - abs(gy - iy))
                vectors[a, b, 0] = fade * vectors[a, b, 0] + share * nx
                vectors[a, b, 1] = fade * vectors[a, b, 1] + share * ny
