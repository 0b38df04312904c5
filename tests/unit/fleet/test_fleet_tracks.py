"""Maps of one track are joined once all are made; which drives are of one is named, or seen in the maps."""

from __future__ import annotations

import errno
import json
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from fleet_runs import copy_of, drives_of, run

from datagen.fleet import tracks
from datagen.fleet.result import Labelled
from datagen.fleet.storage import Storage
from datagen.fleet.task import FleetDrive
from datagen.made import key_of
from datagen.quality.figures import Report
from datagen.tracks.recognise import Recognised
from lanenet.data.maps.joined import FORMAT, JoinedDrive, JoinedMeta, maps_in, read_joined, write_joined
from lanenet.errors import LanenetError, TrackingLostError

RELAID = {"text": "80 cm of a line near x 10, y 20 cm: 4.0 cm between a and b"}


@pytest.fixture
def joining(monkeypatch: pytest.MonkeyPatch, mapping: list[str]) -> list[list[str]]:
    """Instead of joining, copy the maps, but for those of drives that are elsewhere; notes the names."""
    joined: list[list[str]] = []

    def join(visits: Mapping[str, Any], out: Path) -> Report:
        joined.append(list(visits))
        names = [name for name in visits if "elsewhere" not in name]
        if len(names) < 2:
            raise TrackingLostError("no two of 2 maps are joined")
        for name in names:
            shutil.copytree(visits[name].folder, out / name)
        shutil.copy(out / names[0] / "map.png", out / "map.png")
        place = {"x_cm": 0.0, "y_cm": 0.0, "turn_rad": 0.0, "scale": 1.0, "opposite": False}
        drives = tuple(JoinedDrive(map=name, made_from=str(visits[name].folder), **place) for name in names)
        write_joined(out, JoinedMeta(format=FORMAT, shared_camera=True, drives=drives))
        figures = {
            "drives": {name: {} for name in names},
            "left_out": {name: "is of another track" for name in visits if name not in names},
            "lane_cm": 40.2,
            "shared_camera": True,
            "relaid": [RELAID],
        }
        return Report((), figures)

    monkeypatch.setattr(tracks, "join_fitting", join)
    return joined


def on(track: str, tiny: Path, folder: Path, *names: str) -> list[FleetDrive]:
    paths = [folder / name if (folder / name).exists() else copy_of(tiny, folder / name) for name in names]
    return [replace(drive, track=track) for drive in drives_of(*paths)]


def test_maps_of_a_named_track_are_joined_and_lines_that_were_laid_anew_are_named(
    tiny: Path, tmp_path: Path, joining: list[list[str]]
):
    drives = on("hall", tiny, tmp_path, "a", "b", "elsewhere") + on("yard", tiny, tmp_path, "alone")
    result, names = run(tmp_path / "out", drives)
    assert names == ["a", "b", "elsewhere", "alone", "hall"] and joining == [["a", "b", "elsewhere"]]
    (track,) = result.tracks
    assert track.name == "hall" and track.count == 3 and track.joined == ("a", "b")
    assert track.left_out == {"elsewhere": "is of another track"} and track.lane_cm == 40.2
    assert track.relaid == ("80 cm of a line near x 10, y 20 cm: 4.0 cm between a and b",)
    index = json.loads((tmp_path / "out" / "drives.json").read_text())["drives"]
    assert [drive["joined"] for drive in index] == [f"tracks/{track.key}/{n}" for n in "ab"] + [None, None]
    folder = tmp_path / "out" / "tracks" / track.key
    assert maps_in(folder) == [folder / "a", folder / "b"]
    (first, _) = read_joined(folder).drives
    assert first.made_from == f"{tmp_path / 'out'}/maps/{result.drives[0].map_key}"
    page = (tmp_path / "out" / "index.html").read_text()
    assert "Tracks" in page and "Elsewhere is not joined to hall: is of another track" in page
    assert "Hall: laid anew: 80 cm of a line" in page and "hall: a, b" in page
    again, names = run(tmp_path / "out", drives)
    assert names == [] and again.tracks == result.tracks


