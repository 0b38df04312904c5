"""Commands that take a model: file or folder, cameras and lanes that it was not trained with, what next."""

from __future__ import annotations

import shlex
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from detections import read_detections
from typer.testing import CliRunner, Result

from lanenet.cli import app as cli
from lanenet.data.camera_file import read_camera, write_camera
from lanenet.data.drives.folder import DriveWriter
from lanenet.data.label_set import LabelMeta, LabelSet, write_labels
from lanenet.errors import LanenetError
from lanenet.onboard.bench import LANE_WIDTH_CM, example_frames
from lanenet.perception.network.model_file import read_model_meta

CHECKPOINT = Path(__file__).resolve().parents[3] / "checkpoints" / "small"
CAMERA = CHECKPOINT / "camera.yaml"
META = read_model_meta(CHECKPOINT)


def run(*words: str | Path) -> Result:
    result = CliRunner().invoke(cli.app, [str(word) for word in words], env={"COLUMNS": "200"})
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result


def error_of(result: Result) -> str:
    (line,) = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
    assert result.exit_code == 1
    return line


def width_warnings(result: Result) -> list[str]:
    return [line for line in result.stderr.splitlines() if line.startswith("warning: lane width ")]


def next_words(result: Result) -> list[str]:
    """The command after the last ``next:``."""
    assert result.exit_code == 0, result.output
    line = [line for line in result.stdout.splitlines() if line.startswith("next: lanenet ")][-1]
    return shlex.split(line)[2:]


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """A painted drive of the camera that the model knows, on the lane that it knows."""
    with DriveWriter(tmp_path / "drive", read_camera(CAMERA), LANE_WIDTH_CM) as writer:
        for k, frame in enumerate(example_frames(read_camera(CAMERA), 6, np.random.default_rng(0))):
            writer.add(frame, 0.05 * k, throttle=0.2)
    return tmp_path / "drive"


@pytest.fixture
def simulation(tmp_path: Path) -> Path:
    path = tmp_path / "simulation.yaml"
    path.write_text("frames: 3\n")
    return path


@pytest.fixture
def car(tmp_path: Path, drive: Path) -> Path:
    """A car that replays the drive."""
    data = {
        "source": {"kind": "replay", "path": str(drive), "pace": "fast"},
        "camera": str(CAMERA),
        "detector": {"kind": "network", "model": str(CHECKPOINT)},
        "control": {"steering": {"look_ahead_cm": 20.0}},
        # On a busy machine a frame may be old before it is answered.
        "safety": {"countdown_s": 0.0, "max_age_s": 0.5},
    }
    path = tmp_path / "car.yaml"
    path.write_text(yaml.safe_dump(data))
    return path


def label_set(path: Path, camera_hash: str) -> Path:
    """Two straight lines, seen by a camera."""
    y = np.arange(1.0, 60.0, 0.3)
    edges = [np.stack([y * 0 + x, y, y * 0 + np.sign(x), y * 0, y * 0, y * 0], axis=1) for x in (-20.0, 20.0)]
    line = np.array([[-20.0, -20.0], [-20.0, 60.0]])
    labels = LabelSet(
        LabelMeta(META.window, camera_hash, 26.0, 40.0, "map", META.perception),
        drive=["d"] * 2,
        file=[""] * 2,
        frame=np.arange(2),
        t_s=np.arange(2) * 0.05,
        lap=np.zeros(2, np.int64),
        poses=np.zeros((2, 3)),
        points_cm=np.tile(np.repeat([-20.0, 20.0], 3), (2, 1)),
        edges=[np.concatenate(edges).astype(np.float32)] * 2,
        lines=[(line, line + [40.0, 0.0])] * 2,
        quality=np.ones(2),
        divides=np.zeros((2, 2), dtype=bool),
    )
    write_labels(path, labels)
    return path


def test_commands_take_the_folder_for_the_model(
    tmp_path: Path, drive: Path, car: Path, simulation: Path
) -> None:
    network = ("--detector", "network", "--model", CHECKPOINT)
    result = run("detect", drive, "--model", CHECKPOINT, "--out", tmp_path / "l.csv")
    assert result.exit_code == 0, result.output
    assert np.isfinite(read_detections(tmp_path / "l.csv").points_cm).all()
    for words in (
        ("drive", car, "--dry-run"),
        ("simulate", simulation, *network, "--out", tmp_path / "d"),
        ("val", CHECKPOINT, label_set(tmp_path / "l.parquet", META.camera_hashes[0]), "--no-baselines"),
    ):
        result = run(*words)
        assert result.exit_code == 0, (words, result.output)
        assert not width_warnings(result)


def test_bench_takes_folders_too() -> None:
    result = run("bench", "--model", CHECKPOINT, "--also", f"{CHECKPOINT}/", "--rounds", "10")
    assert result.exit_code == 0 and f"320x240 network {CHECKPOINT}" in result.stdout


