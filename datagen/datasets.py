"""The label sets of a training run: simulate or read the drives, map, label; whatever is there is kept.

Training and validation labels come from maps, never from the simulator's truth; the truth only scores.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator

from datagen.pipeline import MapSettings, label_map, map_drive
from datagen.world.simulate import SimulationSettings, simulate_drive
from lanenet.config import Settings
from lanenet.data.drive import open_drive, read_truth
from lanenet.data.files import write_json
from lanenet.data.label_set import LabelMeta, LabelSet, read_labels, write_labels
from lanenet.errors import ConfigError, DriveFormatError
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.lane import POINT_NAMES
from lanenet.perception.birdseye import PerceptionSettings, RoadEdgeExtractor

Progress = Callable[[int, int], None]
Role = Literal["train", "validation", "test"]

_VERSION = 6  # of this module's outputs; raise it when the same settings give other labels


class SyntheticSettings(Settings):
    """Synthetic drives, each on a road, and with a look, of its own.

    Attributes:
        seed: Every drive's seed follows from this, its role and its number.
        train: Drives to learn from.
        validation: Drives to choose the epoch by.
        test: Drives whose truth scores the result.
        simulation: What all drives share; their ``seed`` is set here.
    """

    seed: int = Field(default=0, ge=0)
    train: int = Field(default=0, ge=0)
    validation: int = Field(default=0, ge=0)
    test: int = Field(default=0, ge=0)
    simulation: SimulationSettings = SimulationSettings()


class RecordedSettings(Settings):
    """A recorded drive, split along its time.

    Attributes:
        path: Drive folder, tub or video, from the folder in which the command runs.
        lane_width_cm: Between the middles of the lines of the driven lane.
        camera: Camera file; left out, the camera is found from the drive.
        train_share: Share of the labelled frames, from the start, to learn from.
        validation_share: Share of the frames after them to choose the epoch by; the rest is for the test.
        gap_frames: Frames left out between the parts, so that neighbours are never on both sides.
        map: Settings for mapping this drive.
    """

    path: Path
    lane_width_cm: float = Field(gt=0.0)
    camera: Path | None = None
    train_share: float = Field(default=0.6, gt=0.0, lt=1.0)
    validation_share: float = Field(default=0.15, gt=0.0, lt=1.0)
    gap_frames: int = Field(default=40, ge=0)
    map: MapSettings = MapSettings()

    @model_validator(mode="after")
    def _leave_some_for_the_test(self) -> RecordedSettings:
        if self.train_share + self.validation_share > 0.999:
            raise ValueError("train_share and validation_share must sum to less than 1: the rest is the test")
        return self


class DataSettings(Settings):
    """Where the label sets of a run come from.

    Attributes:
        synthetic: Synthetic drives.
        drives: Recorded drives.
        map: Settings for mapping the synthetic drives.
        window: The patch of road that the network sees: wide enough for the lane's lines on either side.
        workers: Processes that simulate and map; 0 takes one per core.
    """

    synthetic: SyntheticSettings = SyntheticSettings()
    drives: tuple[RecordedSettings, ...] = ()
    map: MapSettings = MapSettings()
    window: BirdseyeWindow = BirdseyeWindow()
    workers: int = Field(default=0, ge=0)


@dataclass(frozen=True)
class PreparedData:
    """Label sets of a run, by role.

    Attributes:
        train: To learn from.
        validation: To choose the epoch by.
        test: To score the result.
        validation_frames: For each of ``validation`` the map that it was made of.
        test_frames: For each of ``test`` the simulated drive, whose truth it holds, or the map.
        camera: Camera file, where all drives share one camera.
        example: A frame of a synthetic test drive, to try the model on.
    """

    train: list[Path]
    validation: list[Path]
    test: list[Path]
    validation_frames: list[Path]
    test_frames: list[Path]
    camera: Path | None
    example: Path | None


def prepare(settings: DataSettings, work_dir: Path, progress: Progress | None = None) -> PreparedData:
    """Make the label sets that are not there yet.

    Each drive is one job in its own process; what a job has finished stays, so that a killed run goes on
    where it stopped. A label set is made again when its settings have changed.

    Args:
        settings: The data of a run.
        work_dir: Folder for drives, maps and label sets.
        progress: Called with (jobs done, jobs).

    Raises:
        ConfigError: If no part has any drive.
        LanenetError: What the first failing job raised.
    """
    jobs: list[tuple[Role | None, dict[str, Any]]] = []
    for role in ("train", "validation", "test"):
        for number in range(getattr(settings.synthetic, role)):
            jobs.append((role, _synthetic_job(settings, role, number, work_dir)))
    for drive in settings.drives:
        job = {
            "kind": "recorded",
            "settings": drive,
            "window": settings.window,
            "folder": work_dir / "drives",
        }
        jobs.append((None, job))
    for role in ("train", "validation"):
        if not settings.drives and not getattr(settings.synthetic, role):
            raise ConfigError(f"data: no {role} drives; set data.synthetic.{role} or list data.drives")
    workers = settings.workers or os.cpu_count() or 1
    results: dict[int, dict[Role, Path]] = {}
    if workers == 1 or len(jobs) == 1:
        for i, (_, job) in enumerate(jobs):
            results[i] = _run_job(job)
            if progress is not None:
                progress(i + 1, len(jobs))
    else:
        # Spawned, because forking a process that has started torch's or OpenCV's threads can hang.
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(workers, mp_context=context) as pool:
            futures = {pool.submit(_run_job, job): i for i, (_, job) in enumerate(jobs)}
            try:
                for done, future in enumerate(as_completed(futures), start=1):
                    results[futures[future]] = future.result()
                    if progress is not None:
                        progress(done, len(jobs))
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
    parts: dict[Role, list[Path]] = {"train": [], "validation": [], "test": []}
    frames: dict[Role, list[Path]] = {"train": [], "validation": [], "test": []}
    for i, (_, job) in enumerate(jobs):
        for role, path in results[i].items():
            parts[role].append(path)
            frames[role].append(_frames_of(job))
    camera = _shared_camera(settings, work_dir)
    pictures = sorted((work_dir / "synthetic" / "drives" / "test_00" / "images").glob("*.jpg"))
    example = pictures[len(pictures) // 2] if pictures and settings.synthetic.test else None
    return PreparedData(
        parts["train"],
        parts["validation"],
        parts["test"],
        frames["validation"],
        frames["test"],
        camera,
        example,
    )


def _frames_of(job: dict[str, Any]) -> Path:
    """Folder that leads to the frames of a job's label sets: a drive with truth, or a map."""
    if job["kind"] == "recorded":
        return Path(job["folder"]) / "maps" / _recorded_name(job["settings"])
    return Path(job["folder"]) / ("drives" if job["role"] == "test" else "maps") / job["name"]


