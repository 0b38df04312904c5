"""The particle filter in its plainest form: every particle owns a whole map and copies it with itself.

Slow, and obviously right: no ancestry, no pruning, no grid that wraps around. It draws the same random numbers
as the filter proper, whose shared map must answer the same.
"""

from __future__ import annotations

import numpy as np

from datagen.slam.filter import FilterSettings, spread_rows, thin_scan
from datagen.slam.motion import MotionModel, calm_motion
from datagen.slam.resampling import effective_number, reweigh, systematic_resample
from datagen.slam.scans import Scans
from lanenet.geometry.frames import map_from_car, map_from_car_directions

#: Cell of the unbounded plane -> what was seen there: frame and vector.
PlainMap = dict[tuple[int, int], list[tuple[int, np.ndarray]]]


def copy_of(plain: PlainMap) -> PlainMap:
    return {cell: list(seen) for cell, seen in plain.items()}


def enter(
    plain: PlainMap,
    points_map_cm: np.ndarray,
    normals_map: np.ndarray,
    weights: np.ndarray,
    frame: int,
    cell_cm: float,
    count: bool,
) -> None:
    for point, normal, weight in zip(points_map_cm / cell_cm, normals_map, weights, strict=True):
        if count:
            shares = {(int(np.floor(point[0])), int(np.floor(point[1]))): 1.0}
            normal = np.array([1.0, 0.0])
        else:
            low = np.floor(point - 0.5)
            tx, ty = point - 0.5 - low
            x, y = int(low[0]), int(low[1])
            shares = {
                (x, y): (1.0 - tx) * (1.0 - ty),
                (x + 1, y): tx * (1.0 - ty),
                (x, y + 1): (1.0 - tx) * ty,
                (x + 1, y + 1): tx * ty,
            }
        for cell, share in shares.items():
            # The filter proper stores single precision.
            vector = (weight * share * normal).astype(np.float32).astype(np.float64)
            plain.setdefault(cell, []).append((frame, vector))


def score(
    plain: PlainMap,
    points_map_cm: np.ndarray,
    normals_map: np.ndarray,
    weights: np.ndarray,
    frame: int,
    settings: FilterSettings,
    cell_cm: float,
) -> float:
    total = 0.0
    for point, normal, weight in zip(points_map_cm / cell_cm, normals_map, weights, strict=True):
        vector = np.zeros(2)
        for seen, what in plain.get((int(np.floor(point[0])), int(np.floor(point[1]))), []):
            vector += np.exp((seen - frame) / settings.memory_frames) * what
        if settings.likelihood == "count":
            total += weight * (vector[0] >= 0.05)
        else:
            total += weight * float(normal @ vector) / (1.0 + float(np.linalg.norm(vector)))
    return total


def reference_filter(
    scans: Scans,
    motion: MotionModel,
    settings: FilterSettings,
    camera_height_cm: float,
    wheelbase_cm: float,
    rng: np.random.Generator,
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Particles and weights after each frame."""
    count, cell_cm = settings.particles, settings.cell_heights * camera_height_cm
    states = motion.start(count, rng)
    weights = np.full(count, 1.0 / count)
    maps: list[PlainMap] = [{} for _ in range(count)]
    all_states, all_weights = [], []
    for k in range(len(scans)):
        points, normals, trust = thin_scan(scans, k, settings.max_points, rng)
        if k > 0:
            before = states.copy()
            motion.predict(states, k, rng)
            scores = np.array(
                [
                    score(
                        maps[p],
                        map_from_car(points, states[p, :3], wheelbase_cm),
                        map_from_car_directions(normals, states[p, 2]),
                        trust,
                        k,
                        settings,
                        cell_cm,
                    )
                    for p in range(count)
                ]
            )
            weights = reweigh(weights, scores, settings.effective_share)
            calm_motion(before, states, weights, settings.noise_kept)
            if effective_number(weights) < settings.resample_below * count:
                chosen = systematic_resample(weights, rng)
                states, weights = states[chosen], np.full(count, 1.0 / count)
                maps = [copy_of(maps[p]) for p in chosen]
        rows = spread_rows(len(trust), settings.map_points, k)
        for p in range(count):
            enter(
                maps[p],
                map_from_car(points[rows], states[p, :3], wheelbase_cm),
                map_from_car_directions(normals[rows], states[p, 2]),
                trust[rows],
                k,
                cell_cm,
                settings.likelihood == "count",
            )
        all_states.append(states.copy())
        all_weights.append(weights.copy())
    return all_states, all_weights
