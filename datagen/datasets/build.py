"""The label sets of a training run: simulate or read the drives, map, label; whatever is there is kept.

Training and validation labels come from maps, never from the simulator's truth; the truth only scores.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from datagen.datasets.done import fingerprint, forget_done, is_done, key_of, make_once, mark_done
from datagen.datasets.settings import DataSettings, RecordedSettings
from datagen.datasets.splits import split_along_time, split_by_lap
from datagen.labels.truth import truth_labels
from datagen.pipeline import MapSettings, label_map, map_drive
from datagen.world.simulate import SimulationSettings, simulate_drive
from datagen.world.variety import first_world, vary_simulation
from lanenet.data.files import write_text
from lanenet.data.label_set import LabelSet, read_labels, write_labels
from lanenet.errors import CalibrationError, ConfigError, TrackingLostError
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.processes import run_jobs

Progress = Callable[[int, int], None]
Role = Literal["train", "validation", "test"]
#: Of each role so many synthetic drives get pictures of map and labels; nobody looks at those of hundreds.
_PICTURED = 2


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
        left_out: Why some synthetic drives are not among them.
    """

    train: list[Path]
    validation: list[Path]
    test: list[Path]
    validation_frames: list[Path]
    test_frames: list[Path]
    camera: Path | None
    example: Path | None
    left_out: tuple[str, ...] = ()


def prepare(
    settings: DataSettings,
    work_dir: Path,
    progress: Progress | None = None,
    last: Callable[[Path], object] | None = None,
) -> PreparedData:
    """Make the label sets that are not there yet.

    Each drive is one job in its own process; what a job has finished stays, so that a killed run goes on
    where it stopped. A label set is made again when its settings have changed.

    Args:
        settings: The data of a run.
        work_dir: Folder for drives, maps and label sets.
        progress: Called with (jobs done, jobs).
        last: Called with a label set to learn from, in a process that would be idle while others finish the
            last synthetic drives: compiles what comes next. A function of a module.

    Raises:
        ConfigError: If no part has any drive.
        TrackingLostError: If more drives fail than may.
        LanenetError: What the first failing job raised; or that its process died, naming the drive.
    """
    jobs: list[dict[str, Any]] = []
    for role in ("train", "validation", "test"):
        for number in range(getattr(settings.synthetic, role)):
            jobs.append(_synthetic_job(settings, role, number, work_dir))
    for drive in settings.drives:
        recorded = {
            "kind": "recorded",
            "settings": drive,
            "window": settings.window,
            "colour_weight": settings.colour_weight,
            "folder": work_dir / "drives",
        }
        jobs.append(recorded)
    for role in ("train", "validation"):
        if not settings.drives and not getattr(settings.synthetic, role):
            raise ConfigError(f"data: no {role} drives; set data.synthetic.{role} or list data.drives")
    # The first drive that is mapped compiles what all others use; the test drives, which need little of that,
    # go beside it, so that no second process compiles the same.
    jobs[1:] = sorted(jobs[1:], key=lambda job: job.get("role") != "test")
    named = [(_job_name(job), job) for job in jobs]
    made = [_labels_of(job) for job in jobs if job.get("role") == "train"]
    if last is not None and made:
        named.append(("compiling", {"kind": "last", "call": last, "label_sets": made}))
    results = run_jobs(_run_job, named, settings.processes, progress)[: len(jobs)]
    parts: dict[Role, list[Path]] = {"train": [], "validation": [], "test": []}
    frames: dict[Role, list[Path]] = {"train": [], "validation": [], "test": []}
    left_out = []
    for job, result in zip(jobs, results, strict=True):
        if isinstance(result, str):
            left_out.append(f"{_job_name(job)}: {result}")
            continue
        for role, path in result.items():
            # Named several times, a recording counts as several drives to learn from.
            times = job["settings"].counts_as if job["kind"] == "recorded" and role == "train" else 1
            parts[role] += [path] * times
            frames[role].append(_frames_of(job))
    _check_left_out(settings, left_out)
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
        tuple(left_out),
    )


