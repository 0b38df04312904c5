"""Maps of drives that are hard to map, against their truth: ``make traps``.

Simulated drives of one kind, see :mod:`trap_drives`; of ``roads`` sixty, half of them with the camera found
from the drive. A row per drive is printed and kept in the table as soon as it is known: a run that was killed
goes on where it stopped. At the end: maps that are called good or usable with wrong labels (there should be
none), how many are good, and how far errors of focal length, pitch and height keep within their sigmas.
"""

from __future__ import annotations

import argparse
import csv
import math
import shutil
import sys
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from scipy.spatial import cKDTree
from trap_drives import KINDS, TrapDrive, beyond_lines, drive_settings

from datagen.labels.truth import true_lines
from datagen.pipeline import MapRequest, map_drive
from datagen.settings import MapSettings
from datagen.slam import track
from datagen.slam.filter.dp_slam import Trajectory
from datagen.slam.filter.motion import MotionModel
from datagen.slam.odometry.odometry import Odometry
from datagen.slam.odometry.scans import Scans
from datagen.world.road.track import read_track
from lanenet.data.drives import read_truth
from lanenet.data.maps.folder import read_map
from lanenet.data.maps.mapped_drive import read_map_frames
from lanenet.errors import LanenetError
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.camera import Camera
from lanenet.geometry.frames import map_from_car
from lanenet.geometry.lane import POINT_NAMES, ROWS_CM, SIDES

__all__ = ["SEED", "drive_settings"]

#: The seed by which the mapping was developed: figures of other seeds count.
SEED = 77_000
#: Labels beyond these are wrong: RMSE over all points, and the RMSE of one point over any stretch of one lap.
MAX_RMSE_CM, MAX_STRETCH_CM, STRETCH_CM = 1.0, 3.0, 30.0
#: A label further than this from any paint is beside it.
BESIDE_PAINT_CM = 1.0
COLUMNS = (
    "drive", "trap", "camera", "told", "verdict", "state", "frames", "mapped", "labelled", "labels", "off_3",
    "rmse_cm", "worst_cm", "worst_at_cm", "bias_cm", "beside_paint", "revisits", "segments", "closed",
    "pose_worst_cm", "pose_worst_lanes", "focal_error", "focal_sigma", "pitch_error_deg", "pitch_sigma_deg",
    "height_error", "height_sigma", "cpu_s", "reason",
)  # fmt: skip


def label_errors(folder: Path, drive: Path, wheelbase_cm: float) -> dict[str, Any]:
    """Compare a map's labels with the truth.

    Returns:
        Share of the labelled points, RMSE, and the worst RMSE of one point over a stretch of one lap with the
        place along the drive, [cm]; and the largest mean error of a row, of its left and right point.
    """
    truth = read_truth(drive)
    assert truth is not None
    index = read_map(folder).frames
    true_points = np.stack([truth[point] for point in POINT_NAMES], axis=1)
    true_points = np.array([BirdseyeWindow().labelled(points) for points in true_points])
    true_points[true_lines(drive, truth, wheelbase_cm)[1] | beyond_lines(true_points)] = np.nan
    miss_cm = np.full_like(true_points, np.nan)
    miss_cm[index] = read_map_frames(folder).points_cm - true_points[index]
    xy = np.stack([truth["x_cm"], truth["y_cm"]], axis=1)
    way_cm = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(xy, axis=0).T))])
    worst_cm, worst_at_cm = 0.0, 0.0
    for start_cm in np.arange(0.0, way_cm[-1], 0.5 * STRETCH_CM):
        part = miss_cm[(way_cm >= start_cm) & (way_cm < start_cm + STRETCH_CM)]
        seen = np.isfinite(part).sum(axis=0)
        rms = np.sqrt(np.nansum(part**2, axis=0) / np.maximum(seen, 1))
        rms[seen < 3] = 0.0
        if rms.max(initial=0.0) > worst_cm:
            worst_cm, worst_at_cm = float(rms.max()), float(start_cm)
    known = np.isfinite(miss_cm)
    mean_cm = np.abs(np.nansum(miss_cm, axis=0) / np.maximum(known.sum(axis=0), 1))
    return {
        "mapped": len(index),
        "labelled": round(float(known.sum() / max(np.isfinite(true_points).sum(), 1)), 3),
        "off_3": int((np.abs(miss_cm[known]) > 3.0).sum()),
        "labels": int(known.sum()),
        "rmse_cm": round(float(np.sqrt(np.mean(miss_cm[known] ** 2))), 3) if known.any() else None,
        "worst_cm": round(worst_cm, 2),
        "worst_at_cm": round(worst_at_cm),
        "bias_cm": round(float(mean_cm.reshape(len(SIDES), len(ROWS_CM)).mean(axis=0).max()), 3),
    }


