"""From a tub to labels, camera found: ``python tests/bench/bench_map.py``.

Maps and labels the tub ``donkey_circuit`` (1000 frames) of the folder that ``LANENET_SHARED_DATA`` names, or
another drive, in a process of its own, as ``lanenet map`` and ``lanenet label`` do, with numba's cache in an
empty folder, so that what is compiled counts (``--cached`` runs once before). Prints JSON: the machine; each
stage with its calls, wall and CPU seconds (inner stages are part of outer ones; CPU seconds count threads
and processes); then the total, its ratio to the duration of the drive, and the figures of the map. Says so
and stops where the drive is not there.
"""

from __future__ import annotations

import argparse
import functools
import json
import multiprocessing
import os
import platform
import sys
import tempfile
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

#: Modules and what is timed in them, as their users call it; outermost first.
STAGES = (
    ("datagen.pipeline", "prepare"),
    ("datagen.pipeline", "camera_of_drive"),
    ("datagen.slam.camera.self_calibration", "coarse_camera"),
    ("datagen.pipeline", "solve_drive"),
    ("datagen.slam.segment.SegmentSolver", "solve"),
    ("datagen.slam.segment", "view_segment"),
    ("datagen.slam.segment", "view_road"),
    ("datagen.slam.view", "view_road"),
    ("datagen.slam.view", "edges_of_drive"),
    ("datagen.slam.view", "without_reflections"),
    ("datagen.slam.view", "true_borders"),
    ("datagen.slam.view", "typical_step"),
    ("datagen.slam.view", "scans_of"),
    ("datagen.slam.segment", "track"),
    ("datagen.slam.track", "Evidence"),
    ("datagen.slam.track", "run_filter"),
    ("datagen.slam.segment.PlaceMatcher", "match"),
    ("datagen.slam.segment", "adjust"),
    ("datagen.pipeline", "fit_lanes"),
    ("datagen.pipeline", "assemble"),
    ("datagen.pipeline", "check_map"),
    ("datagen.pipeline", "_draw"),
    ("datagen.pipeline", "label_map"),
)


def cpu_s() -> float:
    """CPU seconds of this process and of those that it waited for."""
    used = os.times()
    return used.user + used.system + used.children_user + used.children_system


class Stage:
    """Calls of one function, and what they cost; a call inside a call of the same function counts once."""

    def __init__(self, path: str, name: str) -> None:
        self.name, self.calls, self.wall_s, self.cpu_s, self.depth = name.lstrip("_"), 0, 0.0, 0.0, 0
        owner = _found(path)
        inner: Callable[..., Any] = getattr(owner, name)

        @functools.wraps(inner)
        def timed(*args: Any, **kwargs: Any) -> Any:
            begun, begun_cpu = time.perf_counter(), cpu_s()
            self.depth += 1
            try:
                return inner(*args, **kwargs)
            finally:
                self.depth -= 1
                self.calls += 1
                if not self.depth:
                    self.wall_s += time.perf_counter() - begun
                    self.cpu_s += cpu_s() - begun_cpu

        setattr(owner, name, timed)

    def row(self) -> dict[str, Any]:
        """For the table."""
        seconds = {"wall_s": round(self.wall_s, 2), "cpu_s": round(self.cpu_s, 2)}
        return {"stage": self.name, "calls": self.calls, **seconds}


def _found(path: str) -> Any:
    """The module of that name, or the class in it."""
    try:
        return import_module(path)
    except ModuleNotFoundError:
        module, _, name = path.rpartition(".")
        return getattr(import_module(module), name)


def map_and_label(drive: Path, lane_width_cm: float, hertz: float) -> None:
    """Measure and print, in a fresh process."""
    begun, begun_cpu = time.perf_counter(), cpu_s()
    stages = [Stage(path, name) for path, name in STAGES]
    pipeline, settings = import_module("datagen.pipeline"), import_module("datagen.settings")
    imports_s = time.perf_counter() - begun
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "map"
        report = pipeline.map_drive(pipeline.MapRequest(drive, lane_width_cm), settings.MapSettings(), out)
        labels = pipeline.label_map(out, Path(folder) / "labels.parquet")
    wall_s = time.perf_counter() - begun
    sys.stdout.write(json.dumps({"stage": "imports", "calls": 1, "wall_s": round(imports_s, 2)}) + "\n")
    for stage in stages:
        sys.stdout.write(json.dumps(stage.row()) + "\n")
    figures = report.figures
    duration_s = figures["frames"] / hertz
    total = {
        "wall_s": round(wall_s, 1),
        "cpu_s": round(cpu_s() - begun_cpu, 1),
        "drive_s": round(duration_s, 1),
        "ratio": round(wall_s / duration_s, 2),
        "verdict": figures["verdict"]["grade"],
        "held_out": {name: round(value, 3) for name, value in figures["held_out"].items()},
        "labelled_share": round(labels.figures["labelled_share"], 3),
    }
    sys.stdout.write(json.dumps({"drive": drive.name, **total}) + "\n")


def main() -> None:
    """Run in a process that imports and compiles anew, as the command line does."""
    parser = argparse.ArgumentParser(description=__doc__)
    shared = Path(os.environ.get("LANENET_SHARED_DATA", "data"))
    parser.add_argument("--drive", type=Path, default=shared / "donkey_circuit")
    parser.add_argument("--lane-width", type=float, default=59.0, help="cm")
    parser.add_argument("--hertz", type=float, default=20.0, help="images per second of the drive")
    parser.add_argument("--cached", action="store_true", help="run once before, so that nothing is compiled")
    args = parser.parse_args()
    if not args.drive.exists():
        sys.stdout.write(f"skipped: no drive {args.drive}; LANENET_SHARED_DATA names the folder of drives\n")
        return
    # As the command line does; the new process imports NumPy with it.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    with tempfile.TemporaryDirectory() as cache:
        os.environ["NUMBA_CACHE_DIR"] = cache
        for _ in range(1 + args.cached):
            machine = {"cpu": platform.processor() or platform.machine(), "cores": os.cpu_count()}
            load = round(os.getloadavg()[0], 2)
            sys.stdout.write(json.dumps({**machine, "load": load}) + "\n")
            sys.stdout.flush()
            arguments = (args.drive, args.lane_width, args.hertz)
            process = multiprocessing.get_context("spawn").Process(target=map_and_label, args=arguments)
            process.start()
            process.join()
            if process.exitcode:
                raise SystemExit(process.exitcode)


if __name__ == "__main__":
    main()
