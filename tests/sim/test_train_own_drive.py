"""``lanenet train DRIVE``, whole: from map to video; again, from its map, resumed, and refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner, Result

from datagen.world.simulate import simulate_drive
from datagen.world.world import SimulationSettings
from lanenet.cli.app import app
from lanenet.data.camera_file import read_camera
from lanenet.data.drives import open_drive
from lanenet.data.drives.folder import DriveWriter
from lanenet.data.label_set import read_labels

# `make test-slow`.
pytestmark = pytest.mark.slow

#: Half of these are one part for the validation, with the gaps before and after it; 10 m of road with labels.
FRAMES = 400


def train(*words: str) -> Result:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COLUMNS", "200")
        return CliRunner().invoke(app, ["train", *words])


@pytest.fixture(scope="module")
def here(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("own")
    simulate_drive(SimulationSettings(frames=FRAMES, seed=3), folder / "drive")
    return folder


@pytest.fixture(scope="module")
def first(here: Path) -> str:
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(here)
        result = train("drive", "--lane-width", "40", "--name", "mycar", "learn.epochs=1")
    assert result.exit_code == 0, result.output
    return result.stdout


@pytest.fixture(autouse=True)
def work_here(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(here)


def made(here: Path) -> dict[Path, int]:
    """Maps, label sets and networks with their times."""
    runs = here / "runs"
    kinds = [*runs.rglob("map.yaml"), *runs.rglob("*.parquet"), *runs.rglob("last.pt")]
    return {path: path.stat().st_mtime_ns for path in kinds}


def test_one_command_goes_from_a_drive_to_a_network(here: Path, first: str) -> None:
    at = [
        first.index(f"[{k + 1}/6] {name}")
        for k, name in enumerate(["map", "label", "train", "test", "export", "video"])
    ]
    assert at == sorted(at)
    assert "verdict: good: " in first and first.count("verdict: ") == 2
    assert "left in all" in first and "all stages are done" in first
    (report,) = here.glob("runs/mycar/drives/maps/drive-*/report.html")
    assert f"report: {report.relative_to(here)}" in first
    # Tested on frames that are later than those it learned from.
    labels = here / "runs" / "mycar" / "drives" / "labels"
    parts = {role: read_labels(next(labels.glob(f"*.{role}.parquet"))) for role in ("train", "test")}
    assert parts["train"].frame[-1] + 40 < parts["test"].frame[0]
    assert "which it had not seen, it lies" in first
    assert {"model.onnx", "run.yaml", "MODEL_CARD.md", "DATA_SHEET.md", "camera.yaml"} <= {
        path.name for path in (here / "checkpoints" / "mycar").iterdir()
    }
    sheet = json.loads((here / "checkpoints" / "mycar" / "data_sheet.json").read_text())
    assert sheet["parts"]["train"]["frames"] == len(parts["train"])
    # 16 s at 20 Hz, less the gaps between the parts and what has no labels.
    assert 0.1 < sum(part["minutes"] for part in sheet["parts"].values()) < 16.0 / 60.0
    (drive,) = sheet["recorded"]
    assert (drive["name"], drive["lane_width_cm"], drive["licence"]) == ("drive", 40.0, None)
    assert (here / "runs" / "mycar" / "test.mp4").stat().st_size > 10_000
    seen = np.loadtxt(here / "runs" / "mycar" / "test.csv", delimiter=",", skiprows=1, usecols=0)
    assert seen[0] == parts["test"].frame[0] and seen[-1] == parts["test"].frame[-1]
    assert "then lanenet doctor --config checkpoints/mycar/car.yaml" in first.replace("\n", " ")
    # All of it is in the log, with times, and what is left of the stages.
    log = (here / "runs" / "mycar" / "train.log").read_text()
    for line in first.splitlines()[1:]:
        assert line.strip() in log or "│" in line or "─" in line or not line.strip() or "RMSE" in line
    assert "map: " in log and "of 100" in log


def test_a_label_set_gives_what_its_map_gives(here: Path, first: str) -> None:
    (of_map,) = here.glob("runs/mycar/drives/maps/drive-*")
    result = CliRunner().invoke(app, ["label", str(of_map), "--out", "set.parquet"])
    assert result.exit_code == 0, result.output
    result = train("set.parquet", "--name", "fromset", "learn.epochs=1")
    assert result.exit_code == 0, result.output
    assert "holds no images" in result.stderr and "holds no camera" not in result.stderr
    read = {}
    for name in ("mycar", "fromset"):
        results = json.loads((here / "checkpoints" / name / "results.json").read_text())
        read[name] = results["detectors"]["network"]["groups"]["all"]["rmse_cm"]
    # A label set does not hold how the car moved, which the lane filter takes.
    assert read["fromset"] == pytest.approx(read["mycar"], abs=0.05)
    own, other = (here / "checkpoints" / name / "camera.yaml" for name in ("mycar", "fromset"))
    assert read_camera(own).hash == read_camera(other).hash


def test_its_config_does_the_same_from_another_folder(
    here: Path, first: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = made(here)
    monkeypatch.chdir(tmp_path)
    result = train(str(here / "runs" / "mycar" / "mycar.yaml"))
    assert result.exit_code == 0, result.output
    assert "a finished map, which is used" in result.stdout
    assert "the network was trained before with these labels and settings: it is used" in result.stdout
    assert made(here) == before and not list(tmp_path.iterdir())


def test_another_name_takes_the_finished_map(here: Path, first: str) -> None:
    result = train("drive", "--lane-width", "40", "--name", "second", "learn.epochs=1")
    assert result.exit_code == 0, result.output
    assert "runs/mycar/drives/maps" in result.stdout and "a finished map, which is used" in result.stdout
    assert not list((here / "runs" / "second").rglob("map.yaml"))
    # From its label set, without frames: all but the video.
    whole = next(
        path for path in here.glob("runs/second/drives/labels/*.parquet") if path.stem.count(".") == 0
    )
    result = train(str(whole), "--name", "third", "learn.epochs=1")
    assert result.exit_code == 0, result.output
    assert "has labels already, which are used" in result.stdout
    assert "no video, since a label set holds no images" in result.stdout
    assert (here / "checkpoints" / "third" / "model.onnx").is_file()


def test_a_stopped_run_resumes_and_says_so(here: Path, first: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def stopped(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    words = ("drive", "--lane-width", "40", "--name", "stopped", "learn.epochs=1")
    with monkeypatch.context() as patch:
        patch.setattr("lanenet.evaluation.comparison.evaluate", stopped)
        assert train(*words).exit_code == 130
    assert not (here / "checkpoints" / "stopped").exists()
    assert (here / "runs" / "stopped" / "train.log").read_text().endswith(" interrupted\n")
    before = made(here)
    result = train(*words)
    assert result.exit_code == 0, result.output
    assert "resumes: the last run of this name stopped in the stage test; what it finished " in result.stdout
    assert made(here) == before


def test_a_network_of_another_drive_is_replaced_only_with_force(here: Path, first: str) -> None:
    model = (here / "checkpoints" / "mycar" / "weights.safetensors").read_bytes()
    empty_road(here / "other")
    words = ("other", "--lane-width", "40", "--name", "mycar")
    result = train(*words)
    assert result.exit_code == 1 and f"taken by a network of {here / 'drive'}" in result.stderr
    config = (here / "runs" / "mycar" / "mycar.yaml").read_text()
    assert str(here / "drive") in config
    # With force it is begun, and stops at the map.
    forced = train(*words, "--force")
    assert forced.exit_code == 1 and "taken by" not in forced.stderr and "[1/6] map" in forced.stdout
    assert (here / "checkpoints" / "mycar" / "weights.safetensors").read_bytes() == model


def empty_road(path: Path) -> None:
    """The frames of the drive without a lane."""
    drive = open_drive(path.parent / "drive")
    if path.exists():
        return
    rng = np.random.default_rng(0)
    with DriveWriter(path, camera=drive.camera, lane_width_cm=40.0) as writer:
        for k in range(70):
            frame = rng.normal(90.0, 3.0, (drive.height, drive.width, 3)).clip(0, 255).astype(np.uint8)
            writer.add(frame, 0.05 * k, speed_cm_s=50.0, steering_rad=0.0)


def test_a_refused_drive_stops_with_cause_remedy_and_report(here: Path) -> None:
    empty_road(here / "empty")
    result = train("empty", "--lane-width", "40", "--name", "none")
    assert result.exit_code == 1 and len([x for x in result.stderr.splitlines() if "error" in x]) == 1
    (report,) = here.glob("runs/none/drives/maps/empty-*/report.html")
    error = next(line for line in result.stderr.splitlines() if "error" in line)
    assert "drive two laps" in error and f"see {report.relative_to(here)}" in error
    assert "[2/6]" not in result.stdout and not (here / "checkpoints" / "none").exists()
    assert error.removeprefix("error: ") in (here / "runs" / "none" / "train.log").read_text()


def test_of_a_map_that_is_not_good_all_findings_are_said(
    here: Path, first: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    (found,) = here.glob("runs/mycar/drives/maps/drive-*")
    doubtful = tmp_path / "doubtful"
    shutil.copytree(found, doubtful)
    report = json.loads((doubtful / "report.json").read_text())
    report["verdict"] |= {"grade": "usable", "sentence": "so", "reasons": ["p95 1.6 px", "pitch open"]}
    (doubtful / "report.json").write_text(json.dumps(report))
    monkeypatch.setattr("datagen.datasets.build.prepare", stopped)
    result = train(str(doubtful), "--name", "doubtful")
    assert "  verdict: usable: so\n  p95 1.6 px\n  pitch open\n" in result.stdout


def test_a_rejected_map_stops_with_its_verdict(here: Path, first: str, tmp_path: Path) -> None:
    (found,) = here.glob("runs/mycar/drives/maps/drive-*")
    bad = tmp_path / "bad"
    shutil.copytree(found, bad)
    report = json.loads((bad / "report.json").read_text())
    report["verdict"] |= {"grade": "reject", "sentence": "the lines are not there: renew the tape"}
    (bad / "report.json").write_text(json.dumps(report))
    meta = yaml.safe_load((bad / "map.yaml").read_text())
    (bad / "map.yaml").write_text(yaml.safe_dump({**meta, "verdict": "reject"}))
    result = train(str(bad), "--name", "bad")
    assert result.exit_code == 1 and "[2/6]" not in result.stdout
    assert "the map was rejected: the lines are not there: renew the tape; see " in result.stderr
    assert f"{bad / 'report.html'}" in result.stderr
