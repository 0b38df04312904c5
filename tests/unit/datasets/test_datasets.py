"""Splits along time, and when a drive is made again."""

from __future__ import annotations

import shutil
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from recordings import lap, write_recording
from small_map import small_map

from datagen.datasets.build import prepare, shared_camera
from datagen.datasets.jobs import Part, RecordedJob, SyntheticJob
from datagen.datasets.settings import DataSettings, RecordedSettings, SyntheticSettings
from datagen.datasets.splits import split_along_time
from datagen.prepare import MapRequest
from datagen.world.world import SimulationSettings
from lanenet.config import check_settings
from lanenet.data.camera_file import read_camera
from lanenet.data.label_set import LabelMeta, LabelSet, read_labels, write_labels
from lanenet.data.maps.folder import read_map, write_map
from lanenet.errors import ConfigError, TrackingLostError
from lanenet.geometry.birdseye import GENERAL_WINDOW, BirdseyeWindow


def _labels(frames: np.ndarray) -> LabelSet:
    n = len(frames)
    nothing = np.empty((0, 2))
    return LabelSet(
        meta=LabelMeta(BirdseyeWindow(), "camera", 17.0, 40.0, "map"),
        drive=["drive"] * n,
        file=[""] * n,
        frame=frames,
        t_s=0.05 * frames,
        lap=np.zeros(n, dtype=np.int64),
        poses=np.zeros((n, 3)),
        points_cm=np.column_stack([frames] * 6).astype(np.float64),
        edges=[np.empty((0, 6), np.float32)] * n,
        lines=[(nothing, nothing)] * n,
        quality=np.ones(n),
        divides=np.zeros((n, 2), dtype=bool),
    )


def test_a_whole_drive_is_cut_at_its_shares_with_gaps():
    parts = split_along_time(_labels(np.arange(1000)), (0.6, 0.15), 40)
    assert [(int(p.frame[0]), int(p.frame[-1])) for p in parts] == [(0, 599), (640, 749), (790, 999)]
    # A row stays whole.
    np.testing.assert_array_equal(parts[1].points_cm[:, 3], parts[1].frame)


@settings(max_examples=150, deadline=None)
@given(
    st.lists(st.integers(1, 30), min_size=5, max_size=150),
    st.lists(st.floats(0.05, 0.6), min_size=1, max_size=3),
    st.integers(0, 60),
)
def test_no_two_frames_of_different_parts_are_within_the_gap(steps, shares, gap):
    assume(sum(shares) < 0.98)
    frames = np.cumsum(steps)
    try:
        parts = split_along_time(_labels(frames), tuple(shares), gap)
    except ConfigError:
        # Only where a part could not have had a frame beyond the gap.
        assert len(frames) < 60 or gap > 0
        return
    assert len(parts) == len(shares) + 1
    assert all(len(part) for part in parts)
    for before, after in pairwise(parts):
        assert after.frame[0] - before.frame[-1] > gap
    together = np.concatenate([part.frame for part in parts])
    assert (np.diff(together) > 0).all()
    assert set(together) <= set(frames)
    # Left out are only frames within the gap after a part.
    ends = [int(part.frame[-1]) for part in parts[:-1]]
    assert all(any(0 < f - end <= gap for end in ends) for f in set(frames) - set(together))


def test_without_a_gap_every_frame_is_used():
    frames = np.arange(0, 400, 2)
    parts = split_along_time(_labels(frames), (0.5, 0.25), 0)
    assert [len(p) for p in parts] == [100, 50, 50]


@pytest.mark.parametrize(
    ("count", "shares", "gap"),
    [
        (100, (0.6, 0.15), 40),  # 15 frames for the validation, all within the gap
        (3, (0.1, 0.1), 0),
        (200, (0.7, 0.3), 0),  # nothing left for the test
        (200, (0.9, 0.9), 0),  # more than there is
        (0, (0.6, 0.15), 0),
    ],
)
def test_an_empty_part_is_refused(count, shares, gap):
    with pytest.raises(ConfigError, match="empty"):
        split_along_time(_labels(np.arange(count)), shares, gap)


def test_a_lane_width_in_metres_is_refused_in_a_config_as_in_an_option():
    with pytest.raises(ConfigError, match=r"'lane_width_cm'.*0\.4 m are 40 cm: type 40"):
        check_settings(RecordedSettings, {"path": "drive", "lane_width_cm": 0.4}, "config")


