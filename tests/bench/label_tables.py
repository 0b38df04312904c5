"""Tables of labels with their features and true errors, from the maps of trap drives.

Takes a folder of ``bench_traps.py`` and writes ``NNN_KIND.npz`` for each map in it: a row for every label
that the map's lines give in the bird's-eye window, also where today's rules withhold it. Maps that have a
table are skipped. Labels whose line the truth does not see at that row have no error, and are left out.
"""

from __future__ import annotations

import argparse
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from trap_drives import beyond_lines

from datagen.labels.truth import true_lines
from datagen.quality.evidence import label_features
from lanenet.data.drives import open_drive, read_truth
from lanenet.data.maps.folder import DriveMap, verdict_of
from lanenet.data.maps.line import LaneLine
from lanenet.data.maps.mapped_drive import MappedDrive, label_frames, lines_at, open_mapped_drive
from lanenet.errors import MapFormatError
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.lane import POINT_NAMES, ROWS_CM
from lanenet.geometry.poses import compose
from lanenet.reading import read_json

#: Seed of the first spoilt copy.
SPOILT_SEED = 42_000


def projected(drive_map: DriveMap) -> Float[np.ndarray, "n 6"]:
    """Labels of all frames where nothing is withheld, whatever the sigma of their lines."""
    # Without the sigma ahead, lines are given up to the steepest that any map labels.
    meta = drive_map.meta.model_copy(update={"ahead_sigma_cm": 0.0})
    bare = replace(drive_map.without_doubts(), meta=meta)
    return np.array([lines_at(bare, k, np.inf).points_cm for k in range(len(bare.frames))])


def label_table(mapped: MappedDrive, map_folder: Path, drive_path: Path) -> dict[str, Any]:
    """Columns of one map's table, and what holds for all of its labels."""
    drive_map, window = mapped.drive_map, BirdseyeWindow()
    drive, truth = open_drive(drive_path), read_truth(drive_path)
    assert truth is not None and drive.camera is not None
    rows = np.searchsorted(drive.frames, drive_map.frames)
    between = true_lines(drive_path, truth, drive.camera.wheelbase_cm)[1][rows]
    points_cm = window.labelled(projected(drive_map))
    true_cm = np.stack([truth[name] for name in POINT_NAMES], axis=1)[rows]
    error_cm = points_cm - true_cm
    error_cm[
        between | beyond_lines(true_cm) | drive_map.lanes.between | mapped.drive.deleted[mapped.rows]
    ] = np.nan
    features = label_features(mapped, read_json(map_folder / "report.json", MapFormatError))
    frame, point = np.nonzero(np.isfinite(error_cm))
    at = frame, point
    today = label_frames(mapped, window).points_cm
    number, _, trap = drive_path.name.partition("_")
    return {
        "names": np.array(features.names),
        "features": features.values[at],
        "error_cm": error_cm[at].astype(np.float32),
        "frame": drive_map.frames[frame],
        "side": point // len(ROWS_CM),
        "row": point % len(ROWS_CM),
        "withheld": ~np.isfinite(today[at]),
        "off_1": drive_map.errors.off_1[at],
        "off_3": drive_map.errors.off_3[at],
        "trap": np.array(trap),
        "drive": np.array(int(number)),
        "camera": np.array("found" if mapped.drive.path.name.endswith("_blind") else "known"),
        "verdict": np.array(verdict_of(map_folder).grade),
    }


