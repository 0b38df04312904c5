"""Drives of one car get one camera where theirs agree; only what that touches is done again."""

from __future__ import annotations

import json
import shutil
import uuid
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import fsspec
import pytest
from fleet_runs import copy_of, drives_of, run

from datagen.fleet import cars, work
from datagen.fleet.task import FleetDrive
from datagen.tracks.car import CarCamera
from lanenet.data.camera_file import read_camera, write_camera

#: What each drive's camera says of its pitch, beside the others', and how well it knows its focal length.
PITCHES = {"knocked": 0.1, "open_knocked": 0.1, "b": 0.001, "c": 0.002}
SIGMAS = {"sharp": 0.005, "vague": 0.04}


@pytest.fixture
def by_car(monkeypatch: pytest.MonkeyPatch, mapping: list[str]) -> list[str]:
    """Mapping finds a camera unless one is given; that of a car is the first one's. Notes what is done."""
    plain: Callable[..., Any] = work.map_drive

    def find(request: Any, settings: Any, out: Path, **more: Any) -> Any:
        report = plain(request, settings, out, **more)
        camera, name = read_camera(out / "camera.yaml"), request.drive_path.name
        if request.camera_path is not None:
            camera = read_camera(request.camera_path)
            if "worse" in name:
                figures = json.loads((out / "report.json").read_text())
                figures["verdict"] |= {"grade": "usable"}
                (out / "report.json").write_text(json.dumps(figures))
        elif "given" not in name:
            pitch = camera.mounting.pitch_down_rad + PITCHES.get(name, 0.0)
            camera = camera.with_mounting(pitch_down_rad=pitch)
            figures = json.loads((out / "report.json").read_text())
            sigma = {"focal": SIGMAS.get(name, 0.01), "pitch": 0.01}
            figures["calibration"] = {"sigma": sigma, "closed": "open" not in name}
            (out / "report.json").write_text(json.dumps(figures))
        (out / "camera.yaml").unlink()
        write_camera(out / "camera.yaml", camera, "in a test")
        return report

    def together(visits: Any, rng: Any) -> CarCamera:
        camera = visits[0].camera.with_mounting(yaw_rad=0.01 * len(visits))
        return CarCamera(camera, {"focal": 0.004}, (17.0,) * len(visits))

    monkeypatch.setattr(work, "map_drive", find)
    monkeypatch.setattr(cars, "camera_of_car", together)
    return mapping


def red(tiny: Path, folder: Path, *names: str) -> list[FleetDrive]:
    paths = [folder / name if (folder / name).exists() else copy_of(tiny, folder / name) for name in names]
    return [replace(drive, car="red") for drive in drives_of(*paths)]


def test_drives_of_a_car_get_the_camera_that_is_found_from_them_together(
    tiny: Path, tmp_path: Path, by_car: list[str]
):
    drives = red(tiny, tmp_path / "drives", "a", "b", "c")
    other = drives_of(copy_of(tiny, tmp_path / "other"))
    result, names = run(tmp_path / "out", drives + other)
    assert names == ["a", "b", "c", "camera of red", "a", "b", "c", "other"]
    (car,) = result.cars
    assert car.name == "red" and set(car.from_drives) == {"a", "b", "c"} and not car.own and car.camera
    assert car.camera.mounting.yaw_rad == pytest.approx(0.03)
    for found in result.drives[:3]:
        kept = tmp_path / "out" / "maps" / found.map_key / "camera.yaml"
        assert read_camera(kept).hash == car.camera.hash and found.verdict == "good"
    assert result.drives[3].drive.camera is None
    index = json.loads((tmp_path / "out" / "drives.json").read_text())["drives"]
    assert [drive["car"] for drive in index] == ["red"] * 3 + [""]
    page = (tmp_path / "out" / "index.html").read_text()
    assert "Cars" in page and "found from" in page
    # Nothing is left to do, and no drive is there with labels of its own camera.
    again, names = run(tmp_path / "out", drives + other)
    assert names == [] and not any(drive.new for drive in again.drives)
    assert again.cars[0].key == car.key and again.cars[0].camera
    assert again.cars[0].camera.hash == car.camera.hash
    assert len(list((tmp_path / "out" / "labels").iterdir())) == 4


