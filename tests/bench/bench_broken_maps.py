"""Good maps that are broken on purpose: does the check notice? Part of ``make traps``, after the drives.

Each good map in the folder of ``bench_traps.py`` is broken in turn: a line is shifted by 4 to 10 cm in one
bend, the later laps are laid 4 to 15 cm beside the first one, or the lens is 5 % off. Then it is checked and
judged again with the drive's images. Noticed is what is rejected, or gives no wrong labels any more. A row
per broken map.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from datagen.check import compare_with_frames
from datagen.quality.figures import map_evidence
from datagen.quality.verdict import VerdictSettings, judge
from lanenet.data.maps.folder import DriveMap
from lanenet.data.maps.mapped_drive import MappedDrive, label_frames, open_mapped_drive
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.poses import path_lengths

KINDS = ("line", "closure", "lens")
#: Labels beyond these are wrong, as in ``bench_traps.py``.
MAX_RMSE_CM, MAX_STRETCH_CM, STRETCH_CM = 1.0, 3.0, 30.0
_BEND_CM = 60.0


def broken(drive_map: DriveMap, kind: str, rng: np.random.Generator) -> DriveMap:
    """Return a map with one thing wrong."""
    if kind == "lens":
        factor = 1.0 + 0.05 * float(rng.choice([-1.0, 1.0]))
        scale = np.array([[factor, 1.0, 1.0], [1.0, factor, 1.0], [1.0, 1.0, 1.0]])
        return replace(drive_map, camera=replace(drive_map.camera, K=drive_map.camera.K * scale))
    if kind == "closure":
        way, far_cm = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(4.0, 15.0)
        poses = drive_map.poses.copy()
        poses[drive_map.lap > 0, :2] += far_cm * np.array([np.cos(way), np.sin(way)])
        return replace(drive_map, poses=poses)
    lines = {segment: list(own) for segment, own in drive_map.lines.items()}
    number = int(rng.integers(2))
    line = lines[0][number]
    # In the tightest of a few places.
    places = rng.uniform(line.knots_cm[3], line.knots_cm[-4], 5)
    speed, turn = line.everywhere(places, 1), line.everywhere(places, 2)
    bend = np.abs(speed[:, 0] * turn[:, 1] - speed[:, 1] * turn[:, 0]) / np.linalg.norm(speed, axis=1) ** 3
    k = int(np.argmax(bend))
    across = np.array([-speed[k, 1], speed[k, 0]]) / np.linalg.norm(speed[k])
    # A control point acts around the middle of the five knots that it spans.
    middle_cm = line.knots_cm[2 : 2 + len(line.coefficients_cm)]
    gap_cm = np.abs(middle_cm - places[k])
    if line.period_cm is not None:
        gap_cm = np.minimum(gap_cm % line.period_cm, -gap_cm % line.period_cm)
    share = np.where(gap_cm < _BEND_CM, 0.5 + 0.5 * np.cos(np.pi * gap_cm / _BEND_CM), 0.0)
    shift_cm = float(rng.uniform(4.0, 10.0) * rng.choice([-1.0, 1.0]))
    lines[0][number] = replace(
        line, coefficients_cm=line.coefficients_cm + shift_cm * share[:, None] * across
    )
    return replace(drive_map, lines=lines)


def check(mapped: MappedDrive, good_cm: np.ndarray, folder: Path) -> tuple[str, float, float]:
    """Check and judge a map again.

    Returns:
        The grade, and of the labels that it still gives, against those of the good map, the RMSE and the
        worst RMSE of one point over a stretch, [cm].
    """
    figures = json.loads((folder / "report.json").read_text())
    mapped, quality = compare_with_frames(mapped, figures)
    evidence = map_evidence(mapped.drive_map, figures, quality, None)
    grade = judge(evidence, VerdictSettings()).grade
    off_cm = quality.points_cm - good_cm
    way_cm = path_lengths(mapped.drive_map.poses)
    worst_cm = 0.0
    for start_cm in np.arange(0.0, way_cm[-1], 0.5 * STRETCH_CM):
        part = off_cm[(way_cm >= start_cm) & (way_cm < start_cm + STRETCH_CM)]
        seen = np.isfinite(part).sum(axis=0)
        rms = np.sqrt(np.nansum(part**2, axis=0) / np.maximum(seen, 1))
        worst_cm = max(worst_cm, float(rms[seen >= 3].max(initial=0.0)))
    known = off_cm[np.isfinite(off_cm)]
    return grade, float(np.sqrt(np.mean(known**2))) if known.size else 0.0, worst_cm


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, required=True, help="that of bench_traps.py")
    parser.add_argument("--maps", type=int, default=200, help="broken maps altogether")
    args = parser.parse_args()
    good = []
    for folder in sorted(args.folder.glob("*_map")):
        report = folder / "report.json"
        if report.is_file() and json.loads(report.read_text()).get("verdict", {}).get("grade") == "good":
            good.append(folder)
    counts = {kind: [0, 0] for kind in KINDS}
    for number in range(args.maps if good else 0):
        folder, kind = good[number // len(KINDS) % len(good)], KINDS[number % len(KINDS)]
        mapped = open_mapped_drive(folder)
        good_cm = label_frames(mapped, BirdseyeWindow()).points_cm
        drive_map = broken(mapped.drive_map, kind, np.random.default_rng(number))
        grade, rmse_cm, worst_cm = check(
            MappedDrive(drive_map, mapped.drive, mapped.rows, mapped.perception), good_cm, folder
        )
        noticed = grade == "reject" or (rmse_cm <= MAX_RMSE_CM and worst_cm <= MAX_STRETCH_CM)
        counts[kind][0] += noticed
        counts[kind][1] += 1
        said = "noticed" if noticed else "MISSED"
        sys.stdout.write(f"{number} {folder.name} {kind} {grade} {rmse_cm:.2f} {worst_cm:.1f} cm: {said}\n")
        sys.stdout.flush()
    for kind, (seen, made) in counts.items():
        sys.stdout.write(f"{kind}: {seen} of {made} noticed\n")


if __name__ == "__main__":
    main()
