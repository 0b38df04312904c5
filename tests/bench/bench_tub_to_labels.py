"""From a tub to labels, camera found: ``python tests/bench/bench_tub_to_labels.py``.

Maps and labels the tub ``donkey_circuit`` (1000 frames) of the folder that ``LANENET_SHARED_DATA`` names, or
another drive, and prints JSON: the machine, each stage with its calls and its CPU seconds (inner stages are
part of outer ones), then CPU and wall seconds in all with the figures of the map. What numba compiles anew is
part of the first run; a second run shows the cost without it. Says so and stops where the drive is not there.
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import platform
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

from datagen import check, pipeline, prepare, segments
from datagen.settings import MapSettings
from datagen.slam import segment, track, view
from datagen.slam.camera import self_calibration

#: Outermost first.
STAGES: list[tuple[ModuleType | type, str]] = [
    (prepare, "following_frames"),
    (pipeline, "find_camera"),
    (self_calibration, "coarse_camera"),
    (segment.SegmentSolver, "solve"),
    (view, "edges_of_drive"),
    (view, "without_reflections"),
    (view, "typical_step"),
    (view, "scans_of"),
    (track, "Evidence"),
    (track, "run_filter"),
    (segment, "match_places"),
    (segment, "adjust"),
    (segments, "find_lane"),
    (check, "measure_map"),
    (pipeline, "report_page"),
    (pipeline, "label_map"),
]


def cpu_s() -> float:
    """CPU seconds of this process and of those that it waited for."""
    used = os.times()
    return used.user + used.system + used.children_user + used.children_system


class Stage:
    """Calls of one function, and what they cost."""

    def __init__(self, module: ModuleType | type, name: str) -> None:
        self.name, self.calls, self.cpu_s = name.lstrip("_"), 0, 0.0
        inner: Callable[..., Any] = getattr(module, name)

        @functools.wraps(inner)
        def timed(*args: Any, **kwargs: Any) -> Any:
            begun = cpu_s()
            try:
                return inner(*args, **kwargs)
            finally:
                self.calls += 1
                self.cpu_s += cpu_s() - begun

        setattr(module, name, timed)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    shared = Path(os.environ.get("LANENET_SHARED_DATA", "data"))
    parser.add_argument("--drive", type=Path, default=shared / "donkey_circuit")
    parser.add_argument("--lane-width", type=float, default=59.0, help="cm")
    args = parser.parse_args()
    if not args.drive.exists():
        sys.stdout.write(f"skipped: no drive {args.drive}; LANENET_SHARED_DATA names the folder of drives\n")
        return
    machine = {"cpu": platform.processor() or platform.machine(), "cores": os.cpu_count()}
    sys.stdout.write(json.dumps({**machine, "load": round(os.getloadavg()[0], 2)}) + "\n")
    stages = [Stage(module, name) for module, name in STAGES]
    begun, begun_cpu = time.perf_counter(), cpu_s()
    with tempfile.TemporaryDirectory() as folder:
        drive_map = Path(folder) / "map"
        report = pipeline.map_drive(
            pipeline.MapRequest(args.drive, args.lane_width), MapSettings(), drive_map
        )
        labels = pipeline.label_map(drive_map, Path(folder) / "labels.parquet")
    total = {"cpu_s": round(cpu_s() - begun_cpu, 1), "wall_s": round(time.perf_counter() - begun, 1)}
    for stage in stages:
        row = {"stage": stage.name, "calls": stage.calls, "cpu_s": round(stage.cpu_s, 2)}
        sys.stdout.write(json.dumps(row) + "\n")
    both = report.figures["held_out"]["both_lines"]
    held_out = {name: round(both[name], 3) for name in ("robust_sd_px", "p95_px")}
    found = {
        "verdict": report.figures["verdict"]["grade"],
        "focal_px": round(report.figures["camera"]["focal_px"], 1),
        "held_out": held_out,
        "labelled_share": round(labels.figures["labelled_share"], 3),
    }
    sys.stdout.write(json.dumps({"drive": args.drive.name, **total, **found}) + "\n")


if __name__ == "__main__":
    main()
