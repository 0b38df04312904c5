"""Inside or outside the synthetic spread, the nearest drives, files and pictures; the verb."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from datagen.reality.drives import RealitySettings, drawn_simulation, measure_all_synthetic
from datagen.reality.measure import STATISTICS, MeasuredDrive, at_nominal_height
from datagen.reality.report import compare, histograms, nearest_synthetic, sheet, summary, table, write_report
from datagen.world.car.camera import CameraSettings
from datagen.world.simulate import simulate_drive
from datagen.world.world import SimulationSettings, assemble_world
from lanenet.cli.app import app

CAMERA = at_nominal_height(CameraSettings(width=64, height=48).build(26.0))
SMALL = RealitySettings(
    count=3,
    frames=3,
    every=2,
    simulation=SimulationSettings(look={"wall_level": 20.0}),
)


def _drive(name: str, value: float, **changes: float) -> MeasuredDrive:
    statistics = dict.fromkeys(STATISTICS, value) | changes
    return MeasuredDrive(name, statistics, np.full((48, 64, 3), 90, np.uint8), CAMERA, None)


SYNTHETIC = [_drive(f"s{k}", float(k)) for k in range(101)]


def test_a_drive_is_inside_between_the_quantiles():
    real = [_drive("in", 50.0, points=2.5, grain=97.5), _drive("out", 50.0, points=2.4, grain=float("nan"))]
    rows = {row.name: row for row in compare(real, SYNTHETIC)}
    assert list(rows) == list(STATISTICS)
    points = rows["points"]
    assert (points.low, points.median, points.high) == (2.5, 50.0, 97.5)
    assert points.inside == (True, False) and rows["grain"].inside == (True, False)
    assert points.below == (pytest.approx(3 / 101), pytest.approx(3 / 101))
    lines = {line[0]: line[1:] for line in table(list(rows.values()), ["in", "out"])}
    assert lines["points"] == ["2.50", "50.0", "97.5", "2.50", "2.40 out"]
    assert lines["grain"][-1] == "- out"
    told = summary(list(rows.values()), ["in", "out"])
    assert told[0] == f"in: {len(STATISTICS)} of {len(STATISTICS)} statistics inside"
    assert told[1].endswith("outside: points, grain")


def test_synthetic_drives_without_a_value_are_left_out():
    row = compare([_drive("r", 1.0)], [*SYNTHETIC, _drive("nothing", float("nan"))])[0]
    assert (row.low, row.high) == (2.5, 97.5)
    none = compare([_drive("r", 1.0)], [_drive("nothing", float("nan"))])[0]
    assert none.inside == (False,)


def test_the_nearest_drives_come_first():
    assert [d.name for d in nearest_synthetic(_drive("r", 40.2), SYNTHETIC, 3)] == ["s40", "s41", "s39"]


def test_files_and_pictures(tmp_path: Path):
    real = [_drive("tub", 30.0), _drive("other", 70.0)]
    paths = write_report(tmp_path, {"seed": 1}, real, SYNTHETIC)
    data = json.loads(paths[1].read_text())
    assert data["format"] == "lanenet-reality/1" and data["settings"] == {"seed": 1}
    assert data["statistics"][0]["inside"] == {"tub": True, "other": True}
    assert len(data["drives"]) == 103
    assert "| points | 2.50 | 50.0 | 97.5 | 30.0 | 70.0 |" in paths[0].read_text()
    picture = sheet(real, SYNTHETIC, RealitySettings(), beside=2)
    assert picture.shape[1] == 3 * 246 and (picture == 90).any()
    png = histograms(compare(real, SYNTHETIC), real, SYNTHETIC)
    assert png is not None and cv2.imdecode(np.frombuffer(png, np.uint8), 1) is not None


def test_the_number_of_a_drive_decides_it():
    cameras = [CAMERA, at_nominal_height(CameraSettings(width=80, height=60).build(26.0))]
    more = SMALL.model_copy(update={"count": 9})
    a, b = drawn_simulation(SMALL, cameras, 1), drawn_simulation(more, cameras, 1)
    assert a == b and a.frames == 5
    assert (a.camera.width, drawn_simulation(SMALL, cameras, 2).camera.width) == (80, 64)
    assert a.seed != drawn_simulation(SMALL, cameras, 3).seed
    fixed = RealitySettings(vary_camera=False, vary_road=False, vary_driver=False)
    plain = drawn_simulation(fixed, cameras, 0)
    assert (plain.camera, plain.track, plain.driver) == (
        fixed.simulation.camera,
        fixed.simulation.track,
        fixed.simulation.driver,
    )


def test_drives_are_the_same_by_any_number_of_processes():
    calls: list[tuple[int, int]] = []
    settings = SMALL.model_copy(update={"count": 2})
    one = measure_all_synthetic(settings, [CAMERA], 1, lambda *done: calls.append(done))
    two = measure_all_synthetic(settings, [CAMERA], 2)
    assert calls == [(1, 2), (2, 2)]
    for a, b in zip(one, two, strict=True):
        np.testing.assert_equal(a.statistics, b.statistics)
        np.testing.assert_array_equal(a.shown, b.shown)
        assert a.shown.shape == (48, 64, 3)


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("drives")
    common = SimulationSettings(frames=5, camera=CameraSettings(width=64, height=48))
    return [simulate_drive(common.model_copy(update={"seed": k}), folder / f"d{k}") for k in (1, 2)]


def test_the_verb_compares_given_drives(drives: list[Path], tmp_path: Path):
    out = tmp_path / "out"
    words = ["reality", str(drives[0]), "--synthetic", str(drives[1]), "--out", str(out)]
    result = CliRunner().invoke(app, words, env={"COLUMNS": "160"})
    assert result.exit_code == 0, result.output
    assert "d1:" in result.stdout and "next: lanenet" in result.stdout
    files = {path.name for path in out.iterdir()}
    assert files == {"reality.md", "reality.json", "histograms.png", "sheet.png"}
    data = json.loads((out / "reality.json").read_text())
    assert [drive["kind"] for drive in data["drives"]] == ["real", "synthetic"]
    assert data["settings"]["drives"] == [str(drives[1])]
    # A drive lies within the spread of itself alone.
    words[3] = str(drives[0])
    again = CliRunner().invoke(app, words, env={"COLUMNS": "160"})
    data = json.loads((out / "reality.json").read_text())
    rows = [row for row in data["statistics"] if row["real"]["d1"] is not None]
    assert again.exit_code == 0 and len(rows) > 10 and all(row["inside"]["d1"] for row in rows)


def test_the_verb_draws_drives_by_a_config(drives: list[Path], tmp_path: Path):
    config = tmp_path / "reality.yaml"
    config.write_text("count: 9\nevery: 2\nsimulation: {look: {wall_level: 20}}\n")
    out = tmp_path / "out"
    words = ["reality", str(drives[0]), "--synthetic", str(config), "--count", "1", "--frames", "2"]
    words += ["--camera", f"d1={drives[1] / 'camera.yaml'}", "--workers", "1", "--out", str(out)]
    result = CliRunner().invoke(app, words, env={"COLUMNS": "160"})
    assert result.exit_code == 0, result.output
    data = json.loads((out / "reality.json").read_text())
    assert data["settings"]["count"] == 1 and data["settings"]["every"] == 2
    assert len(data["drives"]) == 2


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["{video}"], "no such drive"),
        (["{bare}"], "--camera bare=camera.yaml"),
        (["{d1}", "--camera", "other=x.yaml"], "no such drive, expected one of d1"),
        (["{d1}", "--camera", "a.yaml", "--camera", "b.yaml"], "a camera was given for all drives before"),
        (["{d1}", "--camera", "{big}"], "images of 64x48 px, but"),
        (["{d1}", "--synthetic", "a.yaml", "--synthetic", "{d1}"], "stands alone"),
        (["{d1}", "--synthetic", "{wrong}"], "unknown key 'cuont', did you mean 'count'"),
    ],
)
def test_the_verb_refuses_what_it_cannot_use(
    drives: list[Path], tmp_path: Path, words: list[str], message: str
):
    from lanenet.data.camera_file import write_camera

    bare = tmp_path / "bare"
    (bare / "images").mkdir(parents=True)
    (bare / "frames.csv").write_text("frame,file,t_s\n0,images/0.png,0.0\n")
    cv2.imwrite(str(bare / "images" / "0.png"), np.zeros((48, 64, 3), np.uint8))
    write_camera(tmp_path / "big.yaml", CameraSettings().build(26.0), "test")
    (tmp_path / "wrong.yaml").write_text("cuont: 3\n")
    places = {
        "video": tmp_path / "none.mp4",
        "bare": bare,
        "d1": drives[0],
        "big": tmp_path / "big.yaml",
        "wrong": tmp_path / "wrong.yaml",
    }
    filled = [word.format(**places) for word in words]
    out = tmp_path / "out"
    result = CliRunner().invoke(app, ["reality", *filled, "--count", "1", "--out", str(out)])
    assert result.exit_code == 1
    assert message in " ".join(result.stderr.split())
    assert not out.exists()


def test_a_drawn_drive_is_one_that_can_be_built():
    for number in range(6):
        settings = drawn_simulation(SMALL, [CAMERA], number)
        length_cm = settings.track.length_cm or 900.0
        road = settings.track.model_copy(update={"length_cm": length_cm})
        world = assemble_world(settings.model_copy(update={"track": road}))
        assert world.camera.width == 64 and world.track.length_cm >= 899.0
