"""Two drives, taken to map, labels and detections by the command line, and their results as plain arrays.

Nothing of the project is imported here: what is compared is what the commands leave on disk, so that modules
may move without a change to these files.
"""

from __future__ import annotations

import csv
import json
import os
import shutil
import subprocess
import sys
import zlib
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as parquet
import yaml
from llvmlite import binding
from scipy.interpolate import BSpline

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
# Not manifest.json, which makes a folder a tub.
MANIFEST = HERE / "origins.json"

Results = dict[str, np.ndarray]

#: A lap and a bit: with fewer than 550 frames no place is seen twice and the camera stays as it was guessed.
RECORDED_FRAMES = 600
RECORDED_LANE_CM = 59
POINTS = [f"{side}_{row}_cm" for side in ("left", "right") for row in (0, 15, 30)]
SIGMAS = [name.replace("_cm", "_sigma_cm") for name in POINTS]
_EVERY_POSE = 5
_EVERY_ROW = 3
_LINE_STEP_CM = 5.0
#: Enough for every tolerance, and half the size.
_DECIMALS = 6
_PACKAGES = ("numpy", "scipy", "numba", "opencv-python-headless", "onnxruntime", "pyarrow")
#: Variables by which libraries are told to use other code than the processor's best.
_CHOOSE_CODE = (
    "NUMBA_CPU_NAME",
    "NUMBA_DISABLE_INTEL_SVML",
    "OPENBLAS_CORETYPE",
    "NPY_DISABLE_CPU_FEATURES",
    "OPENCV_CPU_DISABLE",
    "OPENCV_IPP",
)


def simulated_run(work: Path) -> Results:
    """Make a drive on a small loop with a known camera, and take it through the chain."""
    drive = work / "drive"
    lanenet("simulate", HERE / "simulated.yaml", "--out", drive)
    results = _map_and_label(drive, work, "--lane-width", 40)
    truth = read_columns(drive / "truth.csv")
    pose = np.stack([truth["x_cm"], truth["y_cm"]], axis=1)
    results["drive.position_cm"] = pose[::_EVERY_POSE]
    results["drive.heading_rad"] = truth["heading_rad"][::_EVERY_POSE]
    results["drive.points_cm"] = np.stack([truth[name] for name in POINTS], axis=1)[::_EVERY_ROW]
    detectors = {
        "lane-filter": ["lane-filter"],
        "hough": ["hough", "--config", ROOT / "configs/detectors/hough_value.yaml"],
        "painter": ["painter"],
        "small": ["network", "--model", ROOT / "checkpoints/small"],
        "general": ["network", "--model", ROOT / "checkpoints/general"],
    }
    return results | _detect(drive, work, detectors)


def recorded_run(work: Path, shared_data: Path) -> Results:
    """Take the first lap of a real tub through the chain; its camera is found on the way.

    The detectors look through a camera that stands in a file: found on another processor it differs by half a
    per cent, which a network on an edge image answers with centimetres.
    """
    tub = work / "tub"
    _first_frames(shared_data / "donkey_circuit", tub, RECORDED_FRAMES)
    width = ["--lane-width", RECORDED_LANE_CM]
    results = _map_and_label(tub, work, *width, "--config", HERE / "recorded.yaml")
    camera = ["--camera", HERE / "recorded_camera.yaml"]
    network = ["network", "--any-camera", *width, *camera, "--model"]
    detectors = {
        "lane-filter": ["lane-filter", *width, "--marking", 4.9, *camera],
        "hough": ["hough", "--config", ROOT / "configs/detectors/hough_value.yaml", *camera],
        "painter": ["painter", *camera],
        "small": [*network, ROOT / "checkpoints/small"],
        "general": [*network, ROOT / "checkpoints/general"],
    }
    return results | _detect(tub, work, detectors)


#: By name; the second one needs the real drives.
RUNS: dict[str, Callable[..., Results]] = {"simulated": simulated_run, "recorded": recorded_run}


