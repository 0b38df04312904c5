"""The whole chain through the command line: simulate, map, label, train, export, detect; and a kill."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import yaml
from detections import read_detections
from typer.testing import CliRunner

from lanenet.cli.app import app
from lanenet.data.drives import read_truth
from lanenet.data.label_set import read_labels
from lanenet.geometry.lane import POINT_NAMES
from lanenet.learn.export import read_network

# `make chain`, a stage of the gate.
pytestmark = pytest.mark.slow

#: Fewer give no map.
FRAMES = 60


def write_config(folder, **learn):
    data = {
        "name": "tiny",
        "work_dir": str(folder / "work"),
        "checkpoints_dir": str(folder / "ck"),
        "data": {
            "workers": 1,
            "synthetic": {
                "seed": 3,
                "train": 1,
                "validation": 1,
                "test": 1,
                "simulation": {"frames": FRAMES},
            },
        },
        "learn": {"threads": 1, "epochs": 3, **learn},
    }
    path = folder / "tiny.yaml"
    path.write_text(yaml.safe_dump(data))
    return path


def invoke(*words):
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == 0, result.output + (result.stderr or "")
    return result.output


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("chain")
    config = write_config(folder)
    return folder, config, invoke("train", config)


def test_train_leaves_a_checkpoint_that_is_complete(finished):
    folder, _, output = finished
    names = {path.name for path in (folder / "ck" / "tiny").iterdir()}
    assert names >= {"model.onnx", "weights.safetensors", "metrics.json", "run.yaml", "camera.yaml"}
    assert names >= {
        "results.json",
        "results.md",
        "report.html",
        "checkpoint.yaml",
        "curve.csv",
        "example.jpg",
    }
    assert "last.pt" not in names
    assert "verdict: not fit to drive with: on the test drives it" in output and "against the truth" in output
    assert "painter" not in output
    tables = (folder / "ck" / "tiny" / "results.md").read_text()
    for name in ("network", "lane-filter", "hough-value", "painter", "against the truth"):
        assert name in tables
    # A network of two epochs is unsure of most points, and does not answer them.
    assert "results.png" in names
    results = json.loads((folder / "ck" / "tiny" / "results.json").read_text())
    for group in ("all", *POINT_NAMES):
        figures = results["detectors"]["network"]["groups"][group]
        assert figures["rmse_cm"] is None or figures["rmse_cm"] <= figures["worst_cm"]
    assert results["detectors"]["painter"]["groups"]["all"]["rmse_cm"] > 0.0


def test_no_json_has_words_that_json_does_not_know(finished):
    folder, _, _ = finished
    written = {path.name: path.read_text() for path in (folder / "ck" / "tiny").glob("*.json")}
    assert written.keys() >= {"metrics.json", "results.json", "robustness.json"}
    for name, text in written.items():
        for word in ("NaN", "Infinity"):
            assert word not in text, name


def test_labels_come_from_the_map_and_are_close_to_the_truth(finished):
    folder, _, _ = finished
    synthetic = folder / "work" / "synthetic"
    labels = read_labels(synthetic / "labels" / "train_00.parquet")
    assert labels.meta.source == "map"
    truth = read_truth(synthetic / "drives" / "train_00")
    exact = np.stack([truth[name] for name in POINT_NAMES], axis=1)
    rows = np.searchsorted(truth["frame"], labels.frame)
    error = labels.points_cm - exact[rows]
    # A label that were the truth would have no error at all.
    assert 0.01 < np.sqrt(np.nanmean(error**2)) < 1.0
    assert np.isfinite(labels.points_cm).mean() > 0.9
    assert read_labels(synthetic / "labels" / "test_00.parquet").meta.source == "truth"


def test_a_second_run_does_nothing_again(finished):
    folder, config, _ = finished
    # Of the drives, and of the training, which writes its state after each epoch.
    made = [*sorted((folder / "work").rglob("*.parquet")), *(folder / "work").glob("train-*/last.pt")]
    assert made[-1].name == "last.pt"
    before = [path.stat().st_mtime_ns for path in made]
    weights = (folder / "ck" / "tiny" / "weights.safetensors").read_bytes()
    invoke("train", config)
    assert [path.stat().st_mtime_ns for path in made] == before
    assert (folder / "ck" / "tiny" / "weights.safetensors").read_bytes() == weights


def test_the_model_works_on_its_own(finished):
    folder, _, _ = finished
    checkpoint = folder / "ck" / "tiny"
    camera = checkpoint / "camera.yaml"
    model = checkpoint / "model.onnx"
    out = folder / "photo.csv"
    photo = checkpoint / "example.jpg"
    invoke("detect", photo, "--detector", "network", "--model", model, "--camera", camera, "--out", out)
    # It is unsure of a frame that nothing came before.
    assert read_detections(out).frame.tolist() == [0]
    drive = folder / "work" / "synthetic" / "drives" / "test_00"
    video = folder / "drive.mp4"
    words = ("detect", drive, "--detector", "network", "--model", model, "--frames", "10:29")
    invoke(*words, "--out", folder / "drive.parquet", "--video", video)
    assert len(read_detections(folder / "drive.parquet").points_cm) == 20
    assert video.stat().st_size > 10_000


def test_the_steps_one_by_one(finished):
    folder, _, _ = finished
    drive = folder / "work" / "synthetic" / "drives" / "validation_00"
    invoke("map", drive, "--lane-width", 40, "--out", folder / "map")
    assert (folder / "map" / "map.png").stat().st_size > 10_000
    assert (folder / "map" / "frames.png").stat().st_size > 10_000
    invoke("label", folder / "map", "--out", folder / "labels.parquet")
    same = read_labels(folder / "work" / "synthetic" / "labels" / "validation_00.parquet")
    np.testing.assert_array_equal(read_labels(folder / "labels.parquet").points_cm, same.points_cm)
    model = folder / "ck" / "tiny" / "model.onnx"
    output = invoke("val", model, folder / "labels.parquet", "--out", folder / "table")
    assert "against the map" in output and (folder / "table.md").is_file()
    # The same map with its frames: the other detectors too, and the network on markings, with memory.
    output = invoke("val", model, folder / "map", drive, "--out", folder / "frames")
    assert "against the map and truth" in output
    on_labels, on_frames = (
        json.loads((folder / f"{name}.json").read_text())["sources"][0]["detectors"]
        for name in ("table", "frames")
    )
    assert on_frames["lane-filter"]["rmse_cm"] == pytest.approx(on_labels["lane-filter"]["rmse_cm"], rel=0.02)
    # After three epochs it may have no line where one is seen, and then nothing is answered.
    if on_frames["network"]["count"]:
        assert on_frames["network"]["rmse_cm"] < on_labels["network"]["rmse_cm"]
    assert on_frames["painter"]["count"] > 0
    exported = folder / "again.onnx"
    invoke("export", folder / "ck" / "tiny", "--out", exported)
    assert exported.stat().st_size == pytest.approx(model.stat().st_size, rel=0.01)


def test_a_killed_train_resumes(tmp_path, finished):
    """Killed in the data stage and again while training, it ends with the weights of an undisturbed run."""
    folder, _, _ = finished
    config = write_config(tmp_path)
    command = [sys.executable, "-m", "lanenet", "train", str(config)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}

    def kill_when(ready):
        process = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, stdout=subprocess.PIPE)
        deadline = time.monotonic() + 120.0
        while process.poll() is None and not ready():
            assert time.monotonic() < deadline
            time.sleep(0.02)
        assert ready() and process.poll() is None
        process.send_signal(signal.SIGKILL)
        process.communicate()
        assert process.returncode == -signal.SIGKILL

    labels = tmp_path / "work" / "synthetic" / "labels"
    kill_when(lambda: (labels / "train_00.parquet").is_file())
    assert not (tmp_path / "ck" / "tiny").exists()
    kill_when(lambda: any((tmp_path / "work").glob("train-*/last.pt")))
    assert not (tmp_path / "ck" / "tiny").exists()
    invoke("train", config)
    undisturbed, killed = (read_network(f / "ck" / "tiny")[0].state_dict() for f in (folder, tmp_path))
    for name, value in undisturbed.items():
        np.testing.assert_array_equal(killed[name].numpy(), value.numpy(), err_msg=name)
    assert not [path for path in (tmp_path / "ck").rglob("*") if path.name.endswith(".tmp")]
