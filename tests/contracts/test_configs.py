from __future__ import annotations

import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recordings import lap, write_recording

from datagen.slam.settings import GuessSettings
from lanenet.calibration.lens import camera_of_lens
from lanenet.cli.train import run_settings_schema
from lanenet.config import check_settings, load_settings, read_yaml
from lanenet.errors import ConfigError
from lanenet.geometry.camera import NOMINAL_WHEELBASE_CM

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
#: Those that ship, and those of the tests.
TRAINING_RUNS = sorted([*CONFIGS.glob("*.y*ml"), *(CONFIGS.parent / "tests" / "configs").glob("*.y*ml")])
ALL_FILES = sorted(CONFIGS.rglob("*.y*ml"))


def read_training_run(path: Path) -> Any:
    return load_settings(run_settings_schema(), path)


def read_simulation(path: Path) -> Any:
    from datagen.world.world import SimulationSettings

    return load_settings(SimulationSettings, path)


def read_track(path: Path) -> Any:
    from synthetic_roads import load_track

    return load_track(path)


def read_camera_file(path: Path) -> Any:
    from lanenet.data.camera_file import read_camera

    return read_camera(path)


def read_detector_settings(path: Path) -> Any:
    from lanenet.perception.estimate import DetectorInputs
    from lanenet.perception.lane_filter import lane_filter_settings
    from lanenet.perception.network.detector import NetworkDetectorSettings
    from lanenet.perception.registry import build_detector

    if path.stem == "network":
        return load_settings(NetworkDetectorSettings, path)
    # The detector's name comes first in the file's.
    if path.stem.startswith("lane_filter"):
        return lane_filter_settings(DetectorInputs(config=path, drive_lane_width_cm=40.0))
    return build_detector(path.stem.partition("_")[0], DetectorInputs(config=path))


def read_donkeycar_pilot(path: Path) -> Any:
    from lanenet.onboard.donkey import LanePilot

    return LanePilot.from_file(path)


def read_car(path: Path) -> Any:
    from lanenet.onboard.drive import load_drive_settings

    # Those that are copied beside the camera file of a car have none here.
    named = read_yaml(path).get("camera")
    here = named is None or (path.parent / named).is_file()
    camera = CONFIGS.parent / "checkpoints" / "small" / "camera.yaml"
    return load_drive_settings(path, [] if here else [f"camera={camera}"])


def read_contest(path: Path) -> Any:
    from datagen.judge.settings import JudgeSettings, contest_roads
    from lanenet.config import check_settings, read_yaml

    settings = check_settings(JudgeSettings, read_yaml(path), str(path))
    return contest_roads(
        settings.model_copy(update={"count": 1, "counts": dict.fromkeys(settings.counts, 1)})
    )


#: What reads the YAML files of each folder below configs/.
READERS = {
    ".": read_training_run,
    "car": read_car,
    "drives": read_simulation,
    "tracks": read_track,
    "cameras": read_camera_file,
    "detectors": read_detector_settings,
    "judge": read_contest,
    "donkeycar": read_donkeycar_pilot,
}


def test_the_config_of_the_readme_ships() -> None:
    assert CONFIGS / "small.yaml" in ALL_FILES


@pytest.mark.parametrize("path", ALL_FILES, ids=lambda path: str(path.relative_to(CONFIGS)))
def test_every_shipped_config_loads(path: Path) -> None:
    kind = str(path.parent.relative_to(CONFIGS))
    assert kind in READERS, f"say in this test what reads the files of configs/{kind}"
    READERS[kind](path)


@pytest.mark.parametrize("path", TRAINING_RUNS, ids=lambda path: path.name)
def test_a_training_run_is_named_after_its_file(path: Path) -> None:
    # checkpoints/<name>/ then tells which config made it, and two configs never share a folder.
    assert read_training_run(path).name == path.stem


