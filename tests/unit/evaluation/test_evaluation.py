from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from datagen.labels.truth import truth_labels
from datagen.world.car.camera import CameraSettings
from datagen.world.simulate import simulate_drive
from datagen.world.world import SimulationSettings
from lanenet.data.files import json_text
from lanenet.data.label_set import write_labels
from lanenet.data.maps.mapped_drive import read_truth_frames
from lanenet.errors import DriveFormatError
from lanenet.evaluation import answers
from lanenet.evaluation.answers import Compared, RasterModel
from lanenet.evaluation.comparison import default_names, evaluate
from lanenet.evaluation.report import report_files
from lanenet.evaluation.robustness import measure_robustness
from lanenet.evaluation.sources import Opened, open_source
from lanenet.geometry.birdseye import GENERAL_WINDOW, BirdseyeWindow
from lanenet.perception.network.model_file import read_model_meta

CHECKPOINT = Path(__file__).resolve().parents[3] / "checkpoints" / "small"


@pytest.fixture(scope="module")
def sources(tmp_path_factory) -> list[Opened]:
    opened = []
    for seed in (1, 2):
        folder = tmp_path_factory.mktemp(f"drive{seed}") / "drive"
        simulate_drive(
            SimulationSettings(seed=seed, frames=12, camera=CameraSettings(width=160, height=120)), folder
        )
        opened.append(Opened(folder, read_truth_frames(folder)))
    # A part of a drive, as the test part of a recording is.
    opened.append(Opened(opened[0].path, read_truth_frames(opened[0].path).numbered(4, 9)))
    return opened


def test_several_processes_give_the_answers_of_one(sources, monkeypatch):
    monkeypatch.setattr(answers, "_WORTH_PROCESSES", 1)
    names = default_names(sources, with_model=False)
    shown: dict[int, list] = {1: [], 2: []}
    one, two = (
        evaluate(
            sources, Compared(names), workers=n, progress=lambda *done, shown=shown[n]: shown.append(done)
        )
        for n in (1, 2)
    )
    # As text, in which what is no number equals itself.
    assert json_text(one[0].as_dict()) == json_text(two[0].as_dict())
    assert report_files(*one) == report_files(*two)
    frames = [len(source.frames) for source in sources if source.frames is not None]
    assert shown[1][-1] == ("drive", frames[-1], frames[-1]) and len(shown[1]) == sum(frames)
    assert shown[2] == [("sources", done, 3) for done in (1, 2, 3)]


def test_few_frames_are_not_worth_processes(sources, monkeypatch):
    def refuse(*_):
        raise AssertionError("processes were started")

    monkeypatch.setattr("lanenet.evaluation.answers.run_jobs", refuse)
    found = evaluate(sources, Compared(["hough"]), workers=2)[0].as_dict()
    assert np.isfinite(found["detectors"]["hough"]["groups"]["all"]["rmse_cm"])


def test_a_broken_frame_is_named_by_another_process_too(sources, tmp_path, monkeypatch):
    monkeypatch.setattr(answers, "_WORTH_PROCESSES", 1)
    drive = tmp_path / "drive"
    simulate_drive(SimulationSettings(seed=3, frames=4, camera=CameraSettings(width=160, height=120)), drive)
    broken = sorted((drive / "images").iterdir())[2]
    broken.write_bytes(b"no image")
    with pytest.raises(DriveFormatError, match=broken.name):
        evaluate([sources[0], Opened(drive, read_truth_frames(drive))], Compared(["hough"]), workers=2)


def test_a_label_set_is_answered_as_its_frames_are(sources, monkeypatch):
    """A network follows the lane and refines its lines on the edge points of a set as it does on the car."""
    model = CHECKPOINT / "model.onnx"
    meta = read_model_meta(model)
    labels = truth_labels(sources[0].path, meta.perception)
    # The settings of the frames are those of the set, which does not hold how the car moved.
    frames = replace(sources[0].frames, perception=meta.perception, motion=None)
    compared = Compared(["network", "network-single"], {"network": model}, any_camera=True)
    on_frames = compared.answer(frames)
    on_edges = compared.answer_labels(labels, sources[0].path)
    for name in ("network", "network-single"):
        np.testing.assert_allclose(on_edges.points_cm[name], on_frames.points_cm[name], atol=1e-6)
        np.testing.assert_allclose(on_edges.sigma_cm[name], on_frames.sigma_cm[name], atol=1e-6)
        np.testing.assert_allclose(on_edges.presence[name], on_frames.presence[name], atol=1e-6)
    # Without its camera the network is alone, and the set says so.
    old = replace(labels, meta=replace(labels.meta, camera=None))
    alone = compared.answer_labels(old, sources[0].path).points_cm["network"]
    assert np.nanmax(np.abs(alone - on_frames.points_cm["network"])) > 0.05
    assert "holds no camera" in Opened(Path("l.parquet"), labels=old).without_camera
    assert Opened(Path("l.parquet"), labels=labels).without_camera == ""


def test_a_label_set_of_another_window_fits_every_network(sources, tmp_path):
    labels = truth_labels(sources[0].path, read_model_meta(CHECKPOINT).perception)
    wide = labels.in_window(GENERAL_WINDOW)
    compared = Compared(["network"], {"network": CHECKPOINT / "model.onnx"}, any_camera=True)
    one, other = (compared.answer_labels(each, tmp_path).points_cm["network"] for each in (labels, wide))
    np.testing.assert_array_equal(one, other)
    write_labels(tmp_path / "l.parquet", wide)
    opened = open_source(tmp_path / "l.parquet", BirdseyeWindow(), None, truth_labels)
    assert opened.labels is not None and opened.labels.meta.window == BirdseyeWindow()
    both = {"network": CHECKPOINT / "model.onnx", "general": CHECKPOINT.parent / "general" / "model.onnx"}
    found = measure_robustness({name: RasterModel(path) for name, path in both.items()}, [wide], ["wide"])
    assert {row.model for row in found} == set(both)


def test_the_general_window_is_that_of_the_shipped_network():
    assert read_model_meta(CHECKPOINT.parent / "general").window == GENERAL_WINDOW