def test_a_new_drive_of_a_track_joins_that_track_again_and_labels_nothing_else(
    tiny: Path, tmp_path: Path, joining: list[list[str]]
):
    hall, yard = on("hall", tiny, tmp_path, "a", "b"), on("yard", tiny, tmp_path, "x", "y")
    run(tmp_path / "out", hall + yard)
    _, names = run(tmp_path / "out", [*hall, *yard, *on("hall", tiny, tmp_path, "c")])
    assert names == ["c", "hall"]
    assert run(tmp_path / "out", hall + yard, each_alone=True)[0].tracks == ()


def test_of_the_drives_that_a_long_driven_track_gets_few_join_it_anew(tmp_path: Path):
    storage = Storage(str(tmp_path))
    drives = [
        Labelled(FleetDrive(f"lap {k}", "tub", str(k), 40.0), "good", "", True, key_of(k), "")
        for k in range(100)
    ]
    jobs = [tracks.track_job("hall", drives[:count], storage) for count in range(2, 101)]
    assert max(len(job.drives) for job in jobs) == 12
    # Expected of keys at random: 11 to the twelfth drive, and 12 (1/13 + ... + 1/100), 25, after it.
    assert len({job.key for job in jobs}) < 50
    names = [drive.name for drive, _ in jobs[-1].drives]
    assert names == [drive.drive.name for drive in drives if drive.drive.name in names]


def test_maps_that_are_not_joined_are_an_answer(tiny: Path, tmp_path: Path, joining: list[list[str]]):
    drives = on("hall", tiny, tmp_path, "a", "elsewhere")
    result, _ = run(tmp_path / "out", drives)
    assert result.tracks[0].reason == "no two of 2 maps are joined" and not result.tracks[0].joined
    assert [drive.verdict for drive in result.drives] == ["good", "good"]
    assert run(tmp_path / "out", drives)[1] == []


def test_maps_that_did_not_fit_are_joined_again_if_that_is_asked_for(
    tiny: Path, tmp_path: Path, joining: list[list[str]]
):
    drives = on("hall", tiny, tmp_path, "a", "elsewhere")
    run(tmp_path / "out", drives)
    assert run(tmp_path / "out", drives, refused_again=True)[1] == ["hall"]
    # What is new has nothing that could be swept away.
    drives += on("yard", tiny, tmp_path, "x", "y")
    assert run(tmp_path / "out", drives, refused_again=True)[1] == ["x", "y", "hall", "yard"]
    assert joining == [["a", "elsewhere"]] * 3 + [["x", "y"]]


def test_maps_that_could_not_be_compared_are_named_and_compared_in_the_next_run(
    tiny: Path, tmp_path: Path, joining: list[list[str]], monkeypatch: pytest.MonkeyPatch
):
    def name_of(folder: Path) -> str:
        return str(json.loads((folder / "result.json").read_text())["name"])

    def read(folder: Path) -> str:
        if broken == name_of(folder):
            raise LanenetError(f"{broken}: cannot be read")
        return ""

    drives = on("", tiny, tmp_path, "a", "b", "c")
    monkeypatch.setattr(tracks, "read_shape", read)
    monkeypatch.setattr(tracks, "recognise", lambda one, other: Recognised("different", ""))
    broken = "b"
    result, _ = run(tmp_path / "out", drives, find_tracks=True)
    key = result.drives[1].map_key
    assert result.uncompared == ("track of b: b: cannot be read", f"the map {key}: b: cannot be read")
    assert "ould not be compared: track of b" in (tmp_path / "out" / "index.html").read_text()
    # The others were compared for all that.
    assert len(json.loads((tmp_path / "out" / "alike.json").read_text())) == 1
    broken = ""
    monkeypatch.setattr(tracks, "recognise", lambda one, other: Recognised("same", ""))
    result, _ = run(tmp_path / "out", drives, find_tracks=True)
    assert result.uncompared == () and result.tracks[0].joined == ("a", "b", "c")


