"""Time of a frame, plain and with every effect: ``python tests/bench/bench_renderer.py [--processes N]``.

The looks are drawn in turn, a few frames at a time, so that a busy machine is busy for all of them. Times are
wall clock, with the CPU time of the drawing thread beside. Prints JSON, a line per look and length of road.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import platform
import sys
import time

import cv2
import numpy as np

from datagen.world.look import LookSettings
from datagen.world.renderer import PixelGround, Renderer
from datagen.world.rig import CameraSettings
from datagen.world.track import Track, TrackSettings, random_track

EVERY_EFFECT = LookSettings(
    floor="asphalt", texture_level=8.0, verge_bgr=(120.0, 140.0, 60.0), joint_u_cm=30.0, joint_v_cm=30.0,
    line_wear=0.5, lamps_per_m=0.7, clutter_per_m=2.5, wall_level=30.0, vignetting=0.4, blur_px=1.0,
    noise_level=4.0, jpeg_quality=80, objects_per_m=1.0, objects_on_road=0.2, shadows_per_m=0.4,
    exposure_drift=0.1, exposure_step=0.1, white_balance_drift=0.03, white_balance_step=0.03, exposure_s=0.02,
    readout_s=0.02, shake_pitch_rad=0.006, shake_roll_rad=0.004,
)  # fmt: skip
SPEED_CM_S, YAW_RATE_RAD_S, INTERVAL_S = 60.0, 0.5, 0.05
BLOCK = 20  # frames of one look in a row


def measure(frames: int, seed: int = 0) -> list[dict[str, float | str]]:
    """Draw frames of a plain look and of every effect, on a road of 10 m and one of 200 m."""
    cv2.setNumThreads(1)
    camera = CameraSettings().build(26.0)
    ground = PixelGround.of(camera)
    jobs: list[tuple[str, Track, Renderer, list[float], list[float]]] = []
    for length_cm in (1000.0, 20000.0):
        track = random_track(TrackSettings(length_cm=length_cm), np.random.default_rng(seed))
        for name, look in (("plain", LookSettings()), ("every effect", EVERY_EFFECT)):
            renderer = Renderer(camera, track, look, np.random.default_rng(seed), ground)
            jobs.append((f"{name}, {length_cm / 100.0:.0f} m", track, renderer, [], []))
    for _, track, renderer, _, _ in jobs:
        for frame in range(5):  # the first frames compile and fill the caches
            renderer.render(np.array([*track.point(40.0)[0], 0.0]), frame, SPEED_CM_S, YAW_RATE_RAD_S)
    for block in range(0, frames, BLOCK):
        for _, track, renderer, wall_s, cpu_s in jobs:
            for frame in range(block, min(block + BLOCK, frames)):
                # Along the road as a car drives, from one tenth of it on: a long road starts elsewhere.
                xy, heading = track.point(0.1 * track.length_cm + (frame % 200) * SPEED_CM_S * INTERVAL_S)
                pose = np.array([*xy, heading])
                start, start_cpu = time.perf_counter(), time.thread_time()
                renderer.render(pose, frame, SPEED_CM_S, YAW_RATE_RAD_S)
                wall_s.append(time.perf_counter() - start)
                cpu_s.append(time.thread_time() - start_cpu)
    plain = float(np.median(jobs[0][3]))
    rows: list[dict[str, float | str]] = []
    for name, _, _, wall_s, cpu_s in jobs:
        median = float(np.median(wall_s))
        rows.append(
            {
                "look": name,
                "median_ms": round(1e3 * median, 3),
                "p99_ms": round(1e3 * float(np.percentile(wall_s, 99)), 3),
                "frames_per_s": round(1.0 / median, 1),
                "cpu_median_ms": round(1e3 * float(np.median(cpu_s)), 3),
                "cpu_frames_per_s": round(1.0 / float(np.median(cpu_s)), 1),
                "ratio_to_plain": round(median / plain, 2),
            }
        )
    return rows


def _count(args: tuple[int, float]) -> int:
    """Frames with every effect that one process draws in so many seconds."""
    seed, seconds = args
    measure(1, seed)
    camera = CameraSettings().build(26.0)
    track = random_track(TrackSettings(length_cm=1000.0), np.random.default_rng(seed))
    renderer = Renderer(camera, track, EVERY_EFFECT, np.random.default_rng(seed))
    frames, end = 0, time.perf_counter() + seconds
    while time.perf_counter() < end:
        xy, heading = track.point(40.0 + (frames % 200) * 3.0)
        renderer.render(np.array([*xy, heading]), frames, SPEED_CM_S, YAW_RATE_RAD_S)
        frames += 1
    return frames


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--processes", type=int, default=1, help="also count frames in this many processes")
    args = parser.parse_args()
    machine = {
        "cpu": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "load": os.getloadavg()[0],
    }
    sys.stdout.write(json.dumps(machine) + "\n")
    for row in measure(args.frames):
        sys.stdout.write(json.dumps(row) + "\n")
    if args.processes > 1:
        for processes in (1, args.processes):
            with multiprocessing.get_context("spawn").Pool(processes) as pool:
                frames = pool.map(_count, [(seed, 3.0) for seed in range(processes)])
            row = {"processes": processes, "frames_per_s": round(sum(frames) / 3.0, 1)}
            sys.stdout.write(json.dumps(row) + "\n")


if __name__ == "__main__":
    main()