def _check_left_out(settings: DataSettings, left_out: list[str]) -> None:
    mapped = settings.synthetic.train + settings.synthetic.validation
    allowed = settings.synthetic.may_fail * mapped
    if len(left_out) > allowed:
        raise TrackingLostError(
            f"{len(left_out)} of {mapped} synthetic drives to be mapped give no labels, "
            f"expected at most {allowed:.0f} (data.synthetic.may_fail); the first: {left_out[0]}"
        )


def _job_name(job: dict[str, Any]) -> str:
    """What people know a drive by."""
    if job["kind"] == "recorded":
        return str(job["settings"].path)
    return f"{job['name']} (seed {job['simulation'].seed})"


def _frames_of(job: dict[str, Any]) -> Path:
    """Folder that leads to the frames of a job's label sets: a drive with truth, or a map."""
    if job["kind"] == "recorded":
        return Path(job["folder"]) / "maps" / _recorded_name(job["settings"])
    return Path(job["folder"]) / ("drives" if job["role"] == "test" else "maps") / job["name"]


def _shared_camera(settings: DataSettings, work_dir: Path) -> Path | None:
    """Camera file of the run's drives, if they share one: the simulation's, or the only recording's.

    Where every drive has its own, that of the drive that the example is from.
    """
    synthetic = settings.synthetic
    if synthetic.variety == "all" and synthetic.test:
        return work_dir / "synthetic" / "drives" / "test_00" / "camera.yaml"
    if not settings.drives and synthetic.train and synthetic.variety != "all":
        return work_dir / "synthetic" / "drives" / "train_00" / "camera.yaml"
    if len(settings.drives) == 1 and not (synthetic.train or synthetic.validation or synthetic.test):
        return work_dir / "drives" / "maps" / _recorded_name(settings.drives[0]) / "camera.yaml"
    return None


def _recorded_name(settings: RecordedSettings) -> str:
    """Name of a recording's outputs; two drives may have folders of the same name."""
    return f"{settings.path.resolve().name}-{key_of([str(settings.path.resolve())])[:6]}"


def _synthetic_job(settings: DataSettings, role: Role, number: int, work_dir: Path) -> dict[str, Any]:
    # Roles draw from separate streams, so that more training drives leave the test drives as they are.
    stream = ("train", "validation", "test").index(role)
    synthetic = settings.synthetic
    varied = synthetic.variety != "none"
    simulation = vary_simulation(
        synthetic.simulation,
        np.random.SeedSequence([synthetic.seed, stream, number]),
        number,
        cameras=(synthetic.cameras or (synthetic.simulation.camera,)) if synthetic.variety == "all" else (),
        road=varied,
        driver=varied,
    )
    name = f"{role}_{number:02d}"
    return {
        "kind": "synthetic",
        "role": role,
        "name": name,
        "simulation": simulation,
        "pictures": number < _PICTURED,
        "may_fail": role != "test" and synthetic.may_fail > 0.0,
        # The simulated camera does not see its car.
        "map": settings.map.model_copy(update={"find_bumper": False}),
        "window": settings.window,
        "colour_weight": settings.colour_weight,
        "folder": work_dir / "synthetic",
    }


def _labels_of(job: dict[str, Any]) -> Path:
    """Label set of a synthetic drive."""
    return Path(job["folder"]) / "labels" / f"{job['name']}.parquet"


def _run_job(job: dict[str, Any]) -> dict[Role, Path] | str:
    """Make one drive's label sets, or say why it has none; runs in a process of its own."""
    if job["kind"] == "last":
        path = next((path for path in job["label_sets"] if path.is_file()), None)
        if path is not None:
            job["call"](path)
        return {}
    if job["kind"] == "synthetic":
        made = _synthetic_labels(job)
        return made if isinstance(made, str) else {job["role"]: made}
    return _recorded_labels(job["settings"], job["window"], job["colour_weight"], job["folder"])


