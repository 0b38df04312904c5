"""The paper's likelihood beside the directional one: ``python tests/bench/bench_likelihood.py MAP...``.

Each map is of a drive that goes around more than once. Its camera and settings are taken, and the particle
filter alone is run with either likelihood, with the gains of speed and steering known and nothing else of the
odometry: how far the open loop has drifted when the car comes back to a
place, against the truth of a simulated drive, or against the closed map of a real one. With ``--remap
FOLDER`` the whole mapping is run as well, with the map's camera as known: does it close, and how well do
frames agree with it that had no say in its lines. Prints JSON, a line per drive and likelihood.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from datagen.localise.live_filter import live_motion
from datagen.pipeline import MapRequest, map_drive
from datagen.settings import MapSettings
from datagen.slam.commands import commands_of, fit_steering
from datagen.slam.filter.dp_slam import Trajectory, run_filter
from datagen.slam.odometry.image_pairs import ImagePairs
from datagen.slam.odometry.odometry import Evidence, typical_step
from datagen.slam.view import view_road
from lanenet.config import load_settings
from lanenet.data.drives import read_truth
from lanenet.data.maps.folder import SETTINGS_NAME
from lanenet.data.maps.mapped_drive import MappedDrive, open_mapped_drive
from lanenet.errors import LanenetError
from lanenet.geometry.frames import wrap_angle
from lanenet.geometry.poses import path_lengths

LIKELIHOODS = ("direction", "count")
#: What counts as the same place: least way between the visits, most distance [camera heights], heading [rad].
LEAST_WAY, MOST_APART, MOST_TURNED = 20.0, 2.0, 0.5


def longest_segment(mapped: MappedDrive) -> np.ndarray:
    """Rows of the map that belong to its longest segment."""
    segment = mapped.drive_map.segment
    return np.flatnonzero(segment == np.bincount(segment).argmax())


def reference_poses(mapped: MappedDrive, rows: np.ndarray) -> tuple[str, np.ndarray]:
    """True poses of a simulated drive; poses of the closed map of a real one."""
    drive_map = mapped.drive_map
    truth = read_truth(mapped.drive.path) if mapped.drive.path.is_dir() else None
    if truth is None:
        return "map", drive_map.poses[rows]
    at = np.searchsorted(truth["frame"], drive_map.frames[rows])
    return "truth", np.stack([truth["x_cm"], truth["y_cm"], truth["heading_rad"]], axis=1)[at]


def visits(poses: np.ndarray, height_cm: float) -> list[tuple[int, int]]:
    """Pairs of frames at one place, a lap apart, as the reference has them."""
    path = path_lengths(poses)
    pairs = []
    for i in range(0, len(poses), 5):
        apart = np.hypot(*(poses[:, :2] - poses[i, :2]).T)
        turned = np.abs(wrap_angle(poses[:, 2] - poses[i, 2]))
        same = (path - path[i] > LEAST_WAY * height_cm) & (apart < MOST_APART * height_cm)
        found = np.flatnonzero(same & (turned < MOST_TURNED))
        if found.size:
            # The first return: up to where the frames leave the place again.
            leaves = np.flatnonzero(np.diff(found) > 1)
            first = found[: leaves[0] + 1] if leaves.size else found
            pairs.append((i, int(first[np.argmin(apart[first])])))
    return pairs


def between(poses: np.ndarray, pairs: list[tuple[int, int]]) -> np.ndarray:
    """Pose of the later frame of each pair as seen from the earlier: ahead, left, heading (unwrapped)."""
    a, b = (poses[list(side)] for side in zip(*pairs, strict=True))
    c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
    dx, dy = (b - a)[:, :2].T
    return np.stack([c * dx + s * dy, -s * dx + c * dy, b[:, 2] - a[:, 2]], axis=1)


def filtered(mapped: MappedDrive, rows: np.ndarray, settings: MapSettings) -> tuple[Trajectory, float]:
    """Run the filter alone over the frames of the map; its trajectory, and processor time per frame, [ms]."""
    drive, camera = mapped.drive.subset(mapped.rows[rows]), mapped.drive_map.camera
    road = view_road(drive, camera, settings)
    scans = road.scans(camera)
    commands, height = commands_of(drive, camera.wheelbase_cm), camera.mounting.height_cm
    rng = np.random.default_rng(settings.seed)
    pictures = ImagePairs(road.edges, camera, settings.odometry, rng)
    typical = typical_step(pictures, commands.distance_cm, commands.speed_known)
    evidence = Evidence(pictures, typical)
    fit = fit_steering(evidence.motion().poses, commands, height)
    predicted = None
    if fit is not None and commands.turn is not None:
        predicted = fit.curvature_per_cm(commands.turn)
    motion = live_motion(commands, predicted, typical.factor, height)
    begun = time.process_time()
    trajectory = run_filter(scans, motion, settings.filter, height, camera.wheelbase_cm, rng)
    return trajectory, 1e3 * (time.process_time() - begun) / len(drive)


def measure(folder: Path, likelihood: str, remap: Path | None) -> dict[str, Any]:
    """Measure one drive with one likelihood."""
    mapped = open_mapped_drive(folder)
    settings = load_settings(MapSettings, folder / SETTINGS_NAME, [f"filter.likelihood={likelihood}"])
    rows = longest_segment(mapped)
    kind, truth = reference_poses(mapped, rows)
    height = mapped.drive_map.camera.mounting.height_cm
    pairs = visits(truth, height)
    trajectory, cpu_ms = filtered(mapped, rows, settings)
    row: dict[str, Any] = {"drive": mapped.drive.name, "likelihood": likelihood, "against": kind}
    row |= {"frames": len(rows), "matched_share": round(float(np.nanmean(trajectory.match)), 3)}
    way, true_way = (float(path_lengths(poses)[-1]) for poses in (trajectory.poses, truth))
    row["way_ratio"] = round(way / true_way, 3)
    if pairs:
        miss = between(trajectory.poses, pairs) - between(truth, pairs)
        apart = np.hypot(miss[:, 0], miss[:, 1]) / height
        row["drift_heights_per_lap"] = round(float(np.median(apart)), 2)
        row["drift_deg_per_lap"] = round(float(np.degrees(np.median(miss[:, 2]))), 1)
    row["cpu_ms_per_frame"] = round(cpu_ms, 2)
    if remap is not None:
        row |= remapped(mapped, folder, settings, remap / f"{mapped.drive.name}_{likelihood}")
    return row


def remapped(mapped: MappedDrive, folder: Path, settings: MapSettings, out: Path) -> dict[str, Any]:
    """Run the whole mapping, with the map's camera as known."""
    width_cm = mapped.drive_map.meta.mapped_lane_cm
    try:
        figures = map_drive(
            MapRequest(mapped.drive.path, width_cm, folder / "camera.yaml"), settings, out
        ).figures
    except LanenetError as error:
        return {"refused": str(error)}
    return {
        "revisits": sum(segment["revisits"] for segment in figures["segments_mapped"]),
        "closed": all(segment["closed"] for segment in figures["segments_mapped"]),
        "held_out": figures["held_out"],
        "labelled_share": round(figures["labels"]["labelled"] / figures["labels"]["frames"], 3),
        "verdict": figures["verdict"]["grade"],
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("maps", type=Path, nargs="+", help="folders of maps, of drives of more than a lap")
    parser.add_argument("--remap", type=Path, help="map again with each likelihood, into this folder")
    args = parser.parse_args()
    for folder in args.maps:
        for likelihood in LIKELIHOODS:
            sys.stdout.write(json.dumps(measure(folder, likelihood, args.remap)) + "\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
