"""Maps of drives that are hard to map, against their truth: ``make traps``.

Sixty simulated drives, six of each kind of trap: corners that are all alike, parallel straights of one look,
a figure of eight, throttle pulses, pauses, kinks, a lane that widens in bends, dark tape, wide tape, and all
sorts together; half of them with the camera found from the drive. A row per drive is printed and kept in the
table as soon as it is known: a run that was killed goes on where it stopped. At the end: maps that are called
good or usable with wrong labels (there should be none), how many are good, and how far errors of focal length
and pitch keep within their sigmas.
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

import numpy as np

from datagen.labels.truth import true_lines
from datagen.pipeline import MapRequest, map_drive
from datagen.settings import MapSettings
from datagen.world.simulate import simulate_drive
from datagen.world.world import SimulationSettings
from lanenet.data.drives import read_truth
from lanenet.data.maps.folder import read_map
from lanenet.data.maps.mapped_drive import read_map_frames
from lanenet.errors import LanenetError
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.lane import POINT_NAMES

TRAPS = ("corners", "straights", "eight", "pulses", "pauses", "kinks", "widening", "dark", "wide", "mixed")
#: The seed by which the mapping was developed: figures of other seeds count.
SEED = 77_000
SPEED_CM_S, RATE_HZ, LAPS = 70.0, 20.0, 2.1
#: Labels beyond these are wrong: RMSE over all points, and the RMSE of one point over any stretch of one lap.
MAX_RMSE_CM, MAX_STRETCH_CM, STRETCH_CM = 1.0, 3.0, 30.0
COLUMNS = (
    "drive", "trap", "camera", "verdict", "frames", "mapped", "labelled", "rmse_cm", "worst_cm",
    "worst_at_cm", "revisits", "focal_error", "focal_sigma", "pitch_error_deg", "pitch_sigma_deg", "cpu_s",
    "reason",
)  # fmt: skip


def loop(corners: int, straights_cm: list[float], radius_cm: float | None) -> dict[str, Any]:
    """Pieces of a loop of like corners, with these straights in turn; kinks if there is no radius."""
    angle_deg = 360.0 / corners
    corner: dict[str, Any] = {"kink": {"angle_deg": angle_deg, "direction": "left"}}
    if radius_cm is not None:
        corner = {"arc": {"radius_cm": radius_cm, "angle_deg": angle_deg, "direction": "left"}}
    pieces: list[dict[str, Any]] = []
    for k in range(corners):
        pieces += [{"straight": {"length_cm": straights_cm[k % len(straights_cm)]}}, corner]
    return {"pieces": pieces}


def eight(radius_cm: float) -> dict[str, Any]:
    """Pieces of a figure of eight that crosses itself at a right angle."""
    half: list[dict[str, Any]] = []
    for direction in ("left", "right"):
        half.append({"straight": {"length_cm": 2.0 * radius_cm}})
        half.append({"arc": {"radius_cm": radius_cm, "angle_deg": 270.0, "direction": direction}})
    return {"pieces": half, "crosses": True}


def road(trap: str, rng: np.random.Generator) -> dict[str, Any]:
    """A road of one lane with a trap."""
    lane_cm, radius_cm = float(rng.uniform(30.0, 50.0)), float(rng.uniform(55.0, 70.0))
    made: dict[str, Any] = {
        "lane_width_cm": lane_cm,
        "line_width_cm": float(rng.uniform(6.0, 9.0) if trap == "wide" else rng.uniform(1.8, 5.0)),
        "min_radius_cm": radius_cm,
        "closed": True,
        "length_cm": float(rng.uniform(750.0, 950.0)),
        "interruptions_per_m": 0.05,
    }
    dashed = {"kind": "dashed" if rng.random() < 0.3 else "solid", "dash_cm": 18.0, "gap_cm": 14.0}
    made |= {"left": dashed, "right": {"kind": "solid"}}
    straight_cm = float(rng.uniform(70.0, 130.0))
    number, long_cm = int(rng.integers(3, 6)), float(rng.uniform(220.0, 280.0))
    if trap in ("corners", "mixed"):
        made |= loop(number, [straight_cm], radius_cm)
    elif trap == "straights":
        made |= loop(4, [long_cm, 0.3 * straight_cm], radius_cm)
    elif trap == "eight":
        made |= eight(1.3 * radius_cm)
    elif trap == "kinks":
        # Kinks of 45, 60 and 90 degrees.
        made |= loop({3: 8, 4: 6, 5: 4}[number], [270.0 - 35.0 * (8 - number), straight_cm], None)
    elif trap == "widening":
        made |= loop(4, [straight_cm, 1.4 * straight_cm], radius_cm) | {
            "widening": float(rng.uniform(0.15, 0.4))
        }
        made["left"] = {"kind": "solid"}
    if "pieces" in made:
        del made["length_cm"]
    if trap == "dark" or (trap == "mixed" and number > 3):
        made["left"], made["right"] = made["left"] | {"colour": "black"}, {"kind": "solid", "colour": "black"}
        made["floor_bgr"] = tuple(float(rng.uniform(150.0, 210.0)) for _ in range(3))
    return made


def drive_settings(number: int, seed: int) -> tuple[SimulationSettings, str, bool]:
    """Settings of one drive, its trap, and whether the camera is known."""
    rng = np.random.default_rng(seed + number)
    trap = TRAPS[number % len(TRAPS)]
    track = road(trap, rng)
    speed_cm_s = SPEED_CM_S * float(rng.uniform(0.8, 1.2))
    gain = float(rng.uniform(0.85, 1.1))
    gaps = {"pulses": "pulses", "pauses": "pauses", "mixed": ("pulses", "pauses")[number // 10 % 2]}.get(
        trap, "none"
    )
    laps = LAPS * (1.6 if gaps != "none" else 1.0)
    settings = {
        "seed": seed + number,
        "rate_hz": RATE_HZ,
        "camera": {
            "width": 160, "height": 120,
            "field_of_view_rad": math.radians(float(rng.uniform(110.0, 150.0))),
            "height_cm": float(rng.uniform(14.0, 22.0)),
            "pitch_down_rad": math.radians(float(rng.uniform(13.0, 25.0))),
            "roll_rad": float(rng.normal(0.0, 0.012)), "yaw_rad": float(rng.normal(0.0, 0.02)),
            "distortion": (float(rng.uniform(-0.05, 0.01)), 0.0, 0.0, 0.0),
        },
        "track": track,
        "car": {
            "wheelbase_cm": float(rng.uniform(16.0, 22.0)),
            "steering_gain": float(rng.uniform(0.85, 1.1)),
            "steering_trim_rad": float(rng.uniform(-0.03, 0.03)),
            "max_steering_rad": 0.6,
            "speed_gain": gain,
        },
        "driver": {
            "speed_cm_s": speed_cm_s,
            "speed_variation": float(rng.uniform(0.0, 0.2)),
            "wander_cm": 0.12 * track["lane_width_cm"],
            "direction": "backward" if rng.random() < 0.5 else "forward",
        },
        "recording": "donkeycar" if gaps != "none" or number % 2 else "commands",
        "gaps": gaps,
        "angles": "bang" if gaps == "pulses" else "all",
    }  # fmt: skip
    draft = SimulationSettings.model_validate(settings)
    length_cm = draft.track.length_cm or 0.0
    frames = int(laps * length_cm / (speed_cm_s * gain / RATE_HZ))
    return draft.model_copy(update={"frames": frames}), trap, number // len(TRAPS) % 2 == 0


def label_errors(folder: Path, drive: Path, wheelbase_cm: float) -> dict[str, Any]:
    """Compare a map's labels with the truth.

    Returns:
        Share of the labelled points, RMSE, and the worst RMSE of one point over a stretch of one lap with the
        place along the drive, [cm].
    """
    truth = read_truth(drive)
    assert truth is not None
    index = read_map(folder).frames
    true_points = np.stack([truth[point] for point in POINT_NAMES], axis=1)
    true_points = np.array([BirdseyeWindow().labelled(points) for points in true_points])
    true_points[true_lines(drive, truth, wheelbase_cm)[1]] = np.nan
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
    return {
        "mapped": len(index),
        "labelled": round(float(known.sum() / max(np.isfinite(true_points).sum(), 1)), 3),
        "rmse_cm": round(float(np.sqrt(np.mean(miss_cm[known] ** 2))), 3) if known.any() else None,
        "worst_cm": round(worst_cm, 2),
        "worst_at_cm": round(worst_at_cm),
    }


def judge(number: int, folder: Path, seed: int) -> dict[str, Any]:
    """Simulate a drive if it is not there yet, map it, and compare with its truth."""
    settings, trap, known = drive_settings(number, seed)
    drive = folder / f"{number:03d}_{trap}"
    if not (drive / "truth.csv").exists():
        simulate_drive(settings, drive)
        if not known:
            shutil.copytree(drive, blind := drive.with_name(f"{drive.name}_blind"))
            (blind / "drive.yaml").unlink()
            (blind / "camera.yaml").unlink()
    source = drive if known else drive.with_name(f"{drive.name}_blind")
    out = drive.with_name(f"{drive.name}_map")
    row: dict[str, Any] = {"drive": number, "trap": trap, "camera": "known" if known else "found"}
    start = time.process_time()
    map_settings = MapSettings.model_validate({"guess": {"wheelbase_cm": settings.car.wheelbase_cm}})
    truth = read_truth(drive)
    assert truth is not None
    row["frames"] = len(truth["x_cm"])
    try:
        report = map_drive(MapRequest(source, settings.track.lane_width_cm), map_settings, out)
    except LanenetError as error:
        return row | {
            "verdict": "refused",
            "cpu_s": round(time.process_time() - start, 1),
            "reason": str(error),
        }
    row["cpu_s"] = round(time.process_time() - start, 1)
    row["verdict"] = report.figures["verdict"]["grade"]
    row["reason"] = "; ".join(report.figures["verdict"]["reasons"])
    row |= label_errors(out, drive, settings.car.wheelbase_cm)
    row["revisits"] = sum(segment["revisits"] for segment in report.figures["segments_mapped"])
    if not known:
        found, true = read_map(out).camera, settings.camera.build(settings.car.wheelbase_cm)
        sigma = report.figures["calibration"]["sigma"]
        row["focal_error"] = round(math.log(found.K[0, 0] / true.K[0, 0]), 4)
        row["focal_sigma"] = round(sigma["focal"], 4)
        pitch_rad = found.mounting.pitch_down_rad - true.mounting.pitch_down_rad
        row["pitch_error_deg"] = round(math.degrees(pitch_rad), 3)
        row["pitch_sigma_deg"] = round(math.degrees(sigma["pitch"]), 3)
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
    for name in ("focal", "pitch"):
        unit = "_deg" if name == "pitch" else ""
        pairs = [(row[f"{name}_error{unit}"], row[f"{name}_sigma{unit}"]) for row in rows]
        off = np.array([float(e) / float(s) for e, s in pairs if e not in ("", None)])
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
    parser.add_argument("--drives", default="0:60", help="first:last, or numbers with commas")
    parser.add_argument("--processes", type=int, default=1)
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
    first, _, last = args.drives.partition(":")
    numbers = range(int(first), int(last)) if last else [int(n) for n in first.split(",")]
    done = {int(row["drive"]) for row in rows}
    with ProcessPoolExecutor(args.processes) as pool:
        for job in as_completed(
            [pool.submit(judge, n, args.folder, args.seed) for n in numbers if n not in done]
        ):
            rows.append(dict.fromkeys(COLUMNS, "") | job.result())
            with table.open("a", newline="") as file:
                writer = csv.DictWriter(file, COLUMNS)
                if not file.tell():
                    writer.writeheader()
                writer.writerow(rows[-1])
            sys.stdout.write(" ".join(str(rows[-1][name]) for name in COLUMNS) + "\n")
            sys.stdout.flush()
    sys.stdout.write(summary([row for row in rows if int(row["drive"]) in set(numbers)]) + "\n")


if __name__ == "__main__":
    main()