def test_a_folder_of_checkpoints_is_refused_by_what_is_in_it(tmp_path: Path, drive: Path) -> None:
    parent, named = CHECKPOINT.parent, "neither model.onnx nor checkpoint.yaml; of its folders these do: "
    for words in (("val", parent), ("val", parent, drive), ("val", CHECKPOINT, parent)):
        line = error_of(run(*words))
        assert all(name in line for name in ("checkpoints", "frames.csv", "manifest.json", "map.yaml"))
        assert named in line and "small" in line.partition(named)[2]
    network = ("--detector", "network", "--model", parent)
    for words in (
        ("detect", drive, *network, "--out", tmp_path / "l.csv"),
        ("bench", "--model", parent),
        ("val", CHECKPOINT, drive, "--also", parent),
    ):
        assert named in error_of(run(*words)), words


def test_a_model_in_the_place_of_a_source_is_told_where_it_belongs(drive: Path) -> None:
    for words in (("val", drive, CHECKPOINT), ("val", CHECKPOINT, CHECKPOINT / "model.onnx")):
        line = error_of(run(*words))
        assert f"{words[-1]}: is a model" in line and "lanenet val MODEL SOURCE" in line


def test_export_of_labels_says_what_it_lacks(tmp_path: Path) -> None:
    labels = tmp_path / "a.parquet"
    assert "expected --format huggingface|tusimple|coco" in error_of(run("export", labels))
    assert "expected --out with a folder" in error_of(run("export", labels, "--format", "coco", "--map", "m"))
    assert "expected --map" in error_of(run("export", labels, "--format", "coco", "--out", tmp_path / "o"))
    assert "cannot be combined" in error_of(run("export", labels, "--format", "coco", "--int8"))


def test_export_says_what_is_no_checkpoint(tmp_path: Path) -> None:
    file = CHECKPOINT / "model.onnx"
    assert f"{file}: is a file, expected a checkpoint folder" in error_of(run("export", file))
    line = error_of(run("export", CHECKPOINT.parent))
    assert "neither model.onnx nor checkpoint.yaml" in line and "small" in line
    assert "ends in .onnx" in error_of(run("export", CHECKPOINT, "--out", tmp_path / "m.txt"))
    assert not list(tmp_path.iterdir())


def test_a_wrong_override_is_named(simulation: Path, tmp_path: Path) -> None:
    line = error_of(run("simulate", simulation, "sed=3", "--out", tmp_path / "d"))
    assert f"{simulation} sed=3: unknown key 'sed'" in line


def test_labels_of_another_camera_are_refused_as_its_frames_are(tmp_path: Path, simulation: Path) -> None:
    known, other = META.camera_hashes[0], "e" * 16
    labels = label_set(tmp_path / "l.parquet", other)
    line = error_of(run("val", CHECKPOINT, labels, "--no-baselines"))
    assert f"trained with camera {known}, but the camera of {labels} is {other}" in line
    run("simulate", simulation, "camera.height_cm=19", "--out", tmp_path / "d")
    of_frames = error_of(run("val", CHECKPOINT, tmp_path / "d", "--no-baselines"))
    way_out = line.partition("; use a model for any camera")[2]
    assert way_out == of_frames.partition("; use a model for any camera")[2] and "--any-camera" in way_out
    # A model that is put beside it is asked the same, and the lane filter has no camera to know.
    assert "trained with camera" in error_of(run("val", labels, "--also", CHECKPOINT))
    assert run("val", labels).exit_code == 0
    allowed = run("val", CHECKPOINT, labels, "--no-baselines", "--any-camera")
    assert allowed.exit_code == 0, allowed.output