def lanenet(*words: object) -> str:
    """Run the command line of this checkout in a process of its own, with one thread, and return its output.

    Raises:
        RuntimeError: If the command fails; says what it printed.
    """
    # Sums over several threads come in another order.
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    command = [sys.executable, "-m", "lanenet", *map(str, words)]
    environment = {**os.environ, **threads, "PYTHONPATH": path}
    # `python -m` looks into the current folder first, which may be that of another checkout.
    done = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command[2:])}: code {done.returncode}\n{done.stdout}{done.stderr}")
    return done.stdout


def machine() -> dict[str, Any]:
    """What decides the last digits: the processor that code is made for, and the versions of who makes it."""
    # numba compiles for it; the same name may stand for different features.
    features = binding.get_host_cpu_features().flatten()
    chosen = {name: os.environ[name] for name in _CHOOSE_CODE if name in os.environ}
    return {
        "processor": f"{binding.get_host_cpu_name()} {zlib.crc32(features.encode()):08x}",
        "chosen": chosen,
        "versions": {package: metadata.version(package) for package in _PACKAGES},
    }


def read_columns(path: Path) -> dict[str, np.ndarray]:
    """Columns of a CSV file as numbers, NaN where empty; without the marks of the images."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {
        name: np.array([float(row[name] or "nan") for row in rows]) for name in rows[0] if name != "image"
    }


def load_results(name: str) -> Results:
    """Expected results of a run."""
    with np.load(HERE / f"{name}.npz") as file:
        return dict(file)


def save_results(name: str, results: Results) -> None:
    """Replace the expected results of a run."""
    rounded = {
        field: np.round(values, _DECIMALS) if values.dtype.kind == "f" else values
        for field, values in sorted(results.items())
    }
    np.savez_compressed(HERE / f"{name}.npz", **rounded)


def _first_frames(source: Path, tub: Path, frames: int) -> None:
    (tub / "images").mkdir(parents=True)
    shutil.copyfile(source / "manifest.json", tub / "manifest.json")
    rows = (source / "catalog_0.catalog").read_text().splitlines()[:frames]
    (tub / "catalog_0.catalog").write_text("\n".join(rows) + "\n")
    for row in rows:
        image = json.loads(row)["cam/image_array"]
        shutil.copyfile(source / "images" / image, tub / "images" / image)


def _map_and_label(drive: Path, work: Path, *options: object) -> Results:
    lanenet("map", drive, *options, "--out", work / "map")
    lanenet("label", work / "map", "--out", work / "labels.parquet")
    results = _read_map(work / "map")
    frames = read_columns(work / "map" / "poses.csv")["frame"]
    return results | _read_labels(work / "labels.parquet", frames)


def _read_map(folder: Path) -> Results:
    poses = read_columns(folder / "poses.csv")
    meta = yaml.safe_load((folder / "map.yaml").read_text())
    camera = yaml.safe_load((folder / "camera.yaml").read_text())
    report = json.loads((folder / "report.json").read_text())
    segment = report["segments_mapped"][0]
    mounting = camera["mounting"]
    lines = json.loads((folder / "lanes.json").read_text())["lines"]
    pose = np.stack([poses["x_cm"], poses["y_cm"]], axis=1)
    results = {
        "map.verdict": np.array([meta["verdict"]]),
        "map.laps, segments, frames": _whole(meta["laps"], report["segments"], len(pose)),
        "map.revisits": _whole(segment["revisits"]),
        "map.frame": poses["frame"][::_EVERY_POSE].astype(np.int64),
        "map.lap": poses["lap"].astype(np.int64)[::_EVERY_POSE],
        "map.held_out": poses["held_out"].astype(np.int64),
        "map.position_cm": pose[::_EVERY_POSE],
        "map.heading_rad": poses["heading_rad"][::_EVERY_POSE],
        "map.nod_rad": np.stack([poses["pitch_rad"], poses["roll_rad"]], axis=1)[::_EVERY_POSE],
        "map.s_cm": poses["s_cm"][::_EVERY_POSE],
        "map.match": poses["match"][::_EVERY_POSE],
        "map.open_loop_cm": np.loadtxt(folder / "open_loop.tum")[::_EVERY_POSE, 1:3] * 100.0,
        "map.lane and tape_cm": _real(meta["mapped_lane_cm"], meta["tape_cm"]),
        "map.held-out residual_px": _real(report["held_out"]["robust_sd_px_at_160"]),
        "map.held-out coverage": _real(report["held_out"]["coverage"]),
        "map.steering": _real(*(segment["steering"][key] for key in ("gain", "correlation"))),
        "map.steering lag": _whole(segment["steering"]["lag_frames"]),
        "camera.focal and centre_px": _real(*(camera["K"][i][j] for i, j in ((0, 0), (0, 2), (1, 2)))),
        "camera.distortion": _real(*camera["D"]),
        "camera.angles_rad": _real(*(mounting[f"{name}_rad"] for name in ("pitch_down", "roll", "yaw"))),
        "camera.place_cm": _real(mounting["height_cm"], mounting["ahead_of_front_axle_cm"]),
        "map.lines": np.array([f"{line['segment']} {line['side']} {line['rank']}" for line in lines]),
    }
    for line, name in zip(lines, results["map.lines"], strict=True):
        results[f"map.line {name}_cm"] = _points_of(line, _LINE_STEP_CM)
        results[f"map.tape of line {name}_cm"] = _real(line["marking_cm"])
    return results


def fine_lines(folder: Path) -> Results:
    """Lines of a map as dense points, to measure distances from."""
    lines = json.loads((folder / "lanes.json").read_text())["lines"]
    return {
        f"map.line {line['segment']} {line['side']} {line['rank']}_cm": _points_of(line, 0.25)
        for line in lines
    }


def _points_of(line: dict[str, Any], step_cm: float) -> np.ndarray:
    """Points along a line, where the map has seen it."""
    knots = np.array(line["knots_cm"])
    spline = BSpline(knots, np.array(line["coefficients_cm"]), line["degree"])
    low, high, period = knots[3], knots[-4], line["period_cm"]
    places = [np.arange(start, end, step_cm) for start, end in line["supported_cm"]]
    s = np.concatenate(places)
    return np.asarray(spline(np.clip(s, low, high) if period is None else low + np.mod(s - low, period)))


def _read_labels(path: Path, frames: np.ndarray) -> Results:
    """Labels of every third frame of the map, NaN where it has none."""
    table = parquet.read_table(path)
    rows = np.searchsorted(frames, _column(table, "frame"))

    def on_map(values: np.ndarray) -> np.ndarray:
        placed = np.full((len(frames), *values.shape[1:]), np.nan)
        placed[rows] = values
        return placed[::_EVERY_ROW]

    counts = [len(points) for points in table["edges_x_cm"].to_pylist()]
    return {
        "labels.frames": _whole(len(table)),
        "labels.points_cm": on_map(np.stack([_column(table, name) for name in POINTS], axis=1)),
        "labels.quality": on_map(_column(table, "quality")),
        "labels.edge points": on_map(np.array(counts, dtype=np.float64)),
    }


def _detect(source: Path, work: Path, detectors: dict[str, list[Any]]) -> Results:
    results = {}
    for name, options in detectors.items():
        out = work / f"{name}.parquet"
        lanenet("detect", source, "--detector", *options, "--out", out)
        table = parquet.read_table(out)
        field = f"detect.{name}"
        results[f"{field}.points_cm"] = np.stack([_column(table, p) for p in POINTS], axis=1)[::_EVERY_ROW]
        results[f"{field}.sigma_cm"] = np.stack([_column(table, s) for s in SIGMAS], axis=1)[::_EVERY_ROW]
        results[f"{field}.steering_rad"] = _column(table, "steering_rad")[::_EVERY_ROW]
        results[f"{field}.confidence"] = _column(table, "confidence")[::_EVERY_ROW]
    return results


def _column(table: Any, name: str) -> np.ndarray:
    return np.array(table[name].to_pylist(), dtype=np.float64)


def _whole(*values: int) -> np.ndarray:
    return np.array(values, dtype=np.int64)


def _real(*values: float) -> np.ndarray:
    return np.array(values, dtype=np.float64)