def beside_paint(folder: Path, drive: Path, camera: Camera) -> float | None:
    """Share of the labels that lie beside all lines of the road, in the images.

    A label's pixel is taken back to the ground by the true camera: what a map in another scale labels is
    judged like any other. Gaps between dashes count as paint.

    Returns:
        None without labels, or on a road whose lines are not along its track.
    """
    truth, road, frames = read_truth(drive), read_track(drive / "track.json"), read_map_frames(folder)
    assert truth is not None
    index = read_map(folder).frames
    ahead_cm = np.broadcast_to(np.tile(np.array(ROWS_CM), len(SIDES)), frames.points_cm.shape)
    points_cm = np.stack([frames.points_cm, ahead_cm], axis=2)
    lines = [road.line_beside(0.0, road.length_cm, m.offset_cm) for m in road.markings]
    if not lines or not np.isfinite(frames.points_cm).any():
        return None
    beside, total = 0, 0
    trees = [(cKDTree(line), 0.5 * m.width_cm) for line, m in zip(lines, road.markings, strict=True)]
    for k, points in zip(index, points_cm, strict=True):
        seen = points[np.isfinite(points).all(axis=1)]
        seen = camera.intersect_ground(frames.camera.project_ground(seen))
        seen = seen[np.isfinite(seen).all(axis=1)]
        pose = np.array([truth[name][k] for name in ("x_cm", "y_cm", "heading_rad")])
        places = map_from_car(seen, pose, camera.wheelbase_cm)
        off_cm = [np.maximum(tree.query(places)[0] - half_cm, 0.0) for tree, half_cm in trees]
        beside += int((np.min(off_cm, axis=0) > BESIDE_PAINT_CM).sum())
        total += len(seen)
    return round(beside / max(total, 1), 4)


def pose_error_cm(folder: Path, drive: Path, scaled: bool) -> float:
    """Worst distance of a mapped pose from its true place, each segment laid over the truth as a whole.

    Args:
        folder: The map.
        drive: The drive with its truth.
        scaled: Whether a segment may be stretched as well, since its scale is not known.
    """
    drive_map, truth = read_map(folder), read_truth(drive)
    assert truth is not None
    true = truth["x_cm"] + 1j * truth["y_cm"]
    worst_cm = 0.0
    for segment in np.unique(drive_map.segment):
        rows = drive_map.segment == segment
        # As complex numbers, whose product turns and stretches: least squares in one line.
        mapped, place = drive_map.poses[rows] @ np.array([1.0, 1j, 0.0]), true[drive_map.frames[rows]]
        mapped, place = mapped - mapped.mean(), place - place.mean()
        turn = np.vdot(mapped, place) / np.vdot(mapped, mapped).real
        off_cm = np.abs(place - mapped * (turn if scaled else turn / abs(turn)))
        worst_cm = max(worst_cm, float(off_cm.max()))
    return worst_cm


def camera_errors(found: Camera, true: Camera, sigma: dict[str, float]) -> dict[str, Any]:
    """Errors of a camera that was found from a drive, and their sigmas as far as they are known."""
    pitch_rad = found.mounting.pitch_down_rad - true.mounting.pitch_down_rad
    height = math.log(found.mounting.height_cm / true.mounting.height_cm)
    return {
        "focal_error": round(math.log(found.K[0, 0] / true.K[0, 0]), 4),
        "focal_sigma": round(sigma["focal"], 4),
        "pitch_error_deg": round(math.degrees(pitch_rad), 3),
        "pitch_sigma_deg": round(math.degrees(sigma["pitch"]), 3),
        "height_error": round(height, 4),
        "height_sigma": round(sigma["height"], 4) if "height" in sigma else "",
    }


def simulated(drive: TrapDrive, folder: Path, number: int) -> tuple[Path, Path]:
    """Simulate a drive if it is not there yet; return it, and what of it is mapped."""
    path = folder / f"{number:03d}_{drive.trap}"
    blind = path.with_name(f"{path.name}_blind")
    if not (path / "truth.csv").exists():
        drive.write(path)
    if not (drive.known or blind.exists()):
        shutil.copytree(path, blind)
        (blind / "drive.yaml").unlink()
        (blind / "camera.yaml").unlink()
    return path, path if drive.known else blind


def odometry_alone(scans: Scans, motion: MotionModel, *_: Any) -> Trajectory:
    """Stand in for ``run_filter`` of :mod:`datagen.slam.track`: add up the odometry's steps."""
    n = len(scans)
    steps = Odometry(motion.distance_cm, motion.curvature_per_cm * motion.distance_cm)
    return Trajectory(steps.poses, np.ones(n), np.full(n, np.nan), np.zeros(n))


