from __future__ import annotations

import numpy as np
import pytest

from datagen.world.car.camera import CameraSettings
from datagen.world.simulate import simulate_drive
from datagen.world.world import SimulationSettings
from lanenet.data.files import json_text
from lanenet.data.maps.mapped_drive import read_truth_frames
from lanenet.errors import DriveFormatError
from lanenet.evaluation import answers
from lanenet.evaluation.answers import Compared
from lanenet.evaluation.comparison import default_names, evaluate
from lanenet.evaluation.report import report_files
from lanenet.evaluation.sources import Opened


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