def test_shares_that_leave_nothing_for_the_test_are_refused_before_any_work():
    with pytest.raises(ValidationError, match="validation_share"):
        RecordedSettings(path=Path("drive"), lane_width_cm=40.0, train_share=0.8, validation_share=0.2)
    assert RecordedSettings(path=Path("drive"), lane_width_cm=40.0, train_share=0.8, validation_share=0.1)


def test_every_synthetic_drive_has_a_seed_of_its_own_that_stays(tmp_path):
    def seeds(**counts: int) -> dict[str, int]:
        data = DataSettings(synthetic=SyntheticSettings(seed=5, **counts))
        jobs = [
            SyntheticJob.draw(data, role, k, tmp_path)
            for role in ("train", "validation", "test")
            for k in range(getattr(data.synthetic, role))
        ]
        return {job.name: job.simulation.seed for job in jobs}

    few, many = seeds(train=3, validation=1, test=2), seeds(train=12, validation=4, test=2)
    assert len(set(many.values())) == 18
    # More drives to learn from leave those that judge as they were.
    assert few.items() <= many.items()


def varied(**changes: object) -> DataSettings:
    few = {"train": 4, "validation": 1, "test": 1, "simulation": {"frames": 60}}
    return DataSettings.model_validate({"synthetic": {**few, **changes}, "workers": 1})


def test_varied_drives_have_roads_and_cameras_of_their_own(tmp_path):
    def simulations(data: DataSettings) -> list[SimulationSettings]:
        return [SyntheticJob.draw(data, "train", k, tmp_path).simulation for k in range(4)]

    none, roads = simulations(varied()), simulations(varied(variety="roads"))
    cameras = simulations(varied(variety="all", cameras=[{}, {"width": 160, "height": 120}]))
    assert len({s.track for s in none}) == len({s.camera for s in none}) == len({s.driver for s in none}) == 1
    # What is drawn beside it leaves a drive's seed as it is.
    assert [s.seed for s in none] == [s.seed for s in roads] == [s.seed for s in cameras]
    assert len({s.track for s in roads}) == 4 and len({s.camera for s in roads}) == 1
    # The kind of road is the same; how tight its bends are depends on the car, drawn with the camera.
    assert [s.track.lane_width_cm for s in roads] == [s.track.lane_width_cm for s in cameras]
    assert [s.track.preset for s in roads] == [s.track.preset for s in cameras]
    assert len({s.car.wheelbase_cm for s in cameras}) == 4 and len({s.car for s in roads}) == 1
    assert [s.camera.width for s in cameras] == [320, 160, 320, 160]
    assert len({s.camera.height_cm for s in cameras}) == 4 and {s.frames for s in cameras} == {60}
    with pytest.raises(ValidationError, match="variety 'all'"):
        varied(variety="roads", cameras=[{}])


def test_drives_that_cannot_be_mapped_are_left_out_as_far_as_allowed(tmp_path, monkeypatch):
    mapped: list[str] = []

    pictured: list[str] = []

    def map_drive(request: MapRequest, *_: object, pictures: bool) -> None:
        path = request.drive_path
        mapped.append(path.name)
        pictured.extend([path.name] if pictures else [])
        if path.name in ("train_01", "train_02"):
            raise TrackingLostError(f"{path.name}: no lane")

    def label_map(drive_map: Path, out: Path, **_: object) -> None:
        write_labels(out, _labels(np.arange(30)))

    monkeypatch.setattr("datagen.datasets.jobs.simulate_drive", lambda simulation, out: out)
    monkeypatch.setattr("datagen.datasets.jobs.map_drive", map_drive)
    monkeypatch.setattr("datagen.datasets.jobs.label_map", label_map)
    monkeypatch.setattr("datagen.datasets.jobs.truth_labels", lambda *_: _labels(np.arange(30)))
    with pytest.raises(TrackingLostError, match="train_01: no lane"):
        prepare(varied(), tmp_path / "strict")
    mapped.clear()
    pictured.clear()
    found = prepare(varied(may_fail=0.5), tmp_path / "work")
    assert [path.stem for path in found.train] == ["train_00", "train_03"]
    assert len(found.left_out) == 2 and found.left_out[0].startswith("train_01 (seed")
    # Of many drives only the first ones are there to be looked at.
    assert len(mapped) == 5 and pictured == ["train_00", "train_01", "validation_00"]
    prepare(varied(may_fail=0.5, train=6), tmp_path / "work")
    assert mapped[5:] == ["train_04", "train_05"] and len(pictured) == 3
    # What failed is not tried again, and what is there is kept.
    again = prepare(varied(may_fail=0.5), tmp_path / "work")
    assert again == found and len(mapped) == 7
    # What comes next is compiled with the first label set that there is, and changes nothing.
    given: list[Path] = []
    assert prepare(varied(may_fail=0.5), tmp_path / "work", last=given.append) == found
    assert given == found.train[:1]
    with pytest.raises(TrackingLostError, match=r"2 of 5 synthetic drives .* expected at most 1"):
        prepare(varied(may_fail=0.2), tmp_path / "work")


