"""``lanenet label-all``: which drives it takes, what it says, and its codes."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from drives import record, write_drive, write_tub
from fleet_work import HereEngine
from small_map import CAMERA
from typer.testing import CliRunner

from datagen.fleet import work
from datagen.fleet.local_engine import LocalEngine
from datagen.fleet.ray_engine import RayEngine
from datagen.fleet.result import CarFound, FleetResult, TrackFound
from datagen.fleet.source import checksum
from datagen.fleet.task import FleetDrive
from lanenet.cli.app import app
from lanenet.cli.label_all import (
    EngineName,
    Told,
    drives_of_library,
    engine_of,
    found_in,
    named,
    show_result,
)
from lanenet.data.library import Library
from lanenet.errors import ConfigError, TrackingLostError

TOLD = Told(40.0, None, 26.0, None, None)


def invoke(*words: object) -> Any:
    return CliRunner().invoke(app, ["label-all", *map(str, words)])


@pytest.fixture
def faults(monkeypatch: pytest.MonkeyPatch) -> None:
    """Work in this process; drives stand still or meet a fault of the program, by their names."""

    def fail(request: Any, *_: Any, **__: Any) -> Any:
        if "bug" in request.drive_path.name:
            raise ZeroDivisionError("by zero")
        raise TrackingLostError(f"{request.drive_path}: the car stands still")

    monkeypatch.setattr(work, "map_drive", fail)
    monkeypatch.setattr("datagen.fleet.local_engine.LocalEngine", lambda workers: HereEngine())


def test_refused_drives_are_an_answer(tmp_path: Path, faults: None):
    write_drive(tmp_path / "drives" / "a")
    write_drive(tmp_path / "drives" / "b", n=6)
    found = invoke(tmp_path / "drives", "--out", tmp_path / "out")
    assert found.exit_code == 0, found.output
    assert "0 drives with labels, 2 refused, 0 failed, 0 left; 2 done in this run" in found.output
    assert "a: the car stands still" in found.output
    log = (tmp_path / "out" / "label-all.log").read_text()
    assert "label-all: 0 done, 2 refused, 0 failed, 0 left: 2 of 2" in log
    again = invoke(tmp_path / "drives", "--out", tmp_path / "out")
    assert "; 0 done in this run" in again.output


def test_a_failed_drive_gives_code_1_and_its_reason(tmp_path: Path, faults: None):
    write_drive(tmp_path / "bug")
    found = invoke(tmp_path / "bug", "--out", tmp_path / "out")
    assert found.exit_code == 1
    assert re.search(
        r"error: 1 drive failed, the first: ZeroDivisionError: by zero; run .* again", found.output
    )


def test_a_folder_that_is_closed_fails_alone(tmp_path: Path, faults: None, monkeypatch: pytest.MonkeyPatch):
    for number, name in enumerate(("tub_10", "tub_2", "closed")):
        write_drive(tmp_path / "drives" / name, n=5 + number)
    closed, stat = tmp_path / "drives" / "closed", Path.stat

    def answer(path: Path, **options: bool) -> os.stat_result:
        if closed in path.parents:
            raise PermissionError(f"Permission denied: '{path}'")
        return stat(path, **options)

    # Instead of chmod, which does not keep out root.
    monkeypatch.setattr(Path, "stat", answer)
    monkeypatch.setattr(os, "access", lambda path, mode, **_: Path(path) != closed)
    # 2 comes before 10.
    assert [Path(each).name for each in found_in(str(closed.parent))] == ["closed", "tub_2", "tub_10"]
    monkeypatch.setattr("datagen.fleet.checksums.checksum", no_checksum(closed))
    monkeypatch.setattr("datagen.fleet.stage.checksum", no_checksum(closed))
    for width in ((), ("--lane-width", "40")):
        found = invoke(closed.parent, "--out", tmp_path / "out", *width)
        assert found.exit_code == 1 and "2 refused, 1 failed" in found.output, found.output


def no_checksum(closed: Path) -> Callable[[str], str]:
    def answer(source: str) -> str:
        if source == str(closed):
            raise PermissionError(f"Permission denied: '{source}'")
        return checksum(source)

    return answer


def test_without_a_lane_width_a_drive_that_cannot_be_read_fails_alone(tmp_path: Path, faults: None):
    write_drive(tmp_path / "drives" / "a")
    bad = write_drive(tmp_path / "drives" / "b", n=6)
    (bad / "drive.yaml").write_bytes("format: lanenet-drive/1\nnotes: Straße\n".encode("latin-1"))
    found = invoke(tmp_path / "drives", "--out", tmp_path / "out")
    assert found.exit_code == 0 and "2 refused, 0 failed" in found.output, found.output
    reasons = {
        each["name"]: each["reason"]
        for each in json.loads((tmp_path / "out" / "drives.json").read_text())["drives"]
    }
    assert reasons["a"] == "the car stands still" and "cannot be read as text" in reasons["b"]
    # One that can be read is to say its width, or the command.
    write_tub(tmp_path / "tub", [record(k) for k in range(5)])
    found = invoke(tmp_path / "drives", tmp_path / "tub", "--out", tmp_path / "out")
    assert found.exit_code == 1 and "tub: expected --lane-width" in found.output


def test_files_of_others_stay_also_behind_links(tmp_path: Path, faults: None):
    write_drive(tmp_path / "drives" / "a")
    out, album = tmp_path / "out", tmp_path / "album"
    for file in (out / "maps" / ("0" * 16) / "mine.txt", out / "index.html", album / "photo.jpg"):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("mine")
    (out / "labels").symlink_to(album)
    before = {path: path.lstat().st_mtime_ns for path in tmp_path.rglob("*")}
    found = invoke(tmp_path / "drives", "--out", out)
    assert (
        found.exit_code == 1 and "has maps, labels, index.html, which label-all did not make" in found.output
    )
    assert {path: path.lstat().st_mtime_ns for path in tmp_path.rglob("*")} == before
    # Beside them, and in a folder that is marked.
    (tmp_path / "new").mkdir()
    (tmp_path / "new" / "notes.txt").write_text("mine")
    for _ in range(2):
        assert invoke(tmp_path / "drives", "--out", tmp_path / "new", "--refused-again").exit_code == 0
        (tmp_path / "new" / "maps" / "photo.jpg").write_text("mine")
    assert (tmp_path / "new" / "notes.txt").exists() and (tmp_path / "new" / "maps" / "photo.jpg").exists()


def test_an_address_is_one_of_ray_and_without_it_processes_do_the_work():
    assert engine_of(None, None, 3) == engine_of(EngineName.local, None, 3) == LocalEngine(3)
    assert engine_of(EngineName.ray, None, 3) == RayEngine(None, 3)
    assert engine_of(None, "host:6379", None) == engine_of(EngineName.ray, "host:6379", None)
    assert engine_of(None, "host:6379", None) == RayEngine("host:6379", None)
    with pytest.raises(ConfigError, match="--address: expected --engine ray, found local"):
        engine_of(EngineName.local, "auto", None)


def test_no_drives_are_refused(tmp_path: Path):
    found = invoke("--out", tmp_path / "out")
    assert found.exit_code == 1 and "expected drives, or a --library" in found.output


def test_the_lane_width_is_the_libraries_then_the_drives_then_the_given_one(tmp_path: Path):
    drive = write_drive(tmp_path / "tub")  # which says 40 cm
    told = TOLD._replace(lane_width_cm=50.0)
    assert told.drive("tub", str(drive)).lane_width_cm == 40.0
    assert told.drive("tub", str(drive), 45.0).lane_width_cm == 45.0
    assert told.drive("tub", "s3://drives/tub").lane_width_cm == 50.0
    with pytest.raises(ConfigError, match="s3://drives/tub: expected --lane-width"):
        told._replace(lane_width_cm=None).drive("tub", "s3://drives/tub")


def test_drives_of_a_library(tmp_path: Path):
    library = Library.open(tmp_path / "drives.sqlite", create=True)
    camera = write_drive(tmp_path / "one") / "camera.yaml"
    write_drive(tmp_path / "two", n=7)
    library.add(tmp_path / "one", name="first", lane_width_cm=35.0, camera=str(camera))
    library.add(tmp_path / "two", camera="a name")
    write_drive(tmp_path / "three", n=8)
    library.add(tmp_path / "three", camera="wide", car="red", track="hall")
    # A car or a track of the command is that of the drives that it lists.
    assert drives_of_library(library.path, TOLD._replace(car="blue", track="yard")) == [
        FleetDrive("first", str(tmp_path / "one"), "", 35.0, str(camera), 26.0),
        FleetDrive(
            "three", str(tmp_path / "three"), "", 40.0, None, 26.0, car="red, camera wide", track="hall"
        ),
        FleetDrive("two", str(tmp_path / "two"), "", 40.0, None, 26.0),
    ]


def test_drives_that_are_listed_have_the_car_and_the_track_of_the_command(tmp_path: Path):
    drive = TOLD._replace(car="red", track="hall").drive("tub", str(write_drive(tmp_path / "tub")))
    assert (drive.car, drive.track) == ("red", "hall")


def test_cars_and_tracks_are_told(capsys: pytest.CaptureFixture[str]):
    own = {"c": "another camera than that of a: 9.0 px in the image"}
    car = CarFound("red", ("a", "b", "c"), "key", from_drives=("a", "b"), own=own, camera=CAMERA)
    track = TrackFound("hall", 3, "key", ("a", "b", "c"), ("a", "b"), {"c": "is of another track"}, 40.0)
    none = TrackFound("yard", 2, "key", ("x", "y"), reason="no two of 2 maps are joined")
    show_result(FleetResult((), cars=(car,), tracks=(track, none)), "out")
    said = "".join(capsys.readouterr())
    assert "camera of red: found from a, b" in said and "c keeps its own camera: another camera" in said
    assert "hall: 2 of 3 maps joined" in said and "c is of another track" in said
    assert "wrote out/index.html" in said
    assert "yard: 0 of 2 maps joined" in said and "no two of 2 maps are joined" in said


def test_names_are_unique():
    others = [FleetDrive("tub", "/library/tub", "", 40.0)]
    sources = ["/a/tub", "/b/tub", "/a/tub", "/library/tub", "s3://drives/tub.mp4", "/c/my tub"]
    assert named(sources, others) == {
        "tub_2": "/a/tub",
        "tub_3": "/b/tub",
        "tub_4": "s3://drives/tub.mp4",
        "my-tub": "/c/my tub",
    }


def test_a_url_is_one_drive_and_a_folder_holds_several(tmp_path: Path):
    for name in ("a", "b"):
        write_drive(tmp_path / name)
    assert found_in(str(tmp_path)) == [str(tmp_path / "a"), str(tmp_path / "b")]
    assert found_in("s3://drives/tub") == ["s3://drives/tub"]