def test_a_lane_that_no_training_had_is_warned_of_once(
    tmp_path: Path, drive: Path, car: Path, simulation: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    network = ("--detector", "network", "--model", CHECKPOINT)

    def stop(*_: object) -> None:
        raise LanenetError("no time to drive")

    monkeypatch.setattr("datagen.judge.contest.judge", stop)
    wide = label_set(tmp_path / "wide.parquet", META.camera_hashes[0])
    drawn = tmp_path / "drawn"
    for words, width in (
        (("detect", drive, *network, "--lane-width", "60", "--out", tmp_path / "l.csv"), "60"),
        (("drive", car, "detector.lane_width_cm=62", "--dry-run"), "62"),
        (("drive", car, "control.steering.lane_width_cm=63", "--dry-run"), "63"),
        (("simulate", simulation, "track.lane_width_cm=50", *network, "--out", drawn), "50"),
        (("val", CHECKPOINT, drawn, wide, "--detectors", "network"), "50"),
        (("judge", "--detectors", "network", "--model", CHECKPOINT, "--tracks", "random,mat"), "45"),
    ):
        (line,) = width_warnings(run(*words))
        assert line.startswith(f"warning: lane width {width} cm: {CHECKPOINT}"), (words, line)
        assert "was trained on lanes of 40 cm" in line
    # Where the network does not drive, nobody minds.
    assert not width_warnings(run("val", CHECKPOINT, drawn, "--detectors", "painter"))
    assert not width_warnings(run("judge", "--detectors", "truth", "--tracks", "mat"))


def test_simulate_says_which_model_drives_and_names_its_own_options(
    tmp_path: Path, simulation: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    out = ("--out", tmp_path / "d")
    assert "--detector 'nobody': expected " in error_of(
        run("simulate", simulation, "--detector", "nobody", *out)
    )
    assert "--detector 'painter=p.yaml': p.yaml: no such file" in error_of(
        run("simulate", simulation, "--detector", "painter=p.yaml", *out)
    )
    network = ("simulate", simulation, "--detector", "network", *out)
    assert "expected a model (--model), checkpoints/small is not there" in error_of(run(*network))
    assert "nowhere: no such file" in error_of(run(*network, "--model", "nowhere"))
    assert "--detector network" in error_of(run("simulate", simulation, "--model", CHECKPOINT, *out))
    (tmp_path / "checkpoints").symlink_to(CHECKPOINT.parent)
    assert "network: checkpoints/small; --model names another one\n" in run(*network).stdout
    assert "--model names" not in run(*network, "--model", CHECKPOINT).stdout


def test_what_detect_suggests_runs_with_all_that_was_given(tmp_path: Path) -> None:
    photos = tmp_path / "my photos"
    photos.mkdir()
    camera = read_camera(CAMERA).with_mounting(height_cm=19.0)
    write_camera(tmp_path / "camera.yaml", camera, "made up")
    for k, frame in enumerate(example_frames(camera, 4, np.random.default_rng(1))):
        cv2.imwrite(str(photos / f"{k}.png"), frame)
    (photos / "2.png").write_bytes(b"torn")
    given = (
        "--camera",
        tmp_path / "camera.yaml",
        "--lane-width",
        "41.5",
        "--any-camera",
        "--model",
        CHECKPOINT,
    )
    some = ("--frames", "1:3", "--skip-unreadable", "--out", tmp_path / "l.csv")
    again = next_words(run("detect", photos, "--detector", "network", *given, *some))
    assert again[:2] == ["detect", str(photos)]
    for option, value in (("--frames", "1:3"), ("--lane-width", "41.5"), ("--model", str(CHECKPOINT))):
        assert again[again.index(option) + 1] == value
    assert {"--any-camera", "--skip-unreadable"} <= set(again)
    assert "next, for the car: cp configs/car/picamera_pca9685.yaml" in run(*again).stdout
    assert (tmp_path / "l.mp4").stat().st_size > 0 and list(read_detections(tmp_path / "l.csv").frame) == [
        1,
        2,
        3,
    ]


def test_what_val_suggests_runs(tmp_path: Path, simulation: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    run("simulate", simulation, "camera.height_cm=19", "--out", "d")
    of_network = next_words(run("val", CHECKPOINT, "d", "--any-camera", "--detectors", "network"))
    assert of_network[:3] == ["detect", "d", "--model"] and "--any-camera" in of_network
    of_filter = next_words(run("val", "d", "--detectors", "lane-filter", "--marking", "2.5"))
    assert of_filter[of_filter.index("--marking") + 1] == "2.5"
    # A label set has no frames to detect on.
    labels = label_set(tmp_path / "l.parquet", META.camera_hashes[0])
    on_labels = run("val", CHECKPOINT, labels, "--no-baselines")
    assert "then lanenet doctor --config checkpoints/NAME/car.yaml" in on_labels.stdout.replace("\n", " ")
    Path("car.yaml").touch()
    assert next_words(run("val", CHECKPOINT, labels, "--no-baselines")) == ["drive", "car.yaml", "--dry-run"]
    # A network from --also is no detector's name.
    of_other = next_words(run("val", "d", "--also", CHECKPOINT, "--any-camera", "--detectors", "painter"))
    for words in (of_network, of_filter, of_other):
        assert run(*words).exit_code == 0, words
        assert read_detections(Path("runs/lanes.csv")).frame.size == 3


def test_skipping_is_advised_for_a_frame_that_cannot_be_read_and_for_nothing_else(drive: Path) -> None:
    words = ("detect", drive, "--detector", "hough", "--out", drive.parent / "l.csv")
    refused = run(*words, "--video", drive.parent / "folder")
    assert refused.exit_code == 1 and "ends in one of" in refused.stderr and "--skip" not in refused.stderr
    (drive / "images" / "000002.jpg").write_bytes(b"torn")
    refused = run(*words)
    assert refused.exit_code == 1 and "000002.jpg" in refused.stderr and "--skip-unreadable" in refused.stderr