def write_quick_labels(path: Path, window: Any, source: str, camera: str) -> None:
    """Straight lanes with both edges of their tapes, a few frames of each of three laps."""
    import numpy as np

    from lanenet.data.label_set import LabelMeta, LabelSet, write_labels

    n, y = 60, np.arange(1.0, window.far_cm, 1.0)
    shift = np.linspace(-3.0, 3.0, n)
    sides = (-16.0, -14.0, 14.0, 16.0)
    line = np.stack([0.0 * y, np.linspace(-20.0, 90.0, len(y))], axis=1)
    edges = [
        np.concatenate([np.stack([y * 0 + x + s, y, y * 0 + 1, y * 0, y * 0, y * 0], axis=1) for x in sides])
        for s in shift
    ]
    labels = LabelSet(
        LabelMeta(window, camera, 17.0, 30.0, source),  # type: ignore[arg-type]
        drive=[path.stem] * n,
        file=[""] * n,
        frame=100 * np.arange(n),
        t_s=np.arange(n, dtype=np.float64),
        lap=np.repeat([0, 1, 2], n // 3),
        poses=np.stack([200.0 * np.arange(n), np.zeros(n), np.zeros(n)], axis=1),
        points_cm=np.stack([s + np.repeat([-15.0, 15.0], 3) for s in shift]),
        edges=[edge.astype(np.float32) for edge in edges],
        lines=[(line + [s - 15.0, 0.0], line + [s + 15.0, 0.0]) for s in shift],
        quality=np.ones(n),
        divides=np.zeros((n, 2), dtype=bool),
    )
    write_labels(path, labels)


def prepare_quickly(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Make the data of a config without driving and mapping, which take minutes: straight lanes instead.

    So the window and the split are those of the file.
    """
    from datagen.datasets import build, jobs

    def map_drive(request: Any, settings: Any, out: Path, pictures: bool = True, **_: Any) -> None:
        assert request.lane_width_cm > 20.0

    def label_map(
        drive_map: Path, out: Path, *, window: Any, colour_weight: float, pictures: bool = True
    ) -> None:
        write_quick_labels(out, window, "map", drive_map.name)

    def truth_labels(drive: Path, perception: Any, window: Any, marking_cm: float) -> Path:
        write_quick_labels(tmp_path / "truth.parquet", window, "truth", drive.name)
        return tmp_path / "truth.parquet"

    monkeypatch.setattr(jobs, "simulate_drive", lambda simulation, out: out)
    monkeypatch.setattr(jobs, "map_drive", map_drive)
    monkeypatch.setattr(jobs, "label_map", label_map)
    monkeypatch.setattr(jobs, "truth_labels", truth_labels)
    monkeypatch.setattr(jobs, "write_labels", write_or_move)
    monkeypatch.setattr(jobs, "fingerprint", str)
    # Reads all images; tested in test_leaks.py.
    monkeypatch.setattr(build, "refuse_leaks", lambda *_: ())
    data = read_training_run(path).data
    few = {"train": 2, "validation": 1, "test": 1} if data.synthetic.train else {}
    # Whoever uses the config has the drives, the tests have not.
    drives = [
        drive.model_copy(update={"path": write_recording(tmp_path / drive.path.name, lap(k, 40))})
        for k, drive in enumerate(data.drives)
    ]
    synthetic = data.synthetic.model_copy(update=few)
    data = data.model_copy(update={"synthetic": synthetic, "drives": tuple(drives), "workers": 1})
    prepared = build.prepare(data, tmp_path / "work")
    assert len(prepared.train) == few.get("train", 0) + len(drives)
    for role in ("validation", "test"):
        parts = prepared.of(role)
        assert parts and all(part.labels.is_file() for part in parts)
    return prepared


@pytest.mark.parametrize("path", TRAINING_RUNS, ids=lambda path: path.name)
def test_the_data_of_a_training_run_is_made(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    prepare_quickly(path, tmp_path, monkeypatch)


def test_make_trains_the_general_network_with_the_real_drives_of_a_library(tmp_path: Path) -> None:
    """One config: what make adds to it is read, and lists the drives beside the simulated ones."""
    from datagen.datasets.from_library import with_library
    from lanenet.data.library import Library

    library = Library.open(tmp_path / "drives.sqlite", create=True)
    for seed, (name, licence) in enumerate({"hall": "MIT", "yard": "CC0-1.0"}.items()):
        drive = write_recording(tmp_path / name, lap(seed, 40))
        library.add(drive, track=name, licence=licence, lane_width_cm=40.0)
    words = ["general", f"LIBRARY={library.path}", "GENERAL=data.library.split=train data.library.weight=0.3"]
    command = ["make", "--dry-run", "--no-print-directory", "--assume-old=.venv/.stamp-train", *words]
    said = subprocess.run(command, capture_output=True, text=True, check=True, cwd=CONFIGS.parent).stdout
    config, *overrides = said.replace("\\\n", " ").partition("lanenet train")[2].split()
    settings: Any = load_settings(run_settings_schema(), CONFIGS.parent / config, overrides)
    assert settings.name == "general-real" and settings.data.synthetic.train == 700
    data, _ = with_library(settings.data)
    found = [(drive.track, drive.licence, drive.split, drive.weight) for drive in data.drives]
    assert found == [("hall", "MIT", "train", 0.3), ("yard", "CC0-1.0", "train", 0.3)]


@pytest.mark.parametrize("target", ["train", "general"])
def test_make_trains_into_a_folder_that_git_ignores(target: str, tmp_path: Path) -> None:
    """What ships is then neither replaced by a training nor taken for its result."""
    command = ["make", "--dry-run", "--no-print-directory", "--assume-old=.venv/.stamp-train", target]
    said = subprocess.run(command, capture_output=True, text=True, check=True, cwd=CONFIGS.parent).stdout
    config, *overrides = said.partition("lanenet train")[2].split()
    settings: Any = load_settings(run_settings_schema(), CONFIGS.parent / config, overrides)
    for folder in (settings.checkpoints_dir / settings.name, settings.work_folder):
        # In a repository of its own: the tests also run where only the files are.
        shutil.copy(CONFIGS.parent / ".gitignore", tmp_path)
        subprocess.run(["git", "init", "--quiet", tmp_path], check=True)
        subprocess.run(
            ["git", "-C", tmp_path, "check-ignore", "--quiet", folder / "metrics.json"], check=True
        )


#: The others are trained by `make chain`, a stage of the gate, but for alexnet.yaml: its network is that of
#: paper_split.yaml, too.
FAST = ("small.yaml",)


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, id=path.name, marks=[] if path.name in FAST else [pytest.mark.slow])
        for path in TRAINING_RUNS
    ],
)
def test_a_training_run_takes_two_steps(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The network, the augmentation and what it starts from are those of the file, too."""
    from lanenet.learn.checkpoint import publish
    from lanenet.learn.train import train

    prepared = prepare_quickly(path, tmp_path, monkeypatch)
    settings = read_training_run(path)
    n = sum(len(read_labels_of(p)) for p in prepared.train)
    learn = settings.learn.model_copy(update={"epochs": 1, "batch_size": n // 2, "threads": 1})
    if learn.start_from is not None:
        anew = train(
            learn.model_copy(update={"start_from": None}), prepared.train, prepared.validation, tmp_path / "s"
        )
        publish(anew.folder, tmp_path / "start", "start", {})
        learn = learn.model_copy(update={"start_from": tmp_path / "start"})
    result = train(learn, prepared.train, prepared.validation, tmp_path / "run")
    assert result.model_path.is_file() and result.val_rmse_cm < 100.0


def write_or_move(path: Path, labels: Any) -> None:
    """Write a part of a label set, or put one that lies elsewhere in its place."""
    from lanenet.data.label_set import write_labels

    if isinstance(labels, Path):
        labels.rename(path)
    else:
        write_labels(path, labels)


def read_labels_of(path: Path) -> Any:
    from lanenet.data.label_set import read_labels

    return read_labels(path)


def test_the_lane_filters_files_are_the_default_and_the_paper() -> None:
    from lanenet.perception.edges.road import PerceptionSettings
    from lanenet.perception.lane_filter import PAPER, LaneFilterSettings

    default = read_detector_settings(CONFIGS / "detectors" / "lane_filter.yaml")
    assert default == (LaneFilterSettings(lane_width_cm=40.0), PerceptionSettings())
    filter_, perception = read_detector_settings(CONFIGS / "detectors" / "lane_filter_paper.yaml")
    assert filter_ == LaneFilterSettings(lane_width_cm=40.0, **PAPER)
    assert perception.edges.method == "canny"


def test_a_misspelt_key_is_named() -> None:
    data = read_yaml(CONFIGS / "small.yaml")
    with pytest.raises(ConfigError, match="'lern', did you mean 'learn'"):
        check_settings(run_settings_schema(), {**data, "lern": {}}, "small.yaml")


@pytest.mark.parametrize("path", TRAINING_RUNS, ids=lambda path: path.name)
def test_what_a_config_starts_from_fits_its_network_and_window(path: Path) -> None:
    from lanenet.learn.checkpoint import load_start_weights
    from lanenet.learn.network import new_network

    settings = read_training_run(path)
    folder, data = settings.learn.start_from, settings.data
    if folder is None:
        pytest.skip("starts from random weights")
    network = new_network(settings.learn.network, data.window.rows, data.window.columns, settings.learn.seed)
    # As labels are made: like the map, and by colours.
    seen = data.map.perception.with_colours(data.colour_weight)
    load_start_weights(network, CONFIGS.parent / folder, data.window, seen)


def test_the_wheelbase_is_one_number_in_all_templates() -> None:
    """That of the camera file where there is one; else, and where nobody gave it, the nominal one."""
    for path in [*(CONFIGS / "car").glob("*.yaml"), *(CONFIGS / "donkeycar").glob("*.yaml")]:
        data = read_yaml(path)
        found = data["control"]["steering"].get("wheelbase_cm")
        assert found == (None if "camera" in data else NOMINAL_WHEELBASE_CM), path
    assert GuessSettings().wheelbase_cm == NOMINAL_WHEELBASE_CM
    lens = np.array([100.0, 100.0, 80.0, 60.0, 0.0, 0.0, 0.0, 0.0])
    assert camera_of_lens("fisheye", lens, (160, 120)).wheelbase_cm == NOMINAL_WHEELBASE_CM
