"""Time of a frame of the particle filter: ``python tests/bench/bench_filter.py [--frames N]``.

A made-up ring of dashed tapes is driven over and over. Both likelihoods take turns a block of frames at a
time, beside the plainest map there is, one field that all particles share and that is written at their mean
pose (no ancestry). Prints JSON: time of a frame early and late in the drive, and what the map takes.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import time

import numpy as np

from datagen.slam.filter.dp_slam import (
    FilterSettings,
    ParticleFilter,
    effective_number,
    reweigh,
    systematic_resample,
)
from datagen.slam.filter.motion import MotionModel
from datagen.slam.loops.revisits import DirectionField
from datagen.slam.odometry.scans import Scan, Scans, condense, pack_scans
from lanenet.geometry.frames import car_from_map, map_from_car, map_from_car_directions
from lanenet.perception.edges.road import RoadEdges

HEIGHT_CM, WHEELBASE_CM, STEP_CM, RADIUS_CM = 15.0, 17.0, 3.0, 150.0
PARTICLES = 200
LEAST_FRAMES = 600
BLOCK = 50  # frames of one filter in a row


def ring_scans(frames: int) -> Scans:
    """What a camera sees on one lap of a ring with a dashed and a solid line, both with cracks across."""
    points, normals = [], []
    for radius, period, share in ((RADIUS_CM - 18.0, 0.17, 0.55), (RADIUS_CM + 18.0, 0.17, 1.0)):
        for side in (-1.0, 1.0):
            angle = np.arange(0.0, 2.0 * np.pi, 0.35 / radius)
            angle = angle[np.mod(angle, period) < share * period]
            outward = np.column_stack([np.cos(angle), np.sin(angle)])
            points.append((radius + side) * outward)
            normals.append(-side * outward)
        for end, sign in ((0.0, 1.0), (share * period, -1.0)):
            angle = np.repeat(np.arange(0.0, 2.0 * np.pi - period, period) + end, 5)
            across = np.tile(np.linspace(-0.8, 0.8, 5), len(angle) // 5)
            outward = np.column_stack([np.cos(angle), np.sin(angle)])
            points.append((radius + across)[:, None] * outward)
            normals.append(sign * np.column_stack([-np.sin(angle), np.cos(angle)]))
    xy, normal = np.concatenate(points), np.concatenate(normals)
    rng = np.random.default_rng(0)
    scans = []
    for turned in np.arange(frames) * 2.0 * np.pi / frames:
        pose = np.array([RADIUS_CM * np.cos(turned), RADIUS_CM * np.sin(turned), turned + 0.5 * np.pi])
        seen_cm = car_from_map(xy, pose, WHEELBASE_CM)
        seen = (seen_cm[:, 1] > 8.0) & (seen_cm[:, 1] < 80.0) & (np.abs(seen_cm[:, 0]) < 60.0)
        c, s = np.cos(pose[2]), np.sin(pose[2])
        nx, ny = normal[seen].T
        noisy = seen_cm[seen] + 0.1 * rng.normal(size=(int(seen.sum()), 2))
        scans.append(RoadEdges(noisy, np.column_stack([nx * s - ny * c, nx * c + ny * s])))
    return pack_scans(scans, HEIGHT_CM)


def ring_motion(frames: int) -> MotionModel:
    """Speed known up to its gain, steering known up to an offset."""
    return MotionModel(
        distance_cm=np.full(frames, 2.0 * np.pi * RADIUS_CM / frames),
        curvature_per_cm=np.full(frames, 1.0 / RADIUS_CM),
        factor_start=(1.0, 0.05),
        factor_walk=0.005,
        factor_pull=0.1,
        distance_noise=0.02,
        offset_walk_per_cm=0.004 / HEIGHT_CM,
        offset_decay=0.02,
        curvature_noise_per_cm=0.01 / HEIGHT_CM,
        max_curvature_per_cm=0.8 / HEIGHT_CM,
    )


class SharedField:
    """The baseline: one field for all particles, written at their mean pose."""

    def __init__(self, motion: MotionModel, settings: FilterSettings, rng: np.random.Generator) -> None:
        self.settings, self.rng = settings, rng
        self.states = motion.start(settings.particles, rng)
        self.weights = np.full(settings.particles, 1.0 / settings.particles)
        self.field = DirectionField.empty(0.04 * HEIGHT_CM, 1024)
        self.frame = 0

    def step(self, scan: Scan, motion: MotionModel, k: int) -> None:
        """Predict, weigh, resample, map."""
        scored = condense(scan, self.settings.patch_heights * HEIGHT_CM, self.settings.max_points)
        if self.frame > 0:
            motion.predict(self.states, k, self.rng)
            scores = self.field.score(self.states[:, :3], WHEELBASE_CM, scored)
            self.weights = reweigh(self.weights, scores, self.settings.effective_share)
        pose = self.weights @ self.states[:, :3]
        if effective_number(self.weights) < self.settings.resample_below * len(self.weights):
            self.states = self.states[systematic_resample(self.weights, self.rng.random())]
            self.weights = np.full(len(self.weights), 1.0 / len(self.weights))
        self.field.insert(
            map_from_car(scan.points_cm, pose, WHEELBASE_CM),
            map_from_car_directions(scan.normals, pose[2]),
            scan.weights,
        )
        self.frame += 1

    @property
    def bytes(self) -> int:
        """Memory of the map."""
        return self.field.vectors.nbytes + self.field.owner.nbytes + self.field.mapped.nbytes


def measure(frames: int) -> list[dict[str, float | str]]:
    """Drive all filters over the ring in turn and time their steps."""
    lap = round(2.0 * np.pi * RADIUS_CM / STEP_CM)
    scans, motion = ring_scans(lap), ring_motion(lap)
    settings = FilterSettings(particles=PARTICLES)
    counting = settings.model_copy(update={"likelihood": "count"})

    def fresh(chosen: FilterSettings) -> ParticleFilter:
        return ParticleFilter(motion, chosen, HEIGHT_CM, WHEELBASE_CM, np.random.default_rng(0))

    filters: dict[str, ParticleFilter | SharedField] = {
        "shared field, no ancestry": SharedField(motion, settings, np.random.default_rng(0)),
        "direction": fresh(settings),
        "count": fresh(counting),
    }
    wall_s: dict[str, list[float]] = {name: [] for name in filters}
    cpu_s: dict[str, list[float]] = {name: [] for name in filters}
    for start in range(0, frames, BLOCK):
        for name, one in filters.items():
            for frame in range(start, min(start + BLOCK, frames)):
                k = frame % lap
                scan = scans.scan(k)
                begun, begun_cpu = time.perf_counter(), time.thread_time()
                one.step(scan, motion, k)
                wall_s[name].append(time.perf_counter() - begun)
                cpu_s[name].append(time.thread_time() - begun_cpu)
    # From frame 400 on everything is compiled and the map is filled; as many frames around each place.
    early, late = slice(400, 600), slice(max(frames - 200, 0), frames)
    base = float(np.median(cpu_s["shared field, no ancestry"][early]))
    rows_out: list[dict[str, float | str]] = []
    for name, one in filters.items():
        first, last = (1e3 * float(np.median(cpu_s[name][part])) for part in (early, late))
        row: dict[str, float | str] = {
            "filter": name,
            "particles": PARTICLES,
            "median_ms": round(1e3 * float(np.median(wall_s[name][400:])), 3),
            "p99_ms": round(1e3 * float(np.percentile(wall_s[name][400:], 99)), 3),
            "cpu_ms_at_500": round(first, 3),
            f"cpu_ms_at_{frames}": round(last, 3),
            "late_to_early": round(last / first, 3),
            "ratio_to_baseline": round(1e-3 * first / base, 2),
            "map_mb": round(one.bytes / 1e6 if isinstance(one, SharedField) else one.map.bytes / 1e6, 1),
        }
        if isinstance(one, ParticleFilter):
            row["pages_used_share"] = round(
                1.0 - int(one.map.arrays.pages.free[1]) / len(one.map.arrays.pages.used), 3
            )
            row["forced_frames"] = one.map.forced
        rows_out.append(row)
    return rows_out


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=10_000)
    args = parser.parse_args()
    if args.frames < LEAST_FRAMES:
        parser.error(f"--frames {args.frames}: expected {LEAST_FRAMES} or more; the first 400 are warm-up")
    machine = {
        "cpu": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "load": os.getloadavg()[0],
    }
    sys.stdout.write(json.dumps(machine) + "\n")
    for row in measure(args.frames):
        sys.stdout.write(json.dumps(row) + "\n")


if __name__ == "__main__":
    main()