def test_a_new_drive_of_a_car_redoes_the_others_only_if_it_knows_the_camera_better(
    tiny: Path, tmp_path: Path, by_car: list[str]
):
    four = red(tiny, tmp_path / "drives", "a", "b", "c", "d")
    run(tmp_path / "out", four)
    five = [*four, *red(tiny, tmp_path / "drives", "vague")]
    result, names = run(tmp_path / "out", five)
    assert names == ["vague", "vague"] and [drive.new for drive in result.drives] == [False] * 4 + [True]
    six = [*five, *red(tiny, tmp_path / "drives", "sharp")]
    result, names = run(tmp_path / "out", six)
    assert names[:2] == ["sharp", "camera of red"] and "sharp" in result.cars[0].from_drives
    # The camera of a test is that of the first map, which may be the same.
    assert "sharp" in names[2:] and len(result.cars[0].from_drives) == 4


def test_a_drive_whose_camera_was_moved_keeps_its_own_and_is_named(
    tiny: Path, tmp_path: Path, by_car: list[str]
):
    result, names = run(tmp_path / "out", red(tiny, tmp_path / "drives", "a", "knocked", "c"))
    assert names == ["a", "knocked", "c", "camera of red", "a", "knocked", "c"]
    (car,) = result.cars
    assert set(car.from_drives) == {"a", "c"} and list(car.own) == ["knocked"]
    assert "another camera than that of" in car.own["knocked"] and "most in pitch" in car.own["knocked"]
    assert [drive.drive.camera is None for drive in result.drives] == [False, True, False]
    assert [drive.verdict for drive in result.drives] == ["good"] * 3
    assert "Knocked of red keeps its own camera" in (tmp_path / "out" / "index.html").read_text()


def test_a_worse_map_with_the_cars_camera_is_not_used(tiny: Path, tmp_path: Path, by_car: list[str]):
    drives = red(tiny, tmp_path / "drives", "a", "worse", "c")
    result, names = run(tmp_path / "out", drives)
    assert names == ["a", "worse", "c", "camera of red", "a", "worse", "c", "worse"]
    assert result.drives[1].verdict == "good" and result.drives[1].drive.camera is None
    assert "with the car's camera its map is usable, with its own good" in result.cars[0].own["worse"]
    assert run(tmp_path / "out", drives)[1] == []


def test_a_given_camera_stays_and_an_open_drive_gets_the_cars(tiny: Path, tmp_path: Path, by_car: list[str]):
    drives = red(tiny, tmp_path / "drives", "a", "b", "given", "open")
    result, _ = run(tmp_path / "out", drives)
    assert set(result.cars[0].from_drives) == {"a", "b"}
    assert result.cars[0].own == {"given": "has a camera of its own"}
    assert [drive.drive.camera is None for drive in result.drives] == [False, False, True, False]


def test_an_open_drive_whose_camera_was_moved_keeps_its_own(tiny: Path, tmp_path: Path, by_car: list[str]):
    result, _ = run(tmp_path / "out", red(tiny, tmp_path / "drives", "a", "b", "open_knocked"))
    assert "another camera than that of" in result.cars[0].own["open_knocked"]
    assert [drive.drive.camera is None for drive in result.drives] == [False, False, True]


def test_a_given_camera_of_a_map_that_is_rejected_stays(tiny: Path, tmp_path: Path, by_car: list[str]):
    result, _ = run(tmp_path / "out", red(tiny, tmp_path / "drives", "a", "b", "given_reject"))
    assert result.cars[0].own == {"given_reject": "has a camera of its own"}
    assert result.drives[2].drive.camera is None and result.drives[2].verdict == "reject"


