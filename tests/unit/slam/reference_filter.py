"""The particle filter in its plainest form: every particle owns a whole map and copies it with itself.

Slow, and obviously right: no ancestry, no pruning, no grid that wraps around. It draws the same random
numbers as the filter proper, whose shared map must answer the same.
"""

from __future__ import annotations

import numpy as np

from datagen.slam.filter.dp_slam import FilterSettings, effective_number, reweigh, systematic_resample
from datagen.slam.filter.motion import MotionModel, widen_steps
from datagen.slam.odometry.scans import Scans, condense
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
            plain.setdefault(cell, []).append((frame, weight * share * normal))


def look_up(
    plain: PlainMap, points_map_cm: np.ndarray, frame: int, settings: FilterSettings, cell_cm: float
) -> np.ndarray:
    """What the map holds where the points lie."""
    found = np.zeros((len(points_map_cm), 2))
    for i, point in enumerate(points_map_cm / cell_cm):
        for seen, what in plain.get((int(np.floor(point[0])), int(np.floor(point[1]))), []):
            found[i] += np.exp((seen - frame) / settings.memory_frames) * what
    return found


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
        points, normals, trust = condense(
            scans.scan(k), settings.patch_heights * camera_height_cm, settings.max_points
        )
        if k > 0:
            before = states.copy()
            motion.predict(states, k, rng)
            widen_steps(before, states, settings.stray_every, settings.stray_factor)
            held = np.stack(
                [
                    look_up(maps[p], map_from_car(points, states[p, :3], wheelbase_cm), k, settings, cell_cm)
                    for p in range(count)
                ]
            )
            if settings.likelihood == "count":
                scores = (held[:, :, 0] >= 0.05) @ trust
            else:
                turned = np.stack([map_from_car_directions(normals, states[p, 2]) for p in range(count)])
                strength = np.linalg.norm(held, axis=2)
                scores = (np.sum(turned * held, axis=2) / (1.0 + strength)) @ trust
            weights = reweigh(weights, scores, settings.effective_share)
            if effective_number(weights) < settings.resample_below * count:
                chosen = systematic_resample(weights, rng.random())
                states, weights = states[chosen], np.full(count, 1.0 / count)
                maps = [copy_of(maps[p]) for p in chosen]
        for p in range(count):
            enter(
                maps[p],
                map_from_car(points, states[p, :3], wheelbase_cm),
                map_from_car_directions(normals, states[p, 2]),
                trust,
                k,
                cell_cm,
                settings.likelihood == "count",
            )
        all_states.append(states.copy())
        all_weights.append(weights.copy())
    return all_states, all_weights
