"""``map``, ``label`` and ``train`` whole, with each call that can fail failing in turn."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from nth_failure import DISK, MEMORY, check_each, every_failure, report, visible
from safetensors.numpy import load_file
from synthetic_labels import make_label_set

from datagen import pipeline
from datagen.labels.label_map import label_map
from datagen.pipeline import MapRequest, map_drive
from datagen.settings import MapSettings
from datagen.world.simulate import simulate_drive
from datagen.world.world import SimulationSettings
from lanenet.data.label_set import read_labels, write_labels
from lanenet.data.maps.folder import read_map, write_map
from lanenet.data.maps.label_errors import LabelErrors
from lanenet.data.maps.mapped_drive import open_mapped_drive
from lanenet.errors import LanenetError
from lanenet.learn import export
from lanenet.learn.checkpoint import publish
from lanenet.learn.config import LearnSettings, NetworkSettings
from lanenet.learn.export import read_network
from lanenet.learn.train import train
from lanenet.perception.network.model_file import MODEL_NAME, open_model

pytestmark = pytest.mark.slow

SIMULATION = SimulationSettings.model_validate(
    {
        "seed": 1,
        "frames": 80,
        "camera": {"width": 160, "height": 120, "field_of_view_rad": math.radians(120.0), "height_cm": 17.0},
        "track": {"left": {}, "right": {}, "interruptions_per_m": 0.0},
    }
)
#: What a mapping computes before it writes; the same for every run.
STAGES = (
    "camera_of_drive",
    "solve_drive",
    "fit_lanes",
    "assemble",
    "check_map",
)


#: Frames that are labelled.
SHOWN = 10


def once(real: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that remembers its first answer."""
    answers: list[Any] = []

    def call(*values: Any, **named: Any) -> Any:
        if not answers:
            answers.append(real(*values, **named))
        return answers[0]

    return call


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate_drive(SIMULATION, tmp_path_factory.mktemp("d") / "drive")


@pytest.fixture(scope="module")
def a_map(drive: Path) -> Path:
    out = drive.parent / "map"
    map_drive(MapRequest(drive, 40.0), MapSettings(find_bumper=False), out, pictures=False)
    # Its first frames only: a label set encodes an image of each, and every one may fail.
    found = read_map(out)
    names = ("frames", "t_s", "poses", "lap", "segment", "s_cm", "match", "tilt_rad", "held_out", "marks")
    first = {name: getattr(found, name)[:SHOWN] for name in names}
    first["errors"] = LabelErrors(*(column[:SHOWN] for column in found.errors))
    write_map(out, replace(found, **first), {"frame": found.frames[:SHOWN]}, {}, "from the drive")
    return out


def check_files(folder: Path) -> None:
    """Open everything in a folder that is a picture, JSON or a page."""
    for path in folder.iterdir():
        if path.suffix == ".png":
            assert cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_COLOR) is not None, path
        elif path.suffix == ".json":
            json.loads(path.read_text())
        elif path.suffix == ".html":
            assert path.read_text().rstrip().endswith("</html>"), path


def test_map(tmp_path: Path, drive: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    number_now = 0
    prepared = once(pipeline.prepare)

    def prepare(*values: Any) -> Any:
        return replace(prepared(*values), notes=(f"run {number_now}",))

    monkeypatch.setattr(pipeline, "prepare", prepare)
    for name in STAGES:
        monkeypatch.setattr(pipeline, name, once(getattr(pipeline, name)))
    out = tmp_path / "map"

    def write(number: int) -> None:
        nonlocal number_now
        number_now = number
        map_drive(MapRequest(drive, 40.0), MapSettings(find_bumper=False), out)

    def read() -> int:
        opened = open_mapped_drive(out)
        assert len(opened.drive_map.frames) == 80
        check_files(out)
        notes = json.loads((out / "report.json").read_text())["notes"]
        return int(next(note for note in notes if note.startswith("run ")).split()[1])

    calls = check_each(write, read, tmp_path, [DISK, MEMORY])
    report("map", calls)
    assert len(calls) > 40


def test_label(tmp_path: Path, a_map: Path) -> None:
    out = tmp_path / "labels.parquet"

    def write(number: int) -> None:
        label_map(a_map, out, colour_weight=number / 1000.0)

    def read() -> int:
        labels = read_labels(out)
        assert len(labels.frame) > SHOWN // 2
        check_files(tmp_path)
        return round(1000.0 * labels.meta.perception.edges.colour_weight)

    calls = check_each(write, read, tmp_path, [DISK, MEMORY])
    report("label", calls)
    assert len(calls) > 12


SETTINGS = LearnSettings(
    epochs=2, batch_size=16, threads=1, network=NetworkSettings(channels=(4, 8), hidden=16)
)


@pytest.fixture(scope="module")
def label_sets(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    paths = [tmp_path_factory.mktemp("labels") / f"{name}.parquet" for name in ("train", "val")]
    for seed, path in enumerate(paths):
        write_labels(path, make_label_set(40, seed))
    return paths


def test_train(tmp_path: Path, label_sets: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    """Each failure strikes a new training; called again, that ends with the weights of an undisturbed one."""
    # The export takes seconds, and the weights are always the same.
    monkeypatch.setattr(export, "_to_onnx", once(export._to_onnx))
    whole = train(SETTINGS, label_sets[:1], label_sets[1:], tmp_path / "whole").folder
    expected = load_file(whole / "weights.safetensors")
    number, calls = 0, []

    def run() -> None:
        nonlocal number
        number += 1
        train(SETTINGS, label_sets[:1], label_sets[1:], tmp_path / "runs" / str(number))

    for failure in every_failure(run, [DISK, MEMORY]):
        calls.append(failure.call)
        shown = f"{failure.n}: {failure.call}: {failure.error!r}"
        assert failure.error is None or isinstance(failure.error, LanenetError | MemoryError), shown
        assert not isinstance(failure.error, LanenetError) or str(tmp_path) in str(failure.error), shown
        out = tmp_path / "runs" / str(number)
        result = train(SETTINGS, label_sets[:1], label_sets[1:], out)
        assert failure.error is not None or not result.computed, f"{shown}: not finished, and nothing said"
        found = load_file(out / "weights.safetensors")
        assert all(np.array_equal(found[name], value) for name, value in expected.items()), shown
        open_model(out / MODEL_NAME)
        check_files(out)
        assert sorted(path.name for path in out.iterdir()) == visible(whole), f"{shown}: left-overs"
    report("train", calls)
    assert len(calls) > 40


def test_checkpoint(tmp_path: Path, label_sets: list[Path]) -> None:
    run = train(SETTINGS, label_sets[:1], label_sets[1:], tmp_path / "run").folder
    out = tmp_path / "checkpoints" / "one"

    def write(number: int) -> None:
        publish(run, out, "one", {"run.yaml": f"{number}\n", "results.md": "x"}, {"number": number})

    def read() -> int:
        read_network(out)
        open_model(out / MODEL_NAME)
        check_files(out)
        return int((out / "run.yaml").read_text())

    calls = check_each(write, read, out.parent, [DISK, MEMORY])
    report("checkpoint", calls)
    assert len(calls) > 25