def _shared_camera(settings: DataSettings, work_dir: Path) -> Path | None:
    """Camera file of the run's drives, if they share one: the simulation's, or the only recording's."""
    if not settings.drives and settings.synthetic.train:
        return work_dir / "synthetic" / "drives" / "train_00" / "camera.yaml"
    synthetic = settings.synthetic
    if len(settings.drives) == 1 and not (synthetic.train or synthetic.validation or synthetic.test):
        return work_dir / "drives" / "maps" / _recorded_name(settings.drives[0]) / "camera.yaml"
    return None


def _recorded_name(settings: RecordedSettings) -> str:
    """Name of a recording's outputs; two drives may have folders of the same name."""
    return f"{settings.path.resolve().name}-{_key([str(settings.path.resolve())])[:6]}"


def _synthetic_job(settings: DataSettings, role: Role, number: int, work_dir: Path) -> dict[str, Any]:
    # Roles draw from separate streams, so that more training drives leave the test drives as they are.
    stream = ("train", "validation", "test").index(role)
    seed = int(np.random.SeedSequence([settings.synthetic.seed, stream, number]).generate_state(1)[0])
    simulation = settings.synthetic.simulation.model_copy(update={"seed": seed})
    name = f"{role}_{number:02d}"
    return {
        "kind": "synthetic",
        "role": role,
        "name": name,
        "simulation": simulation,
        # The simulated camera does not see its car.
        "map": settings.map.model_copy(update={"find_bumper": False}),
        "window": settings.window,
        "folder": work_dir / "synthetic",
    }


def _run_job(job: dict[str, Any]) -> dict[Role, Path]:
    """Make one drive's label sets; runs in a process of its own."""
    import cv2

    cv2.setNumThreads(1)
    if job["kind"] == "synthetic":
        return {job["role"]: _synthetic_labels(job)}
    return _recorded_labels(job["settings"], job["window"], job["folder"])


def _synthetic_labels(job: dict[str, Any]) -> Path:
    folder: Path = job["folder"]
    simulation: SimulationSettings = job["simulation"]
    drive, drive_map = folder / "drives" / job["name"], folder / "maps" / job["name"]
    labels = folder / "labels" / f"{job['name']}.parquet"
    parts = [simulation.model_dump(mode="json"), job["role"], asdict(job["window"])]
    # The truth needs no map, but its edges are found in the same way.
    mapping: MapSettings = job["map"]
    parts.append((mapping.perception if job["role"] == "test" else mapping).model_dump(mode="json"))
    key = _key(parts)
    if _is_done(labels, key):
        return labels
    # From here on, what lies there is neither the old labels nor the new ones.
    _marker(labels).unlink(missing_ok=True)
    simulate_drive(simulation, drive)
    if job["role"] == "test":
        truth = truth_labels(drive, job["map"].perception, job["window"], simulation.track.line_width_cm)
        write_labels(labels, truth)
    else:
        map_drive(drive, simulation.track.lane_width_cm, None, job["map"], drive_map)
        label_map(drive_map, labels, perception=job["map"].perception, window=job["window"])
    _mark_done(labels, key)
    return labels


