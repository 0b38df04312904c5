"""Another lane width for a finished map: the same as mapping anew, without mapping."""

from __future__ import annotations

import json
import math
import shlex
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from small_map import small_map
from typer.testing import CliRunner

from datagen import pipeline
from datagen.assemble import AssembledMap, scaled_figures
from datagen.lanes.scale import LaneWidth
from datagen.pipeline import MapRequest, map_drive
from datagen.settings import MapSettings
from datagen.world.simulate import simulate_drive
from datagen.world.world import SimulationSettings
from lanenet.cli import app as cli
from lanenet.data.maps.folder import read_map
from lanenet.data.tables import ParquetTable
from lanenet.errors import LanenetError

SETTINGS = MapSettings(find_bumper=False)
#: Of numbers that were rounded to nine digits in between.
SAME = 1e-6


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated drive that does not name its camera."""
    camera = {"width": 160, "height": 120, "field_of_view_rad": math.radians(120.0), "height_cm": 17.0}
    track = {"left": {}, "right": {}, "interruptions_per_m": 0.0}
    settings = {"seed": 1, "frames": 70, "camera": camera, "track": track}
    out = tmp_path_factory.mktemp("drives") / "drive"
    simulate_drive(SimulationSettings.model_validate(settings), out)
    about = out / "drive.yaml"
    lines = about.read_text().splitlines(keepends=True)
    about.write_text("".join(line for line in lines if not line.startswith("camera")))
    return out


@pytest.fixture(scope="module")
def finished(drive: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its map, for a lane of 40 cm."""
    out = tmp_path_factory.mktemp("maps") / "map"
    map_drive(MapRequest(drive, 40.0), SETTINGS, out, pictures=False)
    return out