def test_a_recording_counts_as_many_drives_to_learn_from(tmp_path, monkeypatch):
    monkeypatch.setattr("datagen.datasets.jobs.map_drive", lambda *_, **__: None)
    monkeypatch.setattr("datagen.datasets.jobs.label_map", lambda _, out, **__: write_labels(out, whole))
    whole = _labels(np.arange(400))
    (tmp_path / "tub").mkdir()
    drives = (RecordedSettings(path=tmp_path / "tub", lane_width_cm=40.0, counts_as=3, weight=0.3),)
    # A recording alone needs no other process, nor does it leave one idle that could compile.
    given: list[Path] = []
    found = prepare(DataSettings(drives=drives, workers=2), tmp_path / "work", last=given.append)
    assert not given
    assert len(found.train) == 3 and len(set(found.train)) == 1
    assert found.weights == [0.3] * 3
    # Another weight makes no other labels.
    made = found.train[0].stat().st_mtime_ns
    again = drives[0].model_copy(update={"weight": 2.0})
    found = prepare(DataSettings(drives=(again,), workers=2), tmp_path / "work")
    assert found.weights == [2.0] * 3 and found.train[0].stat().st_mtime_ns == made
    assert len(found.validation) == len(found.of("test")) == 1


def test_a_whole_recording_is_learned_from_and_other_drives_choose(tmp_path, monkeypatch):
    monkeypatch.setattr("datagen.datasets.jobs.map_drive", lambda *_, **__: None)
    monkeypatch.setattr("datagen.datasets.jobs.label_map", lambda _, out, **__: write_labels(out, whole))
    whole = _labels(np.arange(400))
    for seed, name in enumerate(("whole", "split")):
        write_recording(tmp_path / name, lap(seed, 40))
    drive = RecordedSettings(path=tmp_path / "whole", lane_width_cm=40.0, split="none", counts_as=2)
    with pytest.raises(ConfigError, match="no validation drives"):
        prepare(DataSettings(drives=(drive,)), tmp_path / "work")
    other = RecordedSettings(path=tmp_path / "split", lane_width_cm=40.0)
    for _ in range(2):  # made, and found again
        found = prepare(DataSettings(drives=(drive, other), workers=1), tmp_path / "work")
        assert [len(read_labels(path)) for path in found.train] == [400, 400, 240]
        assert len(found.validation) == len(found.of("test")) == 1


def test_a_map_is_taken_as_it_is(tmp_path, monkeypatch):
    monkeypatch.setattr("datagen.datasets.jobs.map_drive", lambda *_, **__: pytest.fail("mapped again"))
    monkeypatch.setattr(
        "datagen.datasets.jobs.label_map",
        lambda folder, out, **__: write_labels(out, _labels(np.arange(read_map(folder).frames.size))),
    )
    drive_map = tmp_path / "map"
    write_map(drive_map, small_map(), {"frame": np.arange(2)}, {}, "given")
    recorded = RecordedSettings(path=drive_map, lane_width_cm=36.0, split="none")
    parts = RecordedJob(recorded, DataSettings(), tmp_path / "work").run()
    assert [(part.role, part.frames) for part in parts] == [("train", drive_map)]
    assert len(read_labels(parts[0].labels)) == read_map(drive_map).frames.size
    other = recorded.model_copy(update={"lane_width_cm": 40.0})
    with pytest.raises(
        ConfigError, match=r"map of a lane of 36 cm, but lane_width_cm is 40.*map it anew: lanenet map"
    ):
        RecordedJob(other, DataSettings(), tmp_path / "work").run()


