"""Drives of a library are split by their tracks, as drawn or as told, and listed one by one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from recordings import lap, write_recording

from datagen.datasets.build import check_leaks, recorded_jobs
from datagen.datasets.from_library import _labelled, parts_of_tracks, with_library
from datagen.datasets.settings import DataSettings, LibrarySettings
from datagen.fleet.result import INDEX_NAME, FleetResult, Labelled, _index
from datagen.fleet.source import checksum
from datagen.fleet.task import FleetDrive
from lanenet.data.files import write_json
from lanenet.data.library import Library
from lanenet.errors import ConfigError

TRACKS = {"a1": "hall", "a2": "hall", "b": "yard", "c": "club"}


@pytest.fixture
def library(tmp_path: Path) -> Library:
    made = Library.open(tmp_path / "drives.sqlite", create=True)
    for seed, (name, track) in enumerate(TRACKS.items()):
        told = {"track": track, "licence": "CC0-1.0", "car": "red"}
        made.add(write_recording(tmp_path / name, lap(seed, 40)), lane_width_cm=40.0, **told)
    return made


def _data(library: Library, **settings: Any) -> DataSettings:
    return DataSettings.model_validate({"library": {"file": library.path, **settings}})


def test_all_drives_of_a_track_are_in_one_part(library: Library, tmp_path: Path) -> None:
    data, lines = with_library(_data(library, test_tracks=["hall"], validation_tracks=["club"]))
    found = {drive.path.name: (drive.split, drive.track) for drive in data.drives}
    assert found == {
        "a1": ("test", "hall"),
        "a2": ("test", "hall"),
        "b": ("train", "yard"),
        "c": ("validation", "club"),
    }
    assert {(drive.licence, drive.car) for drive in data.drives} == {("CC0-1.0", "red")}
    whole, given = with_library(_data(library, split="train"))
    assert {drive.split for drive in whole.drives} == {"train"}
    assert given == ["train: 4 drives of the tracks club, hall, yard"]
    often, _ = with_library(_data(library, weight=0.3, counts_as=15))
    assert {(drive.weight, drive.counts_as) for drive in often.drives} == {(0.3, 15)}
    assert data.library is None and with_library(data) == (data, [])
    assert "test: 2 drives of the tracks hall" in lines
    assert check_leaks(data, tmp_path / "work") == ()


def test_the_draw_follows_from_the_seed_and_the_names(library: Library) -> None:
    def drawn(tracks: set[str], seed: int) -> dict[str, str]:
        return dict(parts_of_tracks(tracks, LibrarySettings(file=library.path, seed=seed)))

    many = {f"track {k}" for k in range(20)}
    one = drawn(many, 1)
    assert one == drawn(many, 1) != drawn(many, 2)
    assert sorted(one.values()) == ["test"] * 4 + ["train"] * 13 + ["validation"] * 3
    # A new track moves at most one at each border.
    for name in map(str, range(50)):
        more = drawn({*many, name}, 1)
        moved = [(part, more[track]) for track, part in one.items() if more[track] != part]
        assert len(moved) <= 2 and all("train" in pair for pair in moved)


def test_what_label_all_made_is_used_and_what_it_refused_is_left_out(
    library: Library, tmp_path: Path
) -> None:
    def labelled(name: str, verdict: str, reason: str = "") -> Labelled:
        drive = FleetDrive(name, str(tmp_path / name), checksum(str(tmp_path / name)), 40.0)
        return Labelled(drive, verdict, reason, True, f"map-{name}", f"labels-{name}", {}, {})

    found = FleetResult(
        (labelled("a1", "good"), labelled("a2", "refused", "stands still"), labelled("b", "usable"))
    )
    (tmp_path / "out").mkdir()
    write_json(tmp_path / "out" / INDEX_NAME, _index(found))
    chosen = {"labelled": tmp_path / "out", "validation_tracks": ["yard"], "test_tracks": ["hall"]}
    with pytest.raises(ConfigError, match="2 tracks, which leave none for train"):
        with_library(_data(library, **chosen))
    write_json(tmp_path / "out" / INDEX_NAME, _index(FleetResult((*found.drives, labelled("c", "good")))))
    data, lines = with_library(_data(library, **chosen))
    assert [drive.path for drive in data.drives] == [
        tmp_path / "out" / "maps" / f"map-{name}" for name in ("a1", "b", "c")
    ]
    assert lines[0] == "left out: a2: stands still"
    # Messages name drives as the library does, not by the keys of their maps.
    assert [job.title for job in recorded_jobs(data, tmp_path / "work")] == ["a1", "b", "c"]
    assert data.known_drives == library.path
    # A drive that has other frames by now is not what was labelled.
    image = next((tmp_path / "b").rglob("*.jpg"))
    before = image.read_bytes()
    image.write_bytes(before + b"more")
    _, lines = _labelled(tmp_path / "out", {"b": tmp_path / "b", "c": tmp_path / "c"})
    assert lines == ["left out: b: its files have changed since it was labelled; label it again"]
    image.write_bytes(before)
    assert _labelled(tmp_path / "out", {"b": tmp_path / "b"})[1] == []
    # Another drive that has the name of one by now, on another track, has no map yet.
    paths, lines = _labelled(tmp_path / "out", {"b": tmp_path / "b", "c": tmp_path / "new"})
    assert list(paths) == ["b"] and len(lines) == 1
    assert f"left out: c: labelled from {tmp_path / 'c'}, but is {tmp_path / 'new'}" in lines[0]
    (tmp_path / "out" / INDEX_NAME).write_text("[]")
    with pytest.raises(ConfigError, match="expected what lanenet label-all writes"):
        with_library(_data(library, **chosen))


def test_drives_that_are_listed_too_are_listed_once(library: Library, tmp_path: Path) -> None:
    data = _data(library)
    twice = data.model_copy(update={"drives": with_library(data)[0].drives[:1]})
    with pytest.raises(ValueError, match="is listed twice"):
        with_library(twice)


def test_what_is_not_known_is_asked_for(library: Library) -> None:
    library.update("b", track="")
    with pytest.raises(ConfigError, match=r"1 drive without a track: b; type lanenet drives set b --track"):
        with_library(_data(library))
    library.update("b", track="yard", lane_width_cm=None)
    with pytest.raises(ConfigError, match="1 drive without a lane width: b"):
        with_library(_data(library))
    library.update("b", lane_width_cm=40.0)
    with pytest.raises(ConfigError, match="no drive of the track 'gym', expected one of club, hall, yard"):
        with_library(_data(library, test_tracks=["gym"]))
    with pytest.raises(ValueError, match="'hall' is one of validation_tracks and of test_tracks"):
        _data(library, test_tracks=["hall"], validation_tracks=["hall"])
    library.update("b", track="hall")
    with pytest.raises(ConfigError, match="drives of 2 tracks, which leave none for train"):
        with_library(_data(library))
