"""Labels, poses and cameras against the truth of simulated drives: ``python tests/bench/bench_mapping.py``.

Random loops of all presets, both directions, every random effect, three cameras, half of them recorded as a
Donkeycar does (throttle and angle with unknown gains). Each drive is mapped with its camera known and with
the camera found from the drive; the wheelbase is told in either case, as by ``lanenet map --wheelbase``.
``--extra`` adds drives of another kind, which do not count for the rest: one that crawls, 1 cm per frame, and
one with pauses. Prints JSON, a line per drive and mode, then medians and worst values.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from datagen.labels.truth import true_lines
from datagen.pipeline import MapRequest, map_drive
from datagen.settings import MapSettings
from datagen.slam.odometry.stillness import following_frames
from datagen.world.road.track_settings import preset_names
from datagen.world.simulate import simulate_drive
from datagen.world.world import SimulationSettings
from lanenet.data.drives import open_drive, read_truth
from lanenet.data.maps.folder import read_map
from lanenet.data.maps.mapped_drive import read_map_frames
from lanenet.errors import LanenetError
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.lane import POINT_NAMES, ROWS_CM
from lanenet.geometry.poses import path_lengths

CAMERAS: tuple[dict[str, Any], ...] = (
    {},
    {"width": 160, "height": 120, "field_of_view_rad": math.radians(120.0), "height_cm": 17.0,
     "pitch_down_rad": math.radians(15.0), "roll_rad": 0.02, "yaw_rad": -0.03,
     "distortion": (-0.04, 0.0, 0.0, 0.0)},
    {"field_of_view_rad": math.radians(145.0), "height_cm": 23.0, "pitch_down_rad": math.radians(20.0),
     "roll_rad": -0.015, "yaw_rad": 0.02, "distortion": (-0.02, 0.0, 0.0, 0.0)},
)  # fmt: skip
LAPS = 1.6
#: Drives of another kind, by name.
EXTRA: dict[str, dict[str, Any]] = {
    "crawl": {
        "seed": 91_000,
        "frames": 1100,
        "track": {"closed": True, "length_cm": 560.0},
        "driver": {"style": "crawl"},
    },
    "pauses": {
        "seed": 91_001,
        "frames": 800,
        "track": {"closed": True, "length_cm": 900.0},
        "driver": {"pauses_per_m": 0.3, "pause_s": 4.0},
    },
}


def drive_settings(number: int) -> SimulationSettings:
    """Settings of one drive of the set."""
    rng = np.random.default_rng(90_000 + number)
    names = preset_names()
    length_cm = float(rng.uniform(900.0, 1300.0))
    speed_cm_s = float(rng.uniform(45.0, 75.0))
    gain = float(rng.uniform(0.85, 1.1))
    return SimulationSettings.model_validate(
        {
            "seed": 90_000 + number,
            "frames": int(LAPS * length_cm / (speed_cm_s * gain / 20.0)),
            "camera": CAMERAS[number % len(CAMERAS)],
            "track": {"preset": names[number % len(names)], "closed": True, "length_cm": length_cm},
            "car": {
                "steering_gain": float(rng.uniform(0.8, 1.15)),
                "steering_trim_rad": float(rng.uniform(-0.04, 0.04)),
                "speed_gain": gain,
                "delay_s": float(rng.uniform(0.0, 0.2)),
            },
            "driver": {
                "direction": "backward" if (number // 2) % 2 else "forward",
                "style": "recover" if number % 5 == 4 else "wander",
                "speed_cm_s": speed_cm_s,
                "speed_variation": float(rng.uniform(0.0, 0.2)),
            },
            "recording": "donkeycar" if number % 2 else "commands",
        }
    )


def aligned(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Move found positions onto the true ones, rigidly, by least squares (Umeyama without scale)."""
    a, b = found - found.mean(axis=0), truth - truth.mean(axis=0)
    u, _, vt = np.linalg.svd(b.T @ a)
    turn = u @ np.diag([1.0, np.linalg.det(u @ vt)]) @ vt
    return a @ turn.T + truth.mean(axis=0)


def drift_percent(opened: np.ndarray, true_xy: np.ndarray, way_cm: float = 300.0) -> float:
    """Mean error after a way of the open-loop path, each stretch laid on the true one at its first third."""
    path = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(true_xy, axis=0).T))])
    misses = []
    for start_cm in np.arange(0.0, path[-1] - way_cm, 0.25 * way_cm):
        a, m, b = np.searchsorted(path, [start_cm, start_cm + way_cm / 3.0, start_cm + way_cm])
        found, truth = opened[a:b, :2], true_xy[a:b]
        first = slice(0, m - a)
        shift, goal = found[first].mean(axis=0), truth[first].mean(axis=0)
        u, _, vt = np.linalg.svd((truth[first] - goal).T @ (found[first] - shift))
        turn = u @ np.diag([1.0, np.linalg.det(u @ vt)]) @ vt
        misses.append(np.linalg.norm(turn @ (found[-1] - shift) + goal - truth[-1]) / (path[b - 1] - path[m]))
    return 100.0 * float(np.mean(misses)) if misses else float("nan")