def test_a_join_that_the_disk_has_no_room_for_is_tried_again(
    tiny: Path, tmp_path: Path, joining: list[list[str]], monkeypatch: pytest.MonkeyPatch
):
    def full(visits: Mapping[str, Any], out: Path) -> Report:
        raise LanenetError(f"{out}: cannot be written") from OSError(errno.ENOSPC, "No space left")

    drives = on("hall", tiny, tmp_path, "a", "b")
    with monkeypatch.context() as patch:
        patch.setattr(tracks, "join_fitting", full)
        result, _ = run(tmp_path / "out", drives)
    assert "No space left" in result.disk_full or "cannot be written" in result.disk_full
    result, names = run(tmp_path / "out", drives)
    assert names == ["hall"] and result.tracks[0].joined == ("a", "b")


@pytest.mark.parametrize(
    "order", [("x", "both", "y", "y_too"), ("y", "x", "both", "y_too"), ("both", "y_too", "y", "x")]
)
def test_a_drive_that_looks_like_two_named_tracks_moves_no_drive_to_another(
    tiny: Path,
    tmp_path: Path,
    joining: list[list[str]],
    monkeypatch: pytest.MonkeyPatch,
    order: tuple[str, ...],
):
    monkeypatch.setattr(
        tracks, "read_shape", lambda folder: json.loads((folder / "result.json").read_text())["name"]
    )
    monkeypatch.setattr(
        tracks,
        "recognise",
        lambda one, other: Recognised("same" if "both" in (one, other) else "different", ""),
    )
    named = {"x": "hall", "y": "yard", "y_too": "yard", "both": ""}
    drives = [drive for name in order for drive in on(named[name], tiny, tmp_path, name)]
    result, _ = run(tmp_path / "out", drives, find_tracks=True)
    assert [(track.name, set(track.joined)) for track in result.tracks] == [("yard", {"y", "y_too"})]


def test_tracks_without_a_name_are_recognised_and_no_pair_is_compared_twice(
    tiny: Path, tmp_path: Path, joining: list[list[str]], monkeypatch: pytest.MonkeyPatch
):
    out, compared = tmp_path / "out", list[tuple[str, str]]()
    named = {"north": "n", "north_too": "n", "south": "s", "a": "hall", "unnamed": "hall"}

    def name_of(folder: Path) -> str:
        return str(json.loads((folder / "result.json").read_text())["name"])

    def alike(one: str, other: str) -> Recognised:
        compared.append((one, other))
        return Recognised("same" if named[one] == named[other] else "different", "")

    monkeypatch.setattr(tracks, "read_shape", name_of)
    monkeypatch.setattr(tracks, "recognise", alike)
    drives = on("", tiny, tmp_path, "north", "south", "north_too") + on("hall", tiny, tmp_path, "a")
    result, _ = run(out, drives, find_tracks=True)
    assert len(compared) == 6
    assert [(track.name, track.joined) for track in result.tracks] == [
        ("track of north", ("north", "north_too"))
    ]
    assert run(out, drives, find_tracks=True)[1] == [] and len(compared) == 6
    # What a power cut tore is compared again.
    (out / "alike.json").write_text('{"a b": "sa')
    again, names = run(out, drives, find_tracks=True)
    assert len(names) == 3 and len(compared) == 12 and again.tracks == result.tracks
    drives += on("", tiny, tmp_path, "unnamed")
    result, names = run(out, drives, find_tracks=True)
    assert names == ["unnamed", "track of unnamed", "hall"] and len(compared) == 16
    assert {track.name: track.joined for track in result.tracks}["hall"] == ("a", "unnamed")


def test_a_comparison_in_another_version_is_none(tiny: Path, tmp_path: Path):
    Storage(str(tmp_path))
    with pytest.raises(LanenetError, match=r"the run needs lanenet 0\.1"):
        tracks.compare_maps(tracks.AlikeJob("a", ("b",), str(tmp_path), "lanenet 0.1"))