@pytest.mark.parametrize("name", ["knocked", "worse"])
def test_a_recording_that_is_listed_twice_is_labelled_once(
    tiny: Path, tmp_path: Path, by_car: list[str], name: str
):
    drives = red(tiny, tmp_path / "drives", "a", name, "c")
    shutil.copytree(tmp_path / "drives" / name, tmp_path / "drives" / "again")
    drives += [replace(drive, car="red") for drive in drives_of(tmp_path / "drives" / "again")]
    result, names = run(tmp_path / "out", drives)
    assert [drive.verdict for drive in result.drives] == ["good"] * 3 + ["duplicate"]
    assert "again" not in names and result.drives[3].map_key == result.drives[1].map_key


def test_a_map_whose_camera_file_is_gone_is_named(tiny: Path, tmp_path: Path, by_car: list[str]):
    drives = red(tiny, tmp_path / "drives", "a", "b", "c")
    alone, _ = run(tmp_path / "out", drives, each_alone=True)
    (tmp_path / "out" / "maps" / alone.drives[2].map_key / "camera.yaml").unlink()
    result, _ = run(tmp_path / "out", drives)
    assert "cannot be read" in result.cars[0].own["c"] and set(result.cars[0].from_drives) == {"a", "b"}


def test_a_camera_in_an_object_store_is_used_from_there(tiny: Path, by_car: list[str]):
    url, memory = f"memory://{uuid.uuid4().hex}", fsspec.filesystem("memory")
    for name in ("a", "b"):
        memory.put(str(tiny), f"{url}/drives/{name}", recursive=True)
        memory.pipe_file(f"{url}/drives/{name}/note.txt", name.encode())
    drives = [replace(drive, car="red") for drive in drives_of(f"{url}/drives/a", f"{url}/drives/b")]
    result, names = run(f"{url}/out", drives)
    assert names == ["a", "b", "camera of red", "a", "b"]
    camera = result.cars[0].camera
    assert camera is not None and result.cars[0].own == {}
    for found in result.drives:
        kept = memory.cat_file(f"{url}/out/maps/{found.map_key}/camera.yaml").decode()
        assert f"yaw_rad: {camera.mounting.yaw_rad}" in kept and found.verdict == "good"
    assert run(f"{url}/out", drives)[1] == []
    memory.rm(url, recursive=True)


def test_without_two_drives_that_agree_there_is_no_camera_for_all(
    tiny: Path, tmp_path: Path, by_car: list[str]
):
    drives = red(tiny, tmp_path / "drives", "a", "knocked")
    result, names = run(tmp_path / "out", drives)
    assert names == ["a", "knocked"] * 2  # mapped, then labelled
    assert "expected two drives" in result.cars[0].reason and result.cars[0].camera is None
    assert [drive.drive.camera for drive in result.drives] == [None, None]
    # Asked for nothing, nothing is compared.
    result, names = run(tmp_path / "out", drives, each_alone=True)
    assert names == [] and result.cars == ()


def test_what_fails_while_a_camera_is_found_leaves_the_drives_their_own(
    tiny: Path, tmp_path: Path, by_car: list[str], monkeypatch: pytest.MonkeyPatch
):
    def fail(visits: Any, rng: Any) -> CarCamera:
        raise ZeroDivisionError("by zero")

    with monkeypatch.context() as patch:
        patch.setattr(cars, "camera_of_car", fail)
        result, _ = run(tmp_path / "out", red(tiny, tmp_path / "drives", "a", "b"))
    assert result.cars[0].reason == "ZeroDivisionError: by zero"
    assert [drive.verdict for drive in result.drives] == ["good", "good"]
    # It is tried again.
    result, names = run(tmp_path / "out", red(tiny, tmp_path / "drives", "a", "b"))
    assert names == ["camera of red", "a", "b"] and result.cars[0].camera is not None