def truth_labels(
    drive_path: Path,
    perception: PerceptionSettings | None = None,
    window: BirdseyeWindow | None = None,
    marking_cm: float | None = None,
) -> LabelSet:
    """Make a label set from a simulator's truth, for scoring.

    Args:
        drive_path: Simulated drive.
        perception: How edge points are found; None takes the defaults.
        window: The network's window; None takes the default.
        marking_cm: Width of the markings, if known.

    Raises:
        DriveFormatError: If the drive has no truth, or no camera or lane width.
    """
    drive, truth = open_drive(drive_path), read_truth(drive_path / "truth.csv")
    if truth is None or drive.camera is None or drive.lane_width_cm is None:
        raise DriveFormatError(f"{drive_path}: expected a simulated drive with truth, camera and lane width")
    perception = PerceptionSettings() if perception is None else perception
    extractor = RoadEdgeExtractor(drive.camera, perception)
    edges = []
    for i in range(len(drive)):
        road = extractor.extract(drive.image(i))
        edges.append(np.concatenate([road.points_cm, road.normals], axis=1).astype(np.float32))
    n = len(drive)
    window = BirdseyeWindow() if window is None else window
    nothing = np.empty((0, 2))
    return LabelSet(
        meta=LabelMeta(
            window=window,
            camera_hash=drive.camera.hash,
            wheelbase_cm=drive.camera.wheelbase_cm,
            lane_width_cm=drive.lane_width_cm,
            source="truth",
            perception=perception,
            marking_cm=marking_cm,
        ),
        drive=[drive.name] * n,
        file=[""] * n,
        frame=drive.frames,
        t_s=drive.t_s,
        lap=np.zeros(n, dtype=np.int64),
        poses=np.stack([truth["x_cm"], truth["y_cm"], truth["heading_rad"]], axis=1),
        points_cm=window.labelled(np.stack([truth[name] for name in POINT_NAMES], axis=1)),
        edges=edges,
        lines=[(nothing, nothing)] * n,
        quality=np.ones(n),
    )


def _recorded_labels(settings: RecordedSettings, window: BirdseyeWindow, folder: Path) -> dict[Role, Path]:
    """Map and label a recorded drive, and split it along time: to learn from, a gap, to judge by."""
    name = _recorded_name(settings)
    drive_map, whole = folder / "maps" / name, folder / "labels" / f"{name}.parquet"
    inputs = [settings.model_dump(mode="json"), asdict(window), _fingerprint(settings.path)]
    if settings.camera is not None and settings.camera.is_file():
        inputs.append(_fingerprint(settings.camera))
    key = _key(inputs)
    parts: dict[Role, Path] = {
        role: folder / "labels" / f"{name}.{role}.parquet" for role in ("train", "validation", "test")
    }
    if not (_is_done(whole, key) and all(path.is_file() for path in parts.values())):
        _marker(whole).unlink(missing_ok=True)
        map_drive(settings.path, settings.lane_width_cm, settings.camera, settings.map, drive_map)
        label_map(drive_map, whole, window=window)
        shares = (settings.train_share, settings.validation_share)
        pieces = split_along_time(read_labels(whole), shares, settings.gap_frames)
        for path, piece in zip(parts.values(), pieces, strict=True):
            write_labels(path, piece)
        _mark_done(whole, key)
    return parts


def split_along_time(labels: LabelSet, shares: tuple[float, ...], gap_frames: int) -> list[LabelSet]:
    """Cut a drive's labels along its time, with a gap of frame numbers at each cut.

    Args:
        labels: Labels of one drive, in the order of its frames.
        shares: Share of the frames of each part but the last, which gets the rest.
        gap_frames: No two frames of different parts are this close or closer.

    Returns:
        One more part than there are shares.

    Raises:
        ConfigError: If a part would be empty.
    """
    cuts = np.rint(np.cumsum([0.0, *shares]) * len(labels)).astype(int)
    cuts = np.append(np.minimum(cuts, len(labels)), len(labels))
    parts = []
    free_from = -np.inf
    for start, end in pairwise(cuts):
        rows = np.arange(start, end)
        rows = rows[labels.frame[rows] > free_from]
        if not rows.size:
            raise ConfigError(
                f"shares {shares} with a gap of {gap_frames} frames leave a part of {len(labels)} empty"
            )
        parts.append(labels.subset(rows))
        free_from = labels.frame[rows[-1]] + gap_frames
    return parts


def _fingerprint(path: Path) -> str:
    """Name, size and time of a recording's index files: cheap, and changes when the recording does."""
    if not path.exists():
        raise DriveFormatError(f"{path}: no such drive")
    files = [path] if path.is_file() else sorted(p for p in path.iterdir() if p.is_file())
    return _key([(p.name, p.stat().st_size, p.stat().st_mtime_ns) for p in files])


def _key(parts: list[Any]) -> str:
    text = json.dumps([_VERSION, parts], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _marker(path: Path) -> Path:
    return path.with_name(f"{path.stem}.done.json")


def _is_done(path: Path, key: str) -> bool:
    try:
        return path.is_file() and json.loads(_marker(path).read_text(encoding="utf-8")) == {"key": key}
    except (OSError, ValueError):  # not there, not text, or not JSON
        return False


def _mark_done(path: Path, key: str) -> None:
    """Written last: a job that was killed before this is done again."""
    write_json(_marker(path), {"key": key})