def spoilt(mapped: MappedDrive, seed: int) -> MappedDrive:
    """The map with poses of some runs of frames moved, and half of its lines bent in one place.

    Maps are seldom wrong; a model of errors needs more of them. The poses move as they do behind a pause of
    the recording: all alike, or fading out; the lines by up to 6 cm over 30 to 120 cm.
    """
    rng, drive_map = np.random.default_rng(seed), mapped.drive_map
    poses, n = drive_map.poses.copy(), len(drive_map.poses)
    step_s = np.diff(drive_map.t_s)
    gaps = [*(np.flatnonzero(step_s > 1.5 * np.median(step_s)) + 1).tolist(), n]
    for _ in range(int(rng.integers(2, 5))):
        first = int(rng.integers(0, max(n - 12, 1)))
        last = min(n, first + int(rng.integers(8, 50)))
        if len(gaps) > 3 and rng.random() < 0.7:
            number = int(rng.integers(len(gaps) - 1))
            first, last = gaps[number], gaps[number + 1]
        fading = np.linspace(1.0, 0.2 if rng.random() < 0.5 else 1.0, last - first)
        if rng.random() < 0.3:
            fading = fading[::-1]
        moved = np.array([3.0, 1.2, 0.04]) * rng.normal(size=3) * rng.choice([0.4, 1.0, 1.8])
        poses[first:last] = compose(poses[first:last], fading[:, None] * moved)
    lines = {
        segment: [bent(line, rng) if line.rank == 0 and rng.random() < 0.5 else line for line in found]
        for segment, found in drive_map.lines.items()
    }
    return replace(mapped, drive_map=replace(drive_map, poses=poses, lines=lines))


def bent(line: LaneLine, rng: np.random.Generator) -> LaneLine:
    """The line with a bulge to one side."""
    low, high = line.span_cm
    at_cm, half_cm = rng.uniform(low, high), rng.uniform(15.0, 60.0)
    # A control point acts around the middle of its inner knots.
    middle_cm = np.array([line.knots_cm[i + 1 : i + 4].mean() for i in range(len(line.coefficients_cm))])
    off_cm = middle_cm - at_cm
    if line.period_cm is not None:
        off_cm = (off_cm + 0.5 * line.period_cm) % line.period_cm - 0.5 * line.period_cm
    bulge_cm = rng.choice([-1.0, 1.0]) * rng.uniform(0.8, 6.0)
    bulge = bulge_cm * np.cos(0.5 * np.pi * np.clip(off_cm / half_cm, -1.0, 1.0)) ** 2
    along = line.everywhere(np.clip(middle_cm, low, high), 1)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    right = np.stack([along[:, 1], -along[:, 0]], axis=1)
    return replace(line, coefficients_cm=line.coefficients_cm + bulge[:, None] * right)


def write_table(map_folder: Path, out: Path, seed: int | None = None) -> str:
    """Write the table of one map, or of a spoilt copy of it, and say what is in it."""
    drive_path = map_folder.with_name(map_folder.name.removesuffix("_map"))
    mapped = open_mapped_drive(map_folder)
    if seed is not None:
        mapped = spoilt(mapped, seed)
    table = label_table(mapped, map_folder, drive_path) | {"spoilt": np.array(seed is not None)}
    # Renamed when complete, so that a run that was killed leaves no half of a table.
    part = out.with_suffix(".part.npz")
    np.savez_compressed(part, **table)
    part.replace(out)
    size_cm, kept = np.abs(table["error_cm"]), ~table["withheld"]
    return (
        f"{drive_path.name} {table['camera']} {table['verdict']}: {len(size_cm)} labels, "
        f"{int((size_cm > 1.0).sum())} off by more than 1 cm, {int((size_cm > 3.0).sum())} by more than 3; "
        f"given today {int(kept.sum())}, {int((size_cm[kept] > 3.0).sum())} of them by more than 3 cm"
    )


def main() -> None:
    """Write the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="of bench_traps.py")
    parser.add_argument("--out", type=Path, required=True, help="folder for the tables")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--spoilt", type=int, default=0, help="spoilt copies of each map, too")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    todo: list[tuple[Path, Path, int | None]] = []
    for folder in sorted(path.parent for path in args.folder.glob("*_map/map.yaml")):
        name = folder.name.removesuffix("_map")
        todo.append((folder, args.out / f"{name}.npz", None))
        seeds = (SPOILT_SEED + int(name[:3]) + 1000 * k for k in range(args.spoilt))
        todo += [(folder, args.out / f"{name}_spoilt{k}.npz", seed) for k, seed in enumerate(seeds)]
    todo = [one for one in todo if not one[1].exists()]
    with ProcessPoolExecutor(args.processes) as pool:
        for said in pool.map(write_table, *zip(*todo, strict=True)) if todo else ():
            sys.stdout.write(said + "\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
