"""Time and memory of the renderer: ``python tests/bench/bench_renderer.py [--seeds N] [--processes N]``.

Appearances and lengths of road are drawn in turn, a few frames at a time, so that a busy machine slows all of
them alike. Each length is several roads, each driven at several places along it, since one place has more in
view than another. The first frame at a place does not count: no car jumps there. A long road folds, and more
things stand around a place on it than on a short one (``solids``: mean number near the car); ``no things`` is
every effect without things beside the road, and compares lengths on equal terms.

Times are CPU time of the drawing thread, with the wall clock beside. ``held_mb`` is what a renderer's arrays
take, without the camera's rays, which renderers share. Prints JSON, a line per appearance and length.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import platform
import resource
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field

import cv2
import numpy as np

from datagen.world.car.camera import CameraSettings
from datagen.world.render.appearance import Appearance
from datagen.world.render.ground import PixelGround
from datagen.world.render.renderer import Renderer
from datagen.world.road.build import random_track
from datagen.world.road.track import Track
from datagen.world.road.track_settings import TrackSettings

EVERY_EFFECT = Appearance(
    floor="asphalt", texture_level=8.0, verge_bgr=(120.0, 140.0, 60.0), joint_u_cm=30.0, joint_v_cm=30.0,
    line_wear=0.5, lamps_per_m=0.7, clutter_per_m=2.5, wall_level=30.0, vignetting=0.4, blur_px=1.0,
    noise_level=4.0, jpeg_quality=80, objects_per_m=1.0, objects_on_road=0.2, shadows_per_m=0.4,
    exposure_drift=0.1, exposure_step=0.1, white_balance_drift=0.03, white_balance_step=0.03, exposure_s=0.02,
    readout_s=0.02, shake_pitch_rad=0.006, shake_roll_rad=0.004, lamp_streak=1.5, lamp_edge=3.0,
    lamp_size=0.8, glints_per_m=2.0, specks_per_m=3.0, prints_per_m=0.5, stain_level=6.0, crack_level=10.0,
)  # fmt: skip
NO_THINGS = EVERY_EFFECT.model_copy(
    update={"lamps_per_m": 0.0, "clutter_per_m": 0.0, "objects_per_m": 0.0, "shadows_per_m": 0.0}
)
LOOKS = {"plain": Appearance(), "no things": NO_THINGS, "every effect": EVERY_EFFECT}
LENGTHS_CM = (1000.0, 20000.0)
SPEED_CM_S, YAW_RATE_RAD_S, INTERVAL_S = 60.0, 0.5, 0.05
PLACES, BLOCK = 4, 10  # places on a road, and frames in a row at each
MARGIN_CM = 100.0  # before the first place and after the last


@dataclass
class Job:
    """One appearance on one length of road."""

    look: str
    length_cm: float
    roads: list[tuple[Track, Renderer]] = field(default_factory=list)
    wall_s: list[float] = field(default_factory=list)
    cpu_s: list[float] = field(default_factory=list)
    solids: list[int] = field(default_factory=list)

    def draw(self, seed: int, place: int, timed: bool) -> None:
        """Draw one block of frames."""
        track, renderer = self.roads[seed]
        free_cm = track.length_cm - 3.0 * MARGIN_CM - BLOCK * SPEED_CM_S * INTERVAL_S
        start_cm = MARGIN_CM + free_cm * place / (PLACES - 1)
        for frame in range(-1, BLOCK):
            xy, heading = track.point(start_cm + frame * SPEED_CM_S * INTERVAL_S)
            pose = np.array([*xy, heading])
            start, start_cpu = time.perf_counter(), time.thread_time()
            renderer.render(pose, frame + 1, SPEED_CM_S, YAW_RATE_RAD_S)
            if timed and frame >= 0:
                self.wall_s.append(time.perf_counter() - start)
                self.cpu_s.append(time.thread_time() - start_cpu)
        self.solids.append(len(renderer._solids.at(*xy)[0]))


def measure(seeds: int) -> list[dict[str, float | str]]:
    """Draw frames of every appearance on roads of every length, in turn."""
    cv2.setNumThreads(1)
    camera = CameraSettings().build(26.0)
    ground = PixelGround.of(camera)
    jobs = [Job(look, length_cm) for look in LOOKS for length_cm in LENGTHS_CM]
    for seed in range(seeds):
        for job in jobs:
            track = random_track(TrackSettings(length_cm=job.length_cm), np.random.default_rng(seed))
            rng = np.random.default_rng(seed)
            job.roads.append((track, Renderer(camera, track, LOOKS[job.look], rng, ground)))
    for timed in (False, True):  # the first frames compile
        for seed in range(seeds if timed else 1):
            for place in range(PLACES):
                for job in jobs:
                    job.draw(seed, place, timed)
    rows: list[dict[str, float | str]] = []
    for job in jobs:
        short = next(other for other in jobs if other.look == job.look)
        cpu_s = float(np.mean(job.cpu_s))
        rows.append(
            {
                "look": job.look,
                "road_m": job.length_cm / 100.0,
                "frames": len(job.cpu_s),
                "cpu_mean_ms": round(1e3 * cpu_s, 3),
                "cpu_median_ms": round(1e3 * float(np.median(job.cpu_s)), 3),
                "cpu_frames_per_s": round(1.0 / cpu_s, 1),
                "wall_median_ms": round(1e3 * float(np.median(job.wall_s)), 3),
                "wall_p99_ms": round(1e3 * float(np.percentile(job.wall_s, 99)), 3),
                "ratio_to_short": round(cpu_s / float(np.mean(short.cpu_s)), 3),
                "solids": round(float(np.mean(job.solids)), 1),
                "held_mb": round(float(np.mean([held_mb(renderer) for _, renderer in job.roads])), 1),
            }
        )
    return rows


def held_mb(renderer: Renderer) -> float:
    """Return the size of all arrays that a renderer holds but for the camera's rays, [MB]."""
    shared = {id(array) for array in _arrays(renderer._ground, set())}
    sizes = {}
    for array in _arrays(vars(renderer), set()):
        base = array if array.base is None else array.base
        if id(base) not in shared and id(array) not in shared:
            sizes[id(base)] = base.nbytes if isinstance(base, np.ndarray) else array.nbytes
    return sum(sizes.values()) / 1e6