def judge(name: str, settings: SimulationSettings, folder: Path, known: bool) -> dict[str, Any]:
    """Map one drive and compare with its truth."""
    drive = folder / name
    if not (drive / "truth.csv").exists():
        simulate_drive(settings, drive)
    blind = folder / f"{name}_blind"
    if not known and not (blind / "frames.csv").exists():
        shutil.copytree(drive, blind)
        (blind / "drive.yaml").unlink()
        (blind / "camera.yaml").unlink()
    truth = read_truth(drive)
    assert truth is not None
    row: dict[str, Any] = {"drive": name, "preset": settings.track.preset}
    row["camera"] = "known" if known else "found"
    row |= {"frames": settings.frames, "recording": settings.recording}
    lane_width_cm = settings.track.lane_width_cm
    start = time.process_time()
    out = folder / f"{name}_map_{row['camera']}"
    shutil.rmtree(out, ignore_errors=True)
    map_settings = MapSettings.model_validate({"guess": {"wheelbase_cm": settings.car.wheelbase_cm}})
    try:
        report = map_drive(MapRequest(drive if known else blind, lane_width_cm), map_settings, out)
    except LanenetError as error:
        return row | {"refused": str(error)}
    row["cpu_s"] = round(time.process_time() - start, 1)
    drive_map, frames = read_map(out), read_map_frames(out)
    index = drive_map.frames
    true_points = np.stack([truth[point] for point in POINT_NAMES], axis=1)
    true_points = np.array([BirdseyeWindow().labelled(points) for points in true_points])
    # On the line between two lanes there is nothing to label.
    true_points[true_lines(drive, truth, settings.car.wheelbase_cm)[1]] = np.nan
    miss_cm = frames.points_cm - true_points[index]
    # A frame that counts and was not mapped is one without labels; repeated ones and pauses do not count.
    counted = np.unique(np.concatenate([following_frames(open_drive(drive))[0].frames, index]))
    labelable = np.isfinite(true_points[counted]).sum()
    row["labelled"] = round(float(np.isfinite(miss_cm).sum() / max(labelable, 1)), 4)
    for k, y_cm in enumerate(ROWS_CM):
        part = miss_cm[:, [k, k + len(ROWS_CM)]]
        part = part[np.isfinite(part)]
        row[f"rmse_{y_cm:.0f}_cm"] = round(float(np.sqrt(np.mean(part**2))), 3) if part.size else None
    part = miss_cm[np.isfinite(miss_cm)]
    row["p95_cm"] = round(float(np.percentile(np.abs(part), 95.0)), 3) if part.size else None
    xy = np.stack([truth["x_cm"], truth["y_cm"]], axis=1)[index]
    way_cm, true_way_cm = (path_lengths(path)[-1] for path in (drive_map.poses, xy))
    row["way_error_percent"] = round(100.0 * float(way_cm / true_way_cm - 1.0), 2)
    miss = np.linalg.norm(aligned(drive_map.poses[:, :2], xy) - xy, axis=1)
    lap_cm = settings.track.length_cm or 0.0
    row["ate_cm_per_10_m"] = round(float(np.sqrt(np.mean(miss**2))) * 1000.0 / lap_cm, 3)
    row["open_drift_percent"] = round(drift_percent(100.0 * np.loadtxt(out / "open_loop.tum")[:, 1:3], xy), 3)
    row["revisits"] = report.figures["segments_mapped"][0]["revisits"]
    row["laps"] = drive_map.meta.laps
    row["focal_error_percent"] = round(
        100.0 * (drive_map.camera.K[0, 0] / settings.camera.build(settings.car.wheelbase_cm).K[0, 0] - 1.0), 2
    )
    return row


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, required=True, help="drives and maps are kept here")
    parser.add_argument("--drives", default="0:20", help="first:last")
    parser.add_argument("--camera", choices=("known", "found", "both"), default="both")
    parser.add_argument("--extra", action="store_true", help="also drives that crawl and pause")
    parser.add_argument("--processes", type=int, default=1)
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    first, last = map(int, args.drives.split(":"))
    modes = {"known": [True], "found": [False], "both": [True, False]}[args.camera]
    drives = {f"{number:03d}": drive_settings(number) for number in range(first, last)}
    if args.extra:
        drives |= {name: SimulationSettings.model_validate(values) for name, values in EXTRA.items()}
    rows = []
    with ProcessPoolExecutor(args.processes) as pool:
        for known in modes:
            jobs = [pool.submit(judge, *drive, args.folder, known) for drive in drives.items()]
            for job in jobs:
                rows.append(job.result())
                sys.stdout.write(json.dumps(rows[-1]) + "\n")
                sys.stdout.flush()
    for mode in ("known", "found"):
        part = [
            row
            for row in rows
            if row["camera"] == mode and row["drive"] not in EXTRA and "refused" not in row
        ]
        if not part:
            continue
        summary: dict[str, object] = {"camera": mode, "mapped": len(part)}
        for key in part[0]:
            values = [row[key] for row in part if isinstance(row[key], float)]
            if values:
                worst = min(values) if key == "labelled" else max(values, key=abs)
                summary[key] = [round(float(np.median(values)), 3), worst]
        sys.stdout.write(json.dumps({"median, worst": summary}) + "\n")


if __name__ == "__main__":
    main()
