"""The data sheet of a trained network: every figure is that of the data, and what is unknown is said."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from small_map import small_map

from datagen.datasets.build import PreparedData, recorded_jobs
from datagen.datasets.jobs import Part
from datagen.datasets.settings import DataSettings, RecordedSettings, SyntheticSettings
from datagen.datasets.sheet import Sheet, data_sheet, draw_jobs, field_of_view_deg, left_out_reasons, spread
from datagen.datasets.sheet_text import UNKNOWN, sheet_files
from datagen.world.car.camera import CameraSettings
from lanenet.data.drives.folder import DriveWriter
from lanenet.data.label_set import LabelMeta, LabelSet, write_labels
from lanenet.data.library import Library
from lanenet.data.library.library import DEFAULT_LIBRARY
from lanenet.data.maps.folder import write_map
from lanenet.geometry.birdseye import BirdseyeWindow


def straight_labels(n: int, step_cm: float) -> LabelSet:
    """Labels of a car that drives straight ahead, 20 frames a second."""
    nothing = np.empty((0, 2))
    along = step_cm * np.arange(n)
    return LabelSet(
        meta=LabelMeta(BirdseyeWindow(), "camera", 17.0, 40.0, "map", marking_cm=2.5),
        drive=["drive"] * n,
        file=[""] * n,
        frame=np.arange(n),
        t_s=0.05 * np.arange(n),
        lap=np.zeros(n, dtype=np.int64),
        poses=np.column_stack([along, 0.0 * along, 0.0 * along]),
        points_cm=np.zeros((n, 6)),
        edges=[np.empty((0, 6), np.float32)] * n,
        lines=[(nothing, nothing)] * n,
        quality=np.ones(n),
        divides=np.zeros((n, 2), dtype=bool),
    )


@pytest.mark.parametrize("degrees", [60.0, 100.0])
def test_the_field_of_view_is_that_of_the_lens(degrees):
    for model in ("fisheye", "pinhole"):
        camera = CameraSettings(model=model, field_of_view_rad=np.radians(degrees)).build(26.0)
        assert field_of_view_deg(camera) == pytest.approx(degrees, abs=0.01)


def test_a_spread_of_something_unknown_is_unknown():
    assert spread([3.0, 1.0, 2.0]) == {"min": 1.0, "median": 2.0, "max": 3.0}
    assert spread([]) is None
    assert spread([1.0, float("nan")]) is None


def test_reasons_that_differ_in_their_numbers_are_one():
    texts = [
        "train_03 (seed 7): runs/a/maps/train_03: the map was rejected: 0.3 of 1; see runs/a/report.json",
        "train_11 (seed 9): runs/a/maps/train_11: the map was rejected: 0.25 of 1; see runs/a/report.json",
        "train_12 (seed 2): no road of 3 pieces",
    ]
    expected = {"the map was rejected: # of #": 2, "no road of # pieces": 1}
    assert left_out_reasons(texts) == expected


def test_simulated_drives_are_described_by_what_was_drawn_for_those_that_gave_labels(tmp_path):
    synthetic = SyntheticSettings(seed=4, train=6, validation=1, variety="all", may_fail=0.5)
    data = DataSettings(synthetic=synthetic)
    jobs = draw_jobs(data, "train", tmp_path)
    made = [jobs[0], jobs[2], jobs[5], *draw_jobs(data, "validation", tmp_path)]
    for job in made:
        job.labels.parent.mkdir(parents=True, exist_ok=True)
        write_labels(job.labels, straight_labels(101, 5.0))
    left_out = tuple(f"{jobs[k].title}: the road is {k} cm too short" for k in (1, 3, 4))
    parts = tuple(Part(job.role, job.labels, job.frames) for job in made)
    sheet = data_sheet("net", data, PreparedData(parts, None, None, left_out), tmp_path)
    # 100 steps of 5 cm and of 0.05 s.
    train = sheet["parts"]["train"]
    assert (train["drives"], train["frames"]) == (3, 303)
    assert train["km"] == pytest.approx(3 * 0.005)
    assert train["minutes"] == pytest.approx(3 * 5.0 / 60.0)
    facts = sheet["simulated"]
    assert facts["asked"] == {"train": 6, "validation": 1, "test": 0}
    assert facts["made"] == {"train": 3, "validation": 1, "test": 0}
    assert facts["left_out"] == {"the road is # cm too short": 3}
    widths = sorted(jobs[k].simulation.track.lane_width_cm for k in (0, 2, 5))
    assert list(facts["lane_width_cm"].values()) == pytest.approx(widths)
    assert sum(facts["shapes"].values()) == sum(facts["roads"].values()) == 3
    assert sum(camera["drives"] for camera in facts["cameras"]) == 3
    files = sheet_files(sheet)
    assert json.loads(files["data_sheet.json"])["simulated"]["made"]["train"] == 3
    text = files["DATA_SHEET.md"]
    assert "train 3 of 6, validation 1 of 1" in text and "- 3: the road is # cm too short" in text
    assert "it has seen no real image" in text


def test_a_recorded_drive_has_its_licence_from_the_library_and_the_rest_from_map_and_labels(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    drive, folder = tmp_path / "tub", tmp_path / "map"
    rng = np.random.default_rng(0)
    with DriveWriter(drive) as writer:
        for k in range(12):
            writer.add(rng.integers(0, 255, (60, 80, 3), np.uint8), 0.1 * k)
    folder.mkdir()
    mapped = small_map()
    mapped = replace(mapped, meta=mapped.meta.model_copy(update={"drive": str(drive)}))
    write_map(folder, mapped, {"frame": np.arange(2)}, {}, "given")
    data = DataSettings(drives=(RecordedSettings(path=folder, lane_width_cm=36.0, split="none"),))
    (job,) = recorded_jobs(data, tmp_path)
    job.whole.parent.mkdir(parents=True)
    write_labels(job.whole, straight_labels(201, 5.0))
    prepared = PreparedData((Part("train", job.whole, job.frames, 15),), None, None)

    def sheet() -> Sheet:
        return data_sheet("net", data, prepared, tmp_path, [job])

    (entry,) = sheet()["recorded"]
    assert entry["licence"] is None and entry["marking_cm"] == 2.5
    assert entry["parts"]["train"]["km"] == pytest.approx(0.01)
    assert entry["camera"]["width_px"] == mapped.camera.width
    text = sheet_files(sheet())["DATA_SHEET.md"]
    assert f"licence: {UNKNOWN}; car: {UNKNOWN}; track: {UNKNOWN}" in text
    assert f"| {UNKNOWN} | 1 | " in text
    # The drive says something itself, and the library more.
    with (drive / "drive.yaml").open("a") as file:
        file.write("licence: CC0-1.0\n")
    (entry,) = sheet()["recorded"]
    assert (entry["licence"], entry["car"]) == ("CC0-1.0", None)
    (total,) = sheet()["licences"].values()
    assert list(sheet()["licences"]) == ["CC0-1.0"] and total["drives"] == 1
    assert total["km"] == pytest.approx(0.01) and total["frames"] == entry["parts"]["train"]["frames"]
    assert f"| CC0-1.0 | 1 | {total['frames']} | " in sheet_files(sheet())["DATA_SHEET.md"]
    # A config says more, as one that was drawn from a library at another place.
    told = {"licence": "MIT", "car": "blue", "track": "yard"}
    said = replace(job, recording=job.recording.model_copy(update=told))
    (entry,) = data_sheet("net", data, prepared, tmp_path, [said])["recorded"]
    assert {key: entry[key] for key in told} == told
    library = Library.open(DEFAULT_LIBRARY, create=True)
    assert library.add(drive, car="red", track="garage").licence == "CC0-1.0"
    assert library.find(folder) is None
    (entry,) = sheet()["recorded"]
    assert (entry["licence"], entry["car"], entry["track"]) == ("CC0-1.0", "red", "garage")
    # The run's own library says more than that of the folder it was started in.
    (entry,) = data_sheet("net", data, prepared, tmp_path, [said])["recorded"]
    assert {key: entry[key] for key in told} == told
    # What people say in the library counts; a library that is damaged does not spoil the sheet.
    library.update("tub", licence="CC-BY-4.0")
    assert sheet()["recorded"][0]["licence"] == "CC-BY-4.0"
    DEFAULT_LIBRARY.write_bytes(b"no library")
    assert sheet()["recorded"][0]["licence"] == "CC0-1.0"
