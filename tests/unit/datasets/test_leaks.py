"""Drives that would leak between training and test are refused, and whatever cannot be checked is said."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from commands import refused
from recordings import lap, write_recording
from small_map import small_map

from datagen.datasets import leaks
from datagen.datasets.build import check_leaks, prepare
from datagen.datasets.settings import ROLES, DataSettings, RecordedSettings
from lanenet.data.label_set import LabelMeta, LabelSet, write_labels
from lanenet.data.library import Library
from lanenet.data.maps.folder import read_map, write_map
from lanenet.data.maps.joined import FORMAT, JoinedDrive, JoinedMeta, write_joined
from lanenet.errors import ConfigError
from lanenet.geometry.birdseye import BirdseyeWindow


def _run(*drives: dict[str, Any]) -> DataSettings:
    named = [{"lane_width_cm": 40.0, **drive} for drive in drives]
    return DataSettings.model_validate({"drives": named, "workers": 1})


@pytest.fixture
def drives(tmp_path: Path) -> dict[str, Path]:
    """A recording, a copy, a copy encoded again, two cuts that overlap, and another lap."""
    pictures = lap(1, 160)
    made = {
        "whole": write_recording(tmp_path / "whole", pictures),
        "again": write_recording(tmp_path / "again", pictures, quality=40, scale=0.8),
        "early": write_recording(tmp_path / "early", pictures[:100], quality=60),
        "late": write_recording(tmp_path / "late", pictures[50:], quality=80, first=7),
        "lap": write_recording(tmp_path / "lap", lap(2, 160)),
    }
    made["copy"] = tmp_path / "copy"
    shutil.copytree(made["whole"], made["copy"])
    return made


@pytest.mark.parametrize(
    ("one", "other", "what"),
    [
        ("whole", "copy", r"whole has the same images as \S*copy: its frames 0 to 159 are 0 to 159"),
        ("whole", "again", r"whole is a re-encoded copy of \S*again: its frames 0 to 159 are 0 to 159"),
        ("early", "whole", r"early is a cut of \S*whole: its frames 0 to 99 are 0 to 99"),
        ("early", "late", r"early overlaps with \S*late: .* its frames 50 to 99 are 7 to 56 of"),
    ],
)
@pytest.mark.parametrize("splits", [("time", "time"), ("train", "test"), ("validation", "auto")])
def test_drives_of_one_recording_in_different_parts_are_refused(
    drives: dict[str, Path], tmp_path: Path, one: str, other: str, what: str, splits: tuple[str, str]
) -> None:
    run = _run({"path": drives[one], "split": splits[0]}, {"path": drives[other], "split": splits[1]})
    for _ in range(2):  # a refusal is not kept
        with pytest.raises(ConfigError, match=f"1 pair of drives would leak .*{what}"):
            check_leaks(run, tmp_path / "work")


def test_drives_of_one_recording_may_be_in_one_part_and_other_laps_in_any(
    drives: dict[str, Path], tmp_path: Path
) -> None:
    run = _run(
        {"path": drives["whole"], "split": "train"},
        {"path": drives["again"], "split": "none"},
        {"path": drives["lap"], "split": "test"},
    )
    assert check_leaks(run, tmp_path / "work") == ()


def test_only_frames_that_are_used_count(drives: dict[str, Path], tmp_path: Path) -> None:
    early = {"path": drives["whole"], "frames": (0, 70), "split": "train"}
    assert check_leaks(_run(early, {"path": drives["copy"], "frames": (71, 159)}), tmp_path / "work") == ()
    with pytest.raises(ConfigError, match="its frames 40 to 70 are 40 to 70"):
        check_leaks(_run(early, {"path": drives["copy"], "frames": (40, 159)}), tmp_path / "work")


def _map_of(drive: Path, out: Path) -> Path:
    made = small_map()
    meta = made.meta.model_copy(update={"drive": str(drive)})
    write_map(out, replace(made, meta=meta), {"frame": np.arange(2)}, {}, "given")
    return out


def test_a_map_is_known_by_its_recording(drives: dict[str, Path], tmp_path: Path) -> None:
    drive_map = _map_of(drives["whole"], tmp_path / "map")
    frames = read_map(drive_map).frames
    used = write_recording(tmp_path / "long", lap(1, int(frames[-1]) + 60))
    drive_map = _map_of(used, tmp_path / "map")
    run = _run({"path": drive_map, "lane_width_cm": 36.0}, {"path": used, "split": "test"})
    with pytest.raises(ConfigError, match=r"map is a cut of \S*long"):
        check_leaks(run, tmp_path / "work")


def test_a_map_whose_recording_is_gone_is_named(drives: dict[str, Path], tmp_path: Path) -> None:
    drive_map = _map_of(tmp_path / "gone", tmp_path / "map")
    run = _run({"path": drive_map, "lane_width_cm": 36.0}, {"path": drives["whole"]}, {"path": drives["lap"]})
    (said,) = check_leaks(run, tmp_path / "work")
    assert str(drive_map) in said and "gone is not here" in said


def test_a_library_is_asked_for_a_recording_that_has_moved(tmp_path: Path) -> None:
    pictures = lap(1, int(small_map().frames[-1]) + 60)
    used = write_recording(tmp_path / "used", pictures)
    again = write_recording(tmp_path / "again", pictures)
    drive_map = _map_of(used, tmp_path / "map")
    library = Library.open(tmp_path / "known.sqlite", create=True)
    library.add(used, name="hall_monday", lane_width_cm=40.0)
    used.rename(tmp_path / "moved")
    run = _run({"path": drive_map, "lane_width_cm": 36.0, "split": "train"}, {"path": again})
    (said,) = check_leaks(run, tmp_path / "work")
    assert "used is not here" in said
    asked = run.model_copy(update={"known_drives": library.path})
    with pytest.raises(ConfigError, match=r"map is a cut of \S*again"):
        check_leaks(asked, tmp_path / "work")
    # By the name of the library, where that was moved with its drives.
    elsewhere = _map_of(tmp_path / "other" / "place", tmp_path / "map")
    named = {"path": elsewhere, "lane_width_cm": 36.0, "split": "train", "name": "hall_monday"}
    with pytest.raises(ConfigError, match="hall_monday"):
        check_leaks(
            _run(named, {"path": again}).model_copy(update={"known_drives": library.path}),
            tmp_path / "work",
        )
    # One that the library does not know stays unknown, and one in the same part is no leak.
    whole = run.drives[1].model_copy(update={"split": "train"})
    apart = asked.model_copy(update={"drives": (run.drives[0], whole)})
    assert check_leaks(apart, tmp_path / "work") == ()


def test_maps_that_were_joined_are_of_one_track_also_if_they_are_listed_one_by_one(tmp_path: Path) -> None:
    for name in ("monday", "tuesday"):
        _map_of(write_recording(tmp_path / name, lap(len(name), 80)), tmp_path / "track" / name)
    place = {"x_cm": 0.0, "y_cm": 0.0, "turn_rad": 0.0, "scale": 1.0, "opposite": False}
    members = tuple(JoinedDrive(map=n, made_from=n, **place) for n in ("monday", "tuesday"))
    write_joined(tmp_path / "track", JoinedMeta(format=FORMAT, shared_camera=True, drives=members))
    alone = [{"path": tmp_path / "track" / name, "lane_width_cm": 36.0} for name in ("monday", "tuesday")]
    for splits in (("train", "test"), ("time", "time")):
        run = _run(*({**one, "split": split} for one, split in zip(alone, splits, strict=True)))
        with pytest.raises(ConfigError, match=r"monday .* and .*tuesday .* are both joined in \S*track"):
            check_leaks(run, tmp_path / "work")
    together = _run(*({**one, "split": "train"} for one in alone))
    assert check_leaks(together, tmp_path / "work") == ()
    # The folder as a whole is one road, which may be split as that of one drive.
    folder = _run({"path": tmp_path / "track", "lane_width_cm": 36.0, "split": "time"})
    assert check_leaks(folder, tmp_path / "work") == ()


def _labels(out: Path, seed: int, rows: slice) -> Path:
    rng = np.random.default_rng(seed)
    edges = [rng.normal(size=(5, 6)).astype(np.float32) for _ in range(80)][rows]
    n, nothing = len(edges), np.empty((0, 2))
    labels = LabelSet(
        meta=LabelMeta(BirdseyeWindow(), "camera", 17.0, 40.0, "map"),
        drive=["drive"] * n,
        file=[""] * n,
        frame=np.arange(n),
        t_s=0.05 * np.arange(n),
        lap=np.zeros(n, dtype=np.int64),
        poses=np.zeros((n, 3)),
        points_cm=np.zeros((n, 6)),
        edges=edges,
        lines=[(nothing, nothing)] * n,
        quality=np.ones(n),
        divides=np.zeros((n, 2), dtype=bool),
    )
    write_labels(out, labels)
    return out


def test_label_sets_are_compared_by_their_edges_alone(drives: dict[str, Path], tmp_path: Path) -> None:
    one, cut, other = (
        _labels(tmp_path / f"{name}.parquet", seed, rows)
        for name, seed, rows in (("one", 1, slice(0, 80)), ("cut", 1, slice(30, 80)), ("other", 2, slice(80)))
    )
    run = _run({"path": one, "split": "train"}, {"path": other}, {"path": drives["whole"]})
    said = check_leaks(run, tmp_path / "work")
    assert [line.partition(":")[0] for line in said] == [str(one), str(other)]
    assert check_leaks(run, tmp_path / "work") == said
    with pytest.raises(ConfigError, match=r"one.parquet holds all of \S*cut.parquet, which is a cut of it"):
        check_leaks(_run({"path": one, "split": "train"}, {"path": cut}), tmp_path / "work")


def test_what_was_compared_is_not_compared_again(
    drives: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = _run({"path": drives["whole"]}, {"path": drives["lap"]})
    check_leaks(run, tmp_path / "work")
    monkeypatch.setattr(leaks, "find_overlaps", lambda *_: pytest.fail("compared again"))
    check_leaks(run, tmp_path / "work")
    shutil.rmtree(drives["lap"])
    shutil.copytree(drives["again"], drives["lap"])
    monkeypatch.undo()
    with pytest.raises(ConfigError, match="re-encoded copy"):
        check_leaks(run, tmp_path / "work")


@pytest.mark.parametrize("splits", [("train", "test"), ("time", "time"), ("train", "lap")])
def test_drives_of_one_track_in_different_parts_are_refused(tmp_path: Path, splits: tuple[str, str]) -> None:
    run = _run(
        *(
            {"path": tmp_path / f"{k}", "track": track, "split": split}
            for k, (track, split) in enumerate(zip(("hall", "Hall "), splits, strict=True))
        )
    )
    with pytest.raises(ConfigError, match="are both of the track 'hall'"):
        check_leaks(run, tmp_path / "work")


def test_drives_of_one_track_may_be_in_one_part(drives: dict[str, Path], tmp_path: Path) -> None:
    run = _run(
        {"path": drives["whole"], "track": "hall", "split": "train"},
        {"path": drives["early"], "track": "hall", "split": "train"},
        {"path": drives["lap"], "track": "yard", "split": "lap"},
    )
    assert check_leaks(run, tmp_path / "work") == ()


def test_a_split_says_which_parts_a_drive_is_in() -> None:
    def parts(split: str) -> tuple[str, ...]:
        return RecordedSettings.model_validate({"path": "a", "lane_width_cm": 40, "split": split}).parts

    assert [parts(split) for split in ("time", "lap", "auto")] == [ROLES] * 3
    assert [parts(split) for split in (*ROLES, "none")] == [*((role,) for role in ROLES), ("train",)]


def test_whole_drives_make_the_parts_of_a_run(
    drives: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("datagen.datasets.jobs.map_drive", lambda *_, **__: None)
    monkeypatch.setattr("datagen.datasets.jobs.label_map", lambda _, out, **__: _labels(out, 1, slice(0, 80)))
    write_recording(tmp_path / "yard", lap(5, 60))
    names = {"train": "whole", "validation": "lap", "test": "yard"}
    run = _run(*({"path": tmp_path / name, "split": role} for role, name in names.items()))
    found = prepare(run, tmp_path / "work")
    assert [(part.role, part.labels.name.partition("-")[0]) for part in found.parts] == list(names.items())
    without = _run(*({"path": tmp_path / name, "split": "train"} for name in ("whole", "lap")))
    with pytest.raises(ConfigError, match=r"no validation drives; .* \(split: validation\)"):
        prepare(without, tmp_path / "other")
    leaky = _run(*({"path": drives[name], "split": "time"} for name in ("whole", "again")))
    with pytest.raises(ConfigError, match="would leak"):
        prepare(leaky, tmp_path / "leaky")
    assert not list((tmp_path / "leaky").rglob("*.parquet"))


def test_a_training_that_would_leak_is_refused_before_anything_is_made(
    drives: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    listed = [
        {"path": name, "lane_width_cm": 40.0, "split": split}
        for name, split in (("whole", "train"), ("again", "test"), ("lap", "validation"))
    ]
    (tmp_path / "leaky.yaml").write_text(yaml.safe_dump({"name": "leaky", "data": {"drives": listed}}))
    said = refused(tmp_path, "train", "leaky.yaml", writes="runs")
    assert "error: data.drives: 1 pair of drives would leak" in said
    assert "whole is a re-encoded copy of again: its frames 0 to 159 are 0 to 159 of again" in said
    made = {
        path.relative_to(tmp_path / "runs" / "leaky").parts[:2]
        for path in (tmp_path / "runs").rglob("*")
        if path.is_file()
    }
    assert made == {("train.log",), ("drives", "leaks")}