def test_the_camera_is_that_of_all_drives_or_of_the_example(tmp_path):
    def owner(data: DataSettings) -> str | None:
        roles = [role for role in ("train", "test") if getattr(data.synthetic, role)]
        jobs = [SyntheticJob.draw(data, role, 0, tmp_path) for role in roles]
        jobs += [RecordedJob(drive, data, tmp_path) for drive in data.drives]
        path = shared_camera(data, jobs)
        assert path is None or path.name == "camera.yaml"
        return None if path is None else path.parent.name.partition("-")[0]

    tubs = tuple(RecordedSettings(path=tmp_path / name, lane_width_cm=40.0) for name in ("tub", "other"))
    assert owner(varied()) == "train_00"
    assert owner(varied(variety="all")) == "test_00"
    assert owner(varied(variety="all", test=0)) is None
    assert owner(varied().model_copy(update={"drives": tubs[:1]})) is None
    assert owner(DataSettings(drives=tubs[:1])) == "tub" and owner(DataSettings(drives=tubs)) is None


def test_a_run_without_drives_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="no train drives"):
        prepare(DataSettings(), tmp_path)
    assert not any(tmp_path.iterdir())


def test_test_drives_lead_to_their_frames(tmp_path):
    data = DataSettings(synthetic=SyntheticSettings(train=1, test=1))
    folders = [SyntheticJob.draw(data, role, 0, tmp_path).frames for role in ("test", "validation")]
    # The truth of a test drive lies with the drive; the labels of the others come from its map.
    assert folders == [tmp_path / "synthetic/drives/test_00", tmp_path / "synthetic/maps/validation_00"]
    recorded = RecordedSettings(path=tmp_path / "tub", lane_width_cm=40.0)
    frames = RecordedJob(recorded, data, tmp_path / "drives").frames
    assert frames.parent == tmp_path / "drives/maps" and frames.name.startswith("tub-")


def test_drives_have_names_for_people(tmp_path):
    data = DataSettings(synthetic=SyntheticSettings(train=2))
    job = SyntheticJob.draw(data, "train", 1, tmp_path)
    assert job.title == f"train_01 (seed {job.simulation.seed})"
    recorded = RecordedSettings(path=Path("drives/tub"), lane_width_cm=40.0)
    assert RecordedJob(recorded, data, tmp_path).title == "drives/tub"


def test_a_recorded_drive_is_mapped_again_only_when_something_changed(tmp_path, monkeypatch):
    made: list[str] = []

    def map_drive(request: MapRequest, _: object, out: Path, progress: None, earlier: list[Path]) -> None:
        made.append("map")
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir(parents=True)
        (out / "map.yaml").touch()

    def label_map(drive_map: Path, out: Path, window: BirdseyeWindow, colour_weight: float) -> None:
        made.append("label")
        write_labels(out, _labels(np.arange(400)))

    monkeypatch.setattr("datagen.datasets.jobs.map_drive", map_drive)
    monkeypatch.setattr("datagen.datasets.jobs.label_map", label_map)
    drive, camera = tmp_path / "drive", tmp_path / "camera.yaml"
    drive.mkdir()
    (drive / "frames.csv").write_text("frame\n1\n")
    camera.write_text("height_cm: 15\n")
    recorded = RecordedSettings(path=drive, lane_width_cm=40.0, camera=camera)
    window, folder = BirdseyeWindow(), tmp_path / "work"

    def times(
        recorded: RecordedSettings, window: BirdseyeWindow = window, colour_weight: float = 0.75
    ) -> tuple[int, int]:
        """How often the drive was mapped and labelled so far, after asking for its labels once more."""
        data = DataSettings(window=window, colour_weight=colour_weight)
        parts: tuple[Part, ...] = RecordedJob(recorded, data, folder).run()
        assert [len(read_labels(part.labels)) for part in parts] == [240, 20, 60]
        assert [part.role for part in parts] == ["train", "validation", "test"]
        return made.count("map"), made.count("label")

    assert times(recorded) == (1, 1)
    assert times(recorded) == (1, 1)
    camera.write_text("height_cm: 15.5\n")
    assert times(recorded) == (2, 2)
    (drive / "frames.csv").write_text("frame\n1\n2\n")
    assert times(recorded) == (3, 3)
    assert times(recorded.model_copy(update={"lane_width_cm": 41.0})) == (4, 4)
    assert times(recorded) == (5, 5)
    # What the map does not depend on leaves it as it is.
    assert times(recorded, BirdseyeWindow(cell_cm=1.0)) == (5, 6)
    assert times(recorded, BirdseyeWindow(cell_cm=1.0), colour_weight=0.0) == (5, 7)
    assert times(recorded.model_copy(update={"counts_as": 2})) == (5, 8)
    assert times(recorded) == (5, 9)
    # A part that got lost is made again, and so is a map that is gone.
    next((folder / "labels").glob("*.validation.parquet")).unlink()
    assert times(recorded) == (5, 10)
    assert times(recorded) == (5, 10)
    shutil.rmtree(next((folder / "maps").iterdir()))
    assert times(recorded, colour_weight=0.5) == (6, 11)