def _arrays(thing: object, seen: set[int]) -> Iterator[np.ndarray]:
    """All arrays within an object, through containers and attributes."""
    if id(thing) in seen:
        return
    seen.add(id(thing))
    if isinstance(thing, np.ndarray):
        yield thing
    elif isinstance(thing, dict):
        for value in thing.values():
            yield from _arrays(value, seen)
    elif isinstance(thing, (tuple, list)):
        for value in thing:
            yield from _arrays(value, seen)
    elif hasattr(thing, "__dict__") and not isinstance(thing, type):
        yield from _arrays(vars(thing), seen)


def _count(args: tuple[int, float]) -> int:
    """Frames with every effect that one process draws in so many seconds."""
    seed, seconds = args
    cv2.setNumThreads(1)
    camera = CameraSettings().build(26.0)
    track = random_track(TrackSettings(length_cm=1000.0), np.random.default_rng(seed))
    renderer = Renderer(camera, track, EVERY_EFFECT, np.random.default_rng(seed))
    job = Job("every effect", 1000.0, [(track, renderer)])
    job.draw(0, 0, False)
    frames, end = 0, time.perf_counter() + seconds
    while time.perf_counter() < end:
        job.draw(0, frames // BLOCK % PLACES, False)
        frames += BLOCK
    return frames


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=6, help="roads of each length")
    parser.add_argument("--processes", type=int, default=1, help="also count frames in this many processes")
    args = parser.parse_args()
    machine = {
        "cpu": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "load": os.getloadavg()[0],
    }
    sys.stdout.write(json.dumps(machine) + "\n")
    for row in measure(args.seeds):
        sys.stdout.write(json.dumps(row) + "\n")
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    sys.stdout.write(json.dumps({"peak_rss_mb_of_all_renderers": round(peak_mb, 1)}) + "\n")
    if args.processes > 1:
        # The same roads each time: one process draws one after the other what many draw at once.
        for processes in (1, args.processes):
            with multiprocessing.get_context("spawn").Pool(processes) as pool:
                frames = pool.map(_count, [(seed, 3.0) for seed in range(args.processes)], chunksize=1)
            rounds = args.processes // processes
            row = {"processes": processes, "frames_per_s": round(sum(frames) / (3.0 * rounds), 1)}
            sys.stdout.write(json.dumps(row) + "\n")


if __name__ == "__main__":
    main()