def _synthetic_labels(job: dict[str, Any]) -> Path | str:
    folder: Path = job["folder"]
    simulation: SimulationSettings = job["simulation"]
    drive, drive_map = folder / "drives" / job["name"], folder / "maps" / job["name"]
    labels = _labels_of(job)
    window, colour_weight = job["window"], job["colour_weight"]
    driven = simulation.model_dump(mode="json")
    parts = [driven, job["role"], asdict(window), colour_weight]
    # The truth needs no map, but its edges are found in the same way.
    mapping: MapSettings = job["map"]
    parts.append((mapping.perception if job["role"] == "test" else mapping).model_dump(mode="json"))
    key = key_of(parts)
    failure = labels.with_suffix(".failed.txt")
    if is_done(labels, key):
        return labels
    if is_done(failure, key):
        return failure.read_text(encoding="utf-8")
    # From here on, what lies there is neither the old labels nor the new ones.
    forget_done(labels)

    def simulate() -> None:
        # Of a random road, that of the first seed that leaves room for one.
        seed = first_world(simulation).settings.seed
        simulate_drive(simulation.model_copy(update={"seed": seed}), drive)

    try:
        make_once(drive / "drive.yaml", key_of([driven]), simulate)
        if job["role"] == "test":
            perception = mapping.perception.with_colours(colour_weight)
            write_labels(labels, truth_labels(drive, perception, window, simulation.track.line_width_cm))
        else:
            lane_cm, pictures = simulation.track.lane_width_cm, job["pictures"]
            make_once(
                drive_map / "map.yaml",
                key_of([driven, mapping.model_dump(mode="json")]),
                lambda: map_drive(drive, lane_cm, None, mapping, drive_map, pictures=pictures),
            )
            label_map(drive_map, labels, window=window, colour_weight=colour_weight, pictures=pictures)
    except (TrackingLostError, CalibrationError, ConfigError) as error:
        if not job["may_fail"]:
            raise
        write_text(failure, str(error))
        mark_done(failure, key)
        return str(error)
    mark_done(labels, key)
    return labels


def _recorded_labels(
    settings: RecordedSettings, window: BirdseyeWindow, colour_weight: float, folder: Path
) -> dict[Role, Path]:
    """Map and label a recorded drive, and split it: to learn from, to choose by, to judge by."""
    name = _recorded_name(settings)
    drive_map, whole = folder / "maps" / name, folder / "labels" / f"{name}.parquet"
    recording = [fingerprint(settings.path)]
    if settings.camera is not None and settings.camera.is_file():
        recording.append(fingerprint(settings.camera))
    key = key_of([settings.model_dump(mode="json"), asdict(window), colour_weight, *recording])
    # A map takes minutes, and does not change with the window, the colours or the split.
    mapped = settings.model_dump(mode="json", include={"path", "lane_width_cm", "camera", "map"})
    parts: dict[Role, Path] = {
        role: folder / "labels" / f"{name}.{role}.parquet" for role in ("train", "validation", "test")
    }
    if not (is_done(whole, key) and all(path.is_file() for path in parts.values())):
        forget_done(whole)
        make_once(
            drive_map / "map.yaml",
            key_of([mapped, *recording]),
            lambda: map_drive(
                settings.path, settings.lane_width_cm, settings.camera, settings.map, drive_map
            ),
        )
        label_map(drive_map, whole, window=window, colour_weight=colour_weight)
        pieces = _split(read_labels(whole), settings)
        for path, piece in zip(parts.values(), pieces, strict=True):
            write_labels(path, piece)
        mark_done(whole, key)
    return parts


def _split(labels: LabelSet, settings: RecordedSettings) -> list[LabelSet]:
    if settings.split == "lap":
        return split_by_lap(labels, settings.gap_frames, settings.gap_cm)
    shares = (settings.train_share, settings.validation_share)
    return split_along_time(labels, shares, settings.gap_frames, settings.gap_cm)