def judge(kind: str, number: int, folder: Path, seed: int, filtered: bool = True) -> dict[str, Any]:
    """Simulate a drive if it is not there yet, map it, with or without filter, and compare with its truth."""
    if not filtered:
        patch.object(track, "run_filter", odometry_alone).start()
    made = KINDS[kind].make(number, seed)
    wheelbase_cm, lane_cm = made.settings.car.wheelbase_cm, made.settings.track.lane_width_cm
    drive, source = simulated(made, folder, number)
    out = drive.with_name(f"{drive.name}_map")
    row: dict[str, Any] = {"drive": number, "trap": made.trap, "camera": "known" if made.known else "found"}
    start = time.process_time()
    map_settings = MapSettings.model_validate({"guess": {"wheelbase_cm": wheelbase_cm}})
    truth = read_truth(drive)
    assert truth is not None
    row |= {"told": made.told, "frames": len(truth["x_cm"])}
    try:
        report = map_drive(MapRequest(source, made.told_cm), map_settings, out)
    except LanenetError as error:
        return row | {
            "verdict": "refused",
            "cpu_s": round(time.process_time() - start, 1),
            "reason": str(error),
        }
    row["cpu_s"] = round(time.process_time() - start, 1)
    row |= {"verdict": report.figures["verdict"]["grade"], "state": report.figures["verdict"]["state"]}
    row["reason"] = "; ".join(report.figures["verdict"]["reasons"])
    true_camera = made.settings.camera.build(wheelbase_cm)
    row |= label_errors(out, drive, wheelbase_cm)
    row["beside_paint"] = beside_paint(out, drive, true_camera)
    segments = report.figures["segments_mapped"]
    row["revisits"] = sum(segment["revisits"] for segment in segments)
    row |= {"segments": len(segments), "closed": sum(segment["closed"] for segment in segments)}
    worst_cm = pose_error_cm(out, drive, scaled=not made.known)
    row |= {"pose_worst_cm": round(worst_cm, 1), "pose_worst_lanes": round(worst_cm / lane_cm, 2)}
    if not made.known:
        row |= camera_errors(read_map(out).camera, true_camera, report.figures["calibration"]["sigma"])
    return row


def is_wrong(row: dict[str, Any]) -> bool:
    """Whether a map that passes for good or usable has labels that are not."""
    if row["verdict"] not in ("good", "usable") or row["rmse_cm"] in ("", None):
        return False
    return float(row["rmse_cm"]) > MAX_RMSE_CM or float(row["worst_cm"]) > MAX_STRETCH_CM


def summary(rows: list[dict[str, Any]]) -> str:
    """Say what the table shows."""
    lines = []
    for row in filter(is_wrong, rows):
        lines.append(
            f"FOOLED: {row['drive']} ({row['trap']}, camera {row['camera']}) is {row['verdict']}, RMSE "
            f"{row['rmse_cm']} cm, worst stretch {row['worst_cm']} cm at {row['worst_at_cm']} cm"
        )
    grades = [row["verdict"] for row in rows]
    counts = ", ".join(f"{grades.count(grade)} {grade}" for grade in ("good", "usable", "reject", "refused"))
    lines.append(f"{len(rows)} drives: {counts}; {sum(map(is_wrong, rows))} good or usable and wrong")
    for name in ("focal", "pitch", "height"):
        unit = "_deg" if name == "pitch" else ""
        pairs = [(row.get(f"{name}_error{unit}"), row.get(f"{name}_sigma{unit}")) for row in rows]
        off = np.array([float(e) / float(s) for e, s in pairs if e not in ("", None) and s not in ("", None)])
        if off.size:
            held = int((np.abs(off) <= 2.0).sum())
            lines.append(
                f"{name}: {held} of {off.size} within 2 sigma, RMS {np.sqrt(np.mean(off**2)):.2f} sigma"
            )
    return "\n".join(lines)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, required=True, help="drives, maps and the table are kept here")
    parser.add_argument("--kind", choices=KINDS, default="roads", help="another kind needs another folder")
    parser.add_argument("--drives", help="first:last, or numbers with commas; all of the kind if left out")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument(
        "--without-filter", action="store_true", help="track by odometry alone; needs another folder"
    )
    parser.add_argument(
        "--seed", type=int, default=SEED, help="of drive 0; another seed needs another folder"
    )
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    table = args.folder / "traps.csv"
    rows: list[dict[str, Any]] = []
    if table.exists():
        with table.open(newline="") as file:
            rows = list(csv.DictReader(file))
    columns = list(rows[0]) if rows else list(COLUMNS)  # those of an earlier version
    first, _, last = (args.drives or f"0:{KINDS[args.kind].drives}").partition(":")
    numbers = range(int(first), int(last)) if last else [int(n) for n in first.split(",")]
    done = {int(row["drive"]) for row in rows}
    with ProcessPoolExecutor(args.processes) as pool:
        for job in as_completed(
            [
                pool.submit(judge, args.kind, n, args.folder, args.seed, not args.without_filter)
                for n in numbers
                if n not in done
            ]
        ):
            rows.append(dict.fromkeys(COLUMNS, "") | job.result())
            with table.open("a", newline="") as file:
                writer = csv.DictWriter(file, columns, extrasaction="ignore")
                if not file.tell():
                    writer.writeheader()
                writer.writerow(rows[-1])
            sys.stdout.write(" ".join(str(rows[-1][name]) for name in COLUMNS) + "\n")
            sys.stdout.flush()
    sys.stdout.write(summary([row for row in rows if int(row["drive"]) in set(numbers)]) + "\n")


if __name__ == "__main__":
    main()