def test_a_recording_is_listed_once(tmp_path):
    drive = RecordedSettings(path=tmp_path / "tub", lane_width_cm=40.0)
    again = RecordedSettings(path=tmp_path / "maps" / ".." / "tub", lane_width_cm=30.0)
    with pytest.raises(ValueError, match=r"tub is listed twice.*counts_as"):
        DataSettings(drives=(drive, again))


@pytest.mark.parametrize(("frames", "enough"), [(59, False), (60, True)])
def test_a_drive_that_is_too_short_is_refused_before_any_is_mapped(tmp_path, frames, enough):
    drive = write_recording(tmp_path / "drive", lap(frames=frames))
    recorded = RecordedSettings(path=drive, lane_width_cm=40.0)
    job = RecordedJob(recorded, DataSettings(), tmp_path / "work")
    if enough:
        job.check_long_enough()
        return
    with pytest.raises(TrackingLostError, match="found 59 frames of a car that drives, expected 60"):
        job.check_long_enough()


def test_a_map_stays_known_while_one_of_another_width_is_made(tmp_path, monkeypatch):
    drive = write_recording(tmp_path / "drive", lap(frames=3))
    narrow, wide = (
        RecordedJob(RecordedSettings(path=drive, lane_width_cm=cm), DataSettings(), tmp_path / "work")
        for cm in (31.0, 37.0)
    )
    assert narrow.frames == wide.frames
    narrow.frames.mkdir(parents=True)
    (narrow.frames / "map.yaml").write_text("a map")
    narrow.map_output.mark()

    def interrupted(*_, **__: object):
        raise KeyboardInterrupt

    monkeypatch.setattr("datagen.datasets.jobs.map_drive", interrupted)
    with pytest.raises(KeyboardInterrupt):
        wide.make_map()
    assert narrow.is_mapped and not wide.is_mapped


@pytest.mark.parametrize("split", ["time", "train"])
def test_a_label_set_of_another_window_is_learned_in_that_of_the_run(tmp_path, split):
    path = tmp_path / "set.parquet"
    write_labels(path, _labels(np.arange(400)))
    before = path.read_bytes()
    data = DataSettings(window=GENERAL_WINDOW)
    job = RecordedJob(RecordedSettings(path=path, lane_width_cm=40.0, split=split), data, tmp_path / "work")
    parts = job.run()
    assert {read_labels(part.labels).meta.window for part in parts} == {GENERAL_WINDOW}
    assert read_labels(job.whole).meta.window == GENERAL_WINDOW and path.read_bytes() == before


def test_the_camera_of_a_label_set_is_that_of_the_run(tmp_path):
    labels, path = _labels(np.arange(400)), tmp_path / "set.parquet"
    camera = read_camera(Path(__file__).resolve().parents[3] / "checkpoints" / "small" / "camera.yaml")
    data = DataSettings(drives=(RecordedSettings(path=path, lane_width_cm=40.0),))
    write_labels(path, labels)
    assert prepare(data, tmp_path / "work").camera is None
    write_labels(path, replace(labels, meta=replace(labels.meta, camera=camera, camera_hash=camera.hash)))
    found = prepare(data, tmp_path / "work").camera
    assert found is not None and read_camera(found).hash == camera.hash
