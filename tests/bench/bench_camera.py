"""Cameras adjusted on simulated drives, against the truth: are they off on average, and do their sigmas hold?

Random cars, roads and looks, those of ``bench_traps.py`` without gaps. Each drive is adjusted from its true
poses and a camera that is a few per cent off, with the priors of an unknown camera. So only the adjustment is
looked at; what the search before it may get wrong is the subject of ``bench_traps.py``. About ten seconds a
drive:

    python tests/bench/bench_camera.py --folder runs/cameras --drives 0:143
"""

from __future__ import annotations

import argparse
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from bench_traps import drive_settings

from datagen.prepare import hide_bumper
from datagen.settings import MapSettings
from datagen.slam.adjustment.adjust import CAMERA_NAMES, BundleEstimate, adjust
from datagen.slam.adjustment.state import BundleState
from datagen.slam.commands import commands_of
from datagen.slam.loops.pose_graph import neighbouring_laps
from datagen.slam.view import view_road
from datagen.world.simulate import simulate_drive
from lanenet.data.drives import open_drive, read_truth

#: Of drive 0; another one than that of the traps.
SEED = 99_000
ROUNDS, SETTLED = 6, 0.003
#: Standard deviations of the start's focal length, relative, and pitch, [rad].
START_OFF = (0.05, 0.02)


def judge(number: int, folder: Path, seed: int) -> tuple[str, np.ndarray, np.ndarray] | None:
    """Simulate a drive if it is not there yet, and adjust its camera.

    Returns:
        Its name, errors and sigmas; None for a drive with gaps.
    """
    simulated, trap, _ = drive_settings(number, seed)
    if simulated.gaps != "none":
        return None
    path = folder / f"{number:03d}_{trap}"
    if not (path / "truth.csv").exists():
        simulate_drive(simulated, path)
    drive, truth = open_drive(path), read_truth(path)
    assert truth is not None and drive.camera is not None
    true, rng = drive.camera, np.random.default_rng(seed + number)
    height = true.mounting.height_cm
    poses = np.stack([truth["x_cm"], truth["y_cm"], np.unwrap(truth["heading_rad"])], axis=1)
    off = rng.normal(0.0, START_OFF)
    ahead_cm = 0.9 * height - true.wheelbase_cm
    prior = replace(true, D=np.array([MapSettings().guess.k1, *true.D[1:]])).with_mounting(
        roll_rad=0.0, yaw_rad=0.0, ahead_of_front_axle_cm=ahead_cm
    )
    start = replace(true, K=true.K * [[1.0 + off[0], 1.0, 1.0], [1.0, 1.0 + off[0], 1.0], [1.0, 1.0, 1.0]])
    start = start.with_mounting(pitch_down_rad=true.mounting.pitch_down_rad + off[1])
    settings, _ = hide_bumper(drive, MapSettings())
    commands, found = commands_of(drive, true.wheelbase_cm), BundleEstimate.level(poses, start)
    for _ in range(ROUNDS):
        before = found.camera.K[0, 0]
        observed = view_road(drive, found.camera, settings).observed(commands)
        loops = neighbouring_laps(found.poses, height, settings.revisits)
        bundle = settings.bundle.with_free_tilt()
        found = result = adjust(observed, found, bundle, rng, loops=loops, prior_camera=prior)
        if abs(found.camera.K[0, 0] / before - 1.0) < SETTLED:
            break
    sigma = np.array([result.sigma[name] for name in CAMERA_NAMES])
    return path.name, BundleState.at(found).camera_minus(true), sigma


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--folder", type=Path, required=True, help="drives are kept here")
    parser.add_argument("--drives", default="0:143", help="first:last; ten kinds, three of them with gaps")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--seed", type=int, default=SEED, help="another seed needs another folder")
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    errors, sigmas = [], []
    with ProcessPoolExecutor(args.processes) as pool:
        numbers = range(*map(int, args.drives.split(":")))
        for row in pool.map(partial(judge, folder=args.folder, seed=args.seed), numbers):
            if row is not None:
                errors.append(row[1])
                sigmas.append(row[2])
                numbers_of = zip(CAMERA_NAMES, *row[1:], strict=True)
                each = "  ".join(f"{name} {e:+.4f} / {s:.4f}" for name, e, s in numbers_of)
                sys.stdout.write(f"{row[0]}: {each}\n")
                sys.stdout.flush()
    error, ratio = np.array(errors), np.array(errors) / np.array(sigmas)
    for k, name in enumerate(CAMERA_NAMES):
        held = int(np.sum(np.abs(ratio[:, k]) <= 2.0))
        sys.stdout.write(
            f"{name}: mean error {error[:, k].mean():+.4f}, RMS {np.sqrt(np.mean(error[:, k] ** 2)):.4f}; "
            f"{held} of {len(error)} within 2 sigma, RMS {np.sqrt(np.mean(ratio[:, k] ** 2)):.2f} sigma\n"
        )


if __name__ == "__main__":
    main()