@pytest.fixture
def map_40(finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the map; mapping fails."""

    def fail(*_: object) -> Any:
        raise ZeroDivisionError("mapped again")

    monkeypatch.setattr(pipeline, "_solve", fail)
    return Path(shutil.copytree(finished, tmp_path / "map"))


def assert_same(a: Any, b: Any, where: str = "") -> None:
    """Compare figures, number by number."""
    if isinstance(a, dict):
        assert a.keys() == b.keys(), where
        for name in a:
            assert_same(a[name], b[name], f"{where}/{name}")
    elif isinstance(a, list):
        assert len(a) == len(b), where
        for k, (one, other) in enumerate(zip(a, b, strict=True)):
            assert_same(one, other, f"{where}[{k}]")
    elif isinstance(a, float):
        # Percentiles of residuals step from one sample to the next.
        assert a == pytest.approx(b, rel=1e-4, abs=SAME), where
    else:
        assert a == b, where


@pytest.mark.slow
def test_a_rescaled_map_is_the_map_of_the_other_width(drive: Path, tmp_path: Path):
    for out, width_cm in (("rescaled", 40.0), ("anew", 41.0), ("rescaled", 41.0)):
        report = map_drive(MapRequest(drive, width_cm), SETTINGS, tmp_path / out)
    said = "the finished map of a lane of 40 cm was rescaled to 41 cm (all lengths x 1.025) and judged anew"
    assert said in report.lines[1]
    one, other = (tmp_path / name for name in ("rescaled", "anew"))
    assert {file.name for file in one.iterdir()} == {file.name for file in other.iterdir()}
    reports = [json.loads((folder / "report.json").read_text()) for folder in (one, other)]
    assert reports[0].pop("rescaled") == reports[0]["notes"].pop(0) and not reports[1].pop("rescaled")
    assert_same(*reports)
    maps = [read_map(folder) for folder in (one, other)]
    for name in ("poses", "s_cm", "match", "tilt_rad", "lap", "segment", "held_out", "errors"):
        np.testing.assert_allclose(getattr(maps[0], name), getattr(maps[1], name), SAME, SAME)
    assert_same(*(each.meta.model_dump() for each in maps))
    assert_same(*(vars(each.camera.mounting) for each in maps))
    assert maps[0].marks == maps[1].marks and maps[0].camera.wheelbase_cm == maps[1].camera.wheelbase_cm
    for a, b in zip(*(each.lines[0] for each in maps), strict=True):
        for name in ("knots_cm", "coefficients_cm", "supported_cm", "sigma_at_cm", "marking_at_cm"):
            np.testing.assert_allclose(getattr(a, name), getattr(b, name), SAME, SAME)
    tables = [ParquetTable(folder / "edges.parquet") for folder in (one, other)]
    for name in ("x_cm", "y_cm", "normal_x", "normal_y"):
        np.testing.assert_allclose(tables[0].floats(name), tables[1].floats(name), 1e-5, 1e-4)
    for name in ("trajectory.tum", "open_loop.tum"):
        np.testing.assert_allclose(np.loadtxt(one / name), np.loadtxt(other / name), SAME, SAME)
    pictures = [cv2.imread(str(folder / "map.png")) for folder in (one, other)]
    # Lengths that differ in the last digit may round to the next pixel.
    assert (pictures[0] != pictures[1]).mean() < 1e-6
    for name in ("settings.yaml", "map.done.json"):
        assert (one / name).read_text() == (other / name).read_text()


def test_a_finished_map_is_rescaled_and_back(drive: Path, map_40: Path):
    before = read_map(map_40)
    for width_cm in (44.0, 41.0, 40.0):
        report = map_drive(MapRequest(drive, width_cm), SETTINGS, map_40, pictures=False)
        after, factor = read_map(map_40), width_cm / 40.0
        np.testing.assert_allclose(after.poses[:, :2], factor * before.poses[:, :2], 1e-7, 1e-5)
        np.testing.assert_allclose(after.poses[:, 2], before.poses[:, 2])
        assert after.meta.lane_width_cm == width_cm and after.meta.mapped_lane_cm == pytest.approx(width_cm)
        # From the rear axle; the axles are as far apart as they are.
        assert after.camera.wheelbase_cm == before.camera.wheelbase_cm
        arms_cm = [c.wheelbase_cm + c.mounting.ahead_of_front_axle_cm for c in (before.camera, after.camera)]
        assert arms_cm[1] == pytest.approx(factor * arms_cm[0])
        assert after.camera.mounting.height_cm == pytest.approx(factor * before.camera.mounting.height_cm)
    assert sum("was rescaled" in line for line in report.lines) == 1


def test_what_is_judged_in_centimetres_is_judged_anew(drive: Path, map_40: Path):
    """Three times as wide, the camera is half a metre high, which cannot be."""
    before = json.loads((map_40 / "report.json").read_text())
    report = map_drive(MapRequest(drive, 120.0), SETTINGS, map_40, pictures=False)
    found = " ".join(report.figures["verdict"]["reasons"])
    assert "(height_cm)" in found and "(height_cm)" not in str(before["verdict"]["reasons"])
    few, many = (one["labels"]["labelled"] / one["labels"]["frames"] for one in (report.figures, before))
    assert few < 0.8 < 0.9 < many


@pytest.mark.parametrize(
    "other",
    [
        {"lane_width_cm": 41.0, "wheelbase_cm": 26.0},
        {"lane_width_cm": 41.0, "frames": (0, 65)},
        # With the camera's height the lane's width gives the focal length, too.
        {"lane_width_cm": 41.0, "camera_height_cm": 17.0},
        {"lane_width_cm": 40.0},
    ],
)
def test_what_differs_in_more_is_mapped_anew(drive: Path, map_40: Path, other: dict[str, Any]):
    before = (map_40 / "poses.csv").read_bytes()
    with pytest.raises(ZeroDivisionError, match="mapped again"):
        map_drive(replace(MapRequest(drive, 40.0), **other), SETTINGS, map_40)
    assert (map_40 / "poses.csv").read_bytes() == before


@pytest.mark.parametrize("name", ["edges.parquet", "report.json", "open_loop.tum", "poses.csv"])
def test_a_damaged_map_is_made_anew(drive: Path, map_40: Path, name: str):
    (map_40 / name).write_bytes(b"torn")
    with pytest.raises(ZeroDivisionError, match="mapped again"):
        map_drive(MapRequest(drive, 41.0), SETTINGS, map_40)


def test_a_drive_that_changed_is_mapped_anew(drive: Path, map_40: Path, tmp_path: Path):
    copy = tmp_path / "copy"
    shutil.copytree(drive, copy)
    with pytest.raises(ZeroDivisionError, match="mapped again"):
        map_drive(MapRequest(copy, 41.0), SETTINGS, map_40)


def test_nothing_is_overwritten_before_the_new_map_stands(
    drive: Path, map_40: Path, monkeypatch: pytest.MonkeyPatch
):
    before = {file.name: file.read_bytes() for file in map_40.iterdir()}

    def fail(*_: object) -> None:
        raise LanenetError("the disk is full")

    monkeypatch.setattr(pipeline, "write_checked", fail)
    with pytest.raises(LanenetError, match="disk is full"):
        map_drive(MapRequest(drive, 41.0), SETTINGS, map_40)
    assert {file.name: file.read_bytes() for file in map_40.iterdir()} == before


def test_a_map_elsewhere_may_be_rescaled_into_a_new_folder(drive: Path, map_40: Path, tmp_path: Path):
    """As a training does with one that lanenet map made."""
    before = (map_40 / "map.yaml").read_bytes()
    out = tmp_path / "new"
    map_drive(MapRequest(drive, 41.0), SETTINGS, out, pictures=False, earlier=[tmp_path / "none", map_40])
    assert read_map(out).meta.lane_width_cm == 41.0 and (map_40 / "map.yaml").read_bytes() == before


def test_every_length_of_a_map_is_scaled():
    """Also those that a later version adds: what is not listed here has to be scaled or named."""
    drive_map = small_map()
    n = len(drive_map.frames)
    edges = {name: np.ones(n, np.float32) for name in ("x_cm", "y_cm", "normal_x", "normal_y")}
    edges |= {"frame": drive_map.frames, "segment": drive_map.segment}
    figures = {"path_cm": 3.0, "closure_across_cm": None, "steering": {"trim_per_cm": 5.0}}
    assembled = AssembledMap(
        drive_map, np.arange(n), LaneWidth(36.4, 38.0, (30.0, 40.0)), edges, drive_map.poses, [figures], 35.0
    )
    twice = assembled.scaled(2.0, {})
    same_meta = {"format", "drive", "scale_from", "laps", "markings", "verdict", "state", "ahead_sigma_cm",
                 "options"}  # fmt: skip
    for name, value in drive_map.meta.model_dump().items():
        assert getattr(twice.drive_map.meta, name) == (value if name in same_meta else 2.0 * value), name
    assert twice.lane == LaneWidth(72.8, 76.0, (60.0, 80.0)) and twice.free_lane_cm == 70.0
    np.testing.assert_array_equal(twice.open_poses[:, :2], 2.0 * drive_map.poses[:, :2])
    assert twice.edges["x_cm"][0] == 2.0 and twice.edges["normal_x"][0] == 1.0
    assert twice.segments == [figures | {"path_cm": 6.0}] == scaled_figures([figures], 2.0)
    camera = twice.drive_map.camera
    assert (camera.mounting.height_cm, camera.wheelbase_cm) == (30.0, 17.0)
    assert camera.mounting.ahead_of_front_axle_cm == 2.0 * (17.0 - 3.5) - 17.0
    same = {"frames", "t_s", "lap", "segment", "match", "tilt_rad", "held_out", "errors", "marks"}
    for name, value in vars(drive_map).items():
        if name in same:
            np.testing.assert_array_equal(getattr(twice.drive_map, name), value)
    assert {*vars(drive_map)} == same | {"meta", "camera", "poses", "s_cm", "lines"}


def test_each_frame_has_its_near_points():
    """The frames of the first segment come first; a frame without points has an empty cloud."""
    drive_map = small_map()
    frame = np.repeat(drive_map.frames[[0, 2]], 2)
    front = drive_map.poses[[0, 0, 2, 2], :2]
    away_cm = np.array([0.0, 1000.0, 1.0, 2.0])
    edges = {"frame": frame, "segment": np.zeros(4, int), "x_cm": front[:, 0] + away_cm, "y_cm": front[:, 1]}
    one = AssembledMap(drive_map, np.arange(30), LaneWidth(36.0), edges, drive_map.poses, [])
    assert [len(points) for points in one.near_points[:4]] == [1, 0, 2, 0]


def test_the_command_of_another_width_asks_for_the_same_map(drive: Path, tmp_path: Path):
    request = MapRequest(drive, 40.0, wheelbase_cm=26.0, tape_width_cm=2.0, frames=(0, 65))
    map_drive(request, MapSettings(), tmp_path / "map", pictures=False)
    said = read_map(tmp_path / "map").meta.width_command(tmp_path / "map", 41.0)
    assert said.startswith("rescale it, which takes seconds: lanenet map ")
    result = CliRunner().invoke(cli.app, shlex.split(said.partition(": ")[2])[1:])
    assert "was rescaled to 41 cm" in result.output.replace("\n", " ")
    assert read_map(tmp_path / "map").camera.wheelbase_cm == 26.0


@pytest.mark.parametrize(
    "changes", [{"scale_from": "camera"}, {"options": ("--camera-height", "17")}, {"options": None}]
)
def test_a_map_that_cannot_be_rescaled_is_not_said_to_take_seconds(map_40: Path, changes: dict[str, Any]):
    meta = read_map(map_40).meta.model_copy(update=changes)
    assert "seconds" not in meta.width_command(map_40, 41.0)
    assert "--lane-width 41" in meta.width_command(map_40, 41.0)
