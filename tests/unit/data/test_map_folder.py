"""Map folders: what is written is read back, and damage is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_map import N, small_map

from datagen.lanes.offset import CubicBasis
from lanenet.data.files import require
from lanenet.data.maps.folder import FORMAT, DriveMap, read_map, write_map
from lanenet.data.maps.line import LaneLine, Side
from lanenet.errors import LanenetError, MapFormatError


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    edges = {"frame": np.arange(5), "x_cm": np.linspace(0.0, 1.0, 5).astype(np.float32)}
    report = {"frames": N, "figures": np.array([1.0, np.nan])}
    write_map(tmp_path, small_map(), edges, report, "from the drive")
    return tmp_path


def test_round_trip(folder):
    written, found = small_map(), read_map(folder)
    assert found.meta.model_copy(update={"drive": ""}) == written.meta.model_copy(update={"drive": ""})
    assert found.camera.hash == written.camera.hash
    assert found.camera.wheelbase_cm == written.camera.wheelbase_cm
    for name in ("frames", "lap", "segment"):
        np.testing.assert_array_equal(getattr(found, name), getattr(written, name))
    # Nine digits on paper.
    np.testing.assert_array_equal(found.held_out, written.held_out)
    np.testing.assert_array_equal(found.errors, written.errors)
    for name in ("t_s", "poses", "s_cm", "match", "tilt_rad"):
        np.testing.assert_allclose(getattr(found, name), getattr(written, name), rtol=1e-7)
    assert found.lines.keys() == written.lines.keys()
    s = np.linspace(-10.0, 210.0, 45)
    for segment, pair in written.lines.items():
        assert [line.side for line in found.lines[segment]] == ["left", "right"]
        for line, again in zip(pair, found.lines[segment], strict=True):
            np.testing.assert_allclose(again.points(s), line.points(s), atol=1e-9)
            np.testing.assert_allclose(again.residual_cm, line.residual_cm)


def test_the_camera_nods_with_the_frame(folder):
    found = read_map(folder)
    for name, change in zip(("pitch_down_rad", "roll_rad"), found.tilt_rad[7], strict=True):
        mounted, nodded = (getattr(c.mounting, name) for c in (found.camera, found.camera_at(7)))
        assert nodded - mounted == pytest.approx(change) and change != 0.0


def _closed_map() -> DriveMap:
    """A lap with a lane beside the driven one."""
    basis = CubicBasis(np.linspace(0.0, 300.0, 21), periodic=True)
    angle = 2.0 * np.pi * np.arange(20) / 20

    def ring(side: Side, radius_cm: float, rank: int = 0) -> LaneLine:
        control = basis.unfolded(radius_cm * np.column_stack([np.cos(angle), np.sin(angle)]))
        return LaneLine(
            side,
            basis.knots_cm,
            control,
            np.array([[280.0, 350.0]]),
            0.1,
            rank,
            300.0,
            np.linspace(0.0, 295.0, 60),
            np.linspace(0.05, 0.4, 60),
            2.0,
            0.3,
        )

    plain = small_map()
    lines = [ring("left", 30.0), ring("right", 66.0), ring("right", 102.0, 1)]
    return replace(plain, segment=np.zeros(N, dtype=np.int64), lines={0: lines})


def test_closed_lines_and_lines_beside_the_lane_are_read_back(tmp_path):
    written = _closed_map()
    write_map(tmp_path, written, {"frame": np.arange(2)}, {}, "given")
    found = read_map(tmp_path)
    s = np.linspace(-100.0, 700.0, 97)
    for line, again in zip(written.lines[0], found.lines[0], strict=True):
        assert (again.side, again.rank, again.index, again.period_cm) == (
            line.side,
            line.rank,
            line.index,
            300.0,
        )
        assert again.marking_cm == 2.0
        assert again.unpainted == 0.3 and again.dashed
        np.testing.assert_allclose(again.points(s), line.points(s), atol=1e-9)
        np.testing.assert_allclose(again.sigma_cm(s), line.sigma_cm(s), atol=1e-9)
    assert [line.index for line in found.lines[0]] == [0, 1, 2]
    np.testing.assert_array_equal(
        found.lines[0][0].supported(np.array([290.0, 20.0, 320.0, 60.0])), [1, 1, 1, 0]
    )


def test_widths_along_a_line_are_read_back_and_older_maps_have_one(tmp_path):
    written = _closed_map()
    line = written.lines[0][1]
    wider = replace(line, marking_at_cm=np.where(line.sigma_s_cm < 100.0, 3.0, 2.0))
    written = replace(written, lines={0: [written.lines[0][0], wider, written.lines[0][2]]})
    write_map(tmp_path, written, {"frame": np.arange(2)}, {}, "given")
    at = np.array([50.0, 200.0])
    assert [line.widths_cm(at).tolist() for line in read_map(tmp_path).lines[0][:2]] == [
        [2.0, 2.0],
        [3.0, 2.0],
    ]
    lanes = json.loads((tmp_path / "lanes.json").read_text())
    for item in lanes["lines"]:
        del item["marking_at_cm"]
    (tmp_path / "lanes.json").write_text(json.dumps(lanes))
    assert read_map(tmp_path).lines[0][1].widths_cm(at).tolist() == [2.0, 2.0]


def test_sections_that_images_contradict_are_read_back_and_older_maps_have_none(tmp_path):
    written = _closed_map()
    wrong = replace(written.lines[0][1], contradicted_cm=np.array([[280.0, 320.0]]))
    written = replace(written, lines={0: [written.lines[0][0], wrong, written.lines[0][2]]})
    write_map(tmp_path, written, {"frame": np.arange(2)}, {}, "given")
    places = np.array([270.0, 290.0, 10.0, 30.0])
    assert read_map(tmp_path).lines[0][1].contradicted(places).tolist() == [False, True, True, False]
    path = tmp_path / "lanes.json"
    older = json.loads(path.read_text())
    older["format"] = "lanenet-lanes/2"
    for line in older["lines"]:
        del line["contradicted_cm"]
    path.write_text(json.dumps(older))
    assert not read_map(tmp_path).lines[0][1].contradicted(places).any()


def test_kinks_are_read_back(tmp_path):
    written = _closed_map()
    breaks = np.sort(np.concatenate([np.linspace(0.0, 300.0, 21), [97.0] * 3, [299.5] * 3]))
    basis = CubicBasis(breaks, periodic=True)
    angle = 2.0 * np.pi * np.arange(basis.size) / basis.size
    ring = 30.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    left = replace(written.lines[0][0], knots_cm=basis.knots_cm, coefficients_cm=basis.unfolded(ring))
    written = replace(written, lines={0: [left, *written.lines[0][1:]]})
    write_map(tmp_path, written, {"frame": np.arange(2)}, {}, "given")
    again = read_map(tmp_path).lines[0][0]
    np.testing.assert_allclose(again.kinks_cm, [97.0, 299.5])
    s_cm = np.array([90.0, 97.0, 299.5, 300.5])
    np.testing.assert_allclose(again.points(s_cm), left.points(s_cm), atol=1e-9)
    # Also before and beyond the lap.
    np.testing.assert_allclose(
        again.with_corners(np.array([-2.0, 390.0, 598.0])), [-2.0, -0.5, 97.0, 299.5, 390.0, 397.0, 598.0]
    )


def test_the_drive_is_found_from_any_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    out = tmp_path / "map"
    out.mkdir()
    write_map(out, small_map(), {"frame": np.arange(2)}, {}, "given")
    monkeypatch.chdir(out)
    assert read_map(out).meta.drive == str(tmp_path / "drives" / "circuit")


def test_other_tools_can_read_the_folder(folder):
    table = require("pyarrow.parquet", "data").read_table(folder / "edges.parquet")
    assert table.column("frame").to_pylist() == list(range(5))
    assert json.loads(table.schema.metadata[b"lanenet"]) == {"format": "lanenet-edges/2"}
    # A trajectory in metres, by the TUM convention: time, position, quaternion.
    tum = np.loadtxt(folder / "trajectory.tum")
    assert tum.shape == (N, 8)
    np.testing.assert_allclose(100.0 * tum[:, 1:3], small_map().poses[:, :2], atol=1e-3)
    report = json.loads((folder / "report.json").read_text())
    assert report == {"format": "lanenet-map-report/1", "frames": N, "figures": [1.0, None]}
    assert "from the drive" in (folder / "camera.yaml").read_text()


def test_a_folder_that_is_no_map(tmp_path):
    with pytest.raises(MapFormatError, match=r"no map\.yaml"):
        read_map(tmp_path)
    with pytest.raises(MapFormatError, match=r"no map\.yaml"):
        read_map(tmp_path / "nowhere")


@pytest.mark.parametrize("replacement", ["lanenet-map/2", "lanenet-drive/1", "7"])
def test_another_version_is_refused(folder, replacement):
    path = folder / "map.yaml"
    path.write_text(path.read_text().replace(FORMAT, replacement))
    with pytest.raises(MapFormatError, match=f"format is '?{replacement}'?, expected '{FORMAT}'"):
        read_map(folder)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("laps: 1", "laps: one", "laps"),
        ("tape_cm: 2.1\n", "", "'tape_cm' is missing"),
        ("laps: 1", "lapps: 1", "lapps"),
        ("scale_from: lane width", "scale_from: [", "not valid YAML"),
        ("mapped_lane_cm: 36.4", "mapped_lane_cm: 0", "'mapped_lane_cm'"),
        ("laps: 1", "laps: yes", "'laps'"),
    ],
)
def test_damaged_meta_data(folder, old, new, message):
    path = folder / "map.yaml"
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(MapFormatError, match=rf"map\.yaml.*{message}"):
        read_map(folder)


@pytest.mark.parametrize("value", ["nan", "", "inf", "3,5"])
def test_poses_without_a_number_are_refused(folder, value):
    path = folder / "poses.csv"
    lines = path.read_text().splitlines()
    cells = lines[5].split(",")
    cells[2] = value
    lines[5] = ",".join(cells)
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(MapFormatError, match=r"poses\.csv: line 6"):
        read_map(folder)


@pytest.mark.parametrize(
    "change",
    [
        {"x_cm": "0.5", "y_cm": "0.25"},
        {"frame": "7"},
        {"x_cm": "1e300"},
        {"match": "-300"},
        {"segment": "-1"},
    ],
    ids=lambda change: "-".join(change),
)
def test_poses_that_no_drive_has_are_refused(folder, change):
    path = folder / "poses.csv"
    rows = [line.split(",") for line in path.read_text().splitlines()]
    for name, value in change.items():
        for row in rows[1:]:
            row[rows[0].index(name)] = value
    path.write_text("".join(",".join(row) + "\n" for row in rows))
    with pytest.raises(MapFormatError, match=r"poses\.csv"):
        read_map(folder)


def test_a_frame_whose_edges_face_the_other_way_is_read(folder):
    path = folder / "poses.csv"
    header, first, *rest = path.read_text().splitlines()
    cells = first.split(",")
    cells[header.split(",").index("match")] = "-0.12"
    path.write_text("\n".join([header, ",".join(cells), *rest]) + "\n")
    assert read_map(folder).match[0] == -0.12


@pytest.mark.parametrize("name", ["pitch_rad", "held_out", "off_3_right_30"])
def test_a_missing_column_is_named(folder, name):
    path = folder / "poses.csv"
    path.write_text(path.read_text().replace(name, "something_else", 1))
    with pytest.raises(MapFormatError, match=rf"poses\.csv.*{name}"):
        read_map(folder)


@pytest.mark.parametrize("name", ["poses.csv", "lanes.json", "camera.yaml"])
def test_a_missing_file_is_named(folder, name):
    (folder / name).unlink()
    with pytest.raises(LanenetError, match=name):
        read_map(folder)


def _damage(plain: dict, what: str) -> object:
    line = plain["lines"][0]
    if what == "a list":
        return [1, 2]
    if what == "other format":
        plain["format"] = "lanenet-lanes/9"
    elif what == "no lines":
        del plain["lines"]
    elif what.startswith("no "):
        del line[what.removeprefix("no ")]
    elif what == "unknown side":
        line["side"] = "middle"
    elif what == "text for a number":
        line["knots_cm"][3] = "three"
    elif what == "null for a number":
        line["coefficients_cm"][3] = [None, None]
    elif what == "odd coefficients":
        line["coefficients_cm"][3] = [1.0]
    elif what == "too few coefficients":
        line["coefficients_cm"] = line["coefficients_cm"][:-2]
    elif what == "knots out of order":
        line["knots_cm"][5] = -40.0
    elif what == "two left lines":
        plain["lines"][1]["side"] = "left"
    elif what == "a gap between lines":
        plain["lines"].append({**line, "rank": 2})
    elif what == "negative rank":
        line["rank"] = -1
    elif what == "another period":
        line["period_cm"] = 80.0
    elif what == "half an uncertainty":
        line["sigma_s_cm"] = [1.0, 2.0]
    elif what == "one line":
        del plain["lines"][0]
    elif what == "sides swapped":
        for pair in (plain["lines"][:2], plain["lines"][2:]):
            pair[0]["side"], pair[1]["side"] = "right", "left"
    elif what == "equal knots":
        line["knots_cm"][6:9] = [line["knots_cm"][5]] * 3
    elif what == "knots beyond all measure":
        line["knots_cm"] = [1e300 * k for k in line["knots_cm"]]
    elif what == "support that ends before it begins":
        line["supported_cm"] = [[80.0, 0.0]]
    elif what == "a rank beyond all roads":
        line["rank"] = 10**12
    elif what == "a segment that is no number":
        line["segment"] = float("inf")
    elif what == "widths of another number":
        line["marking_at_cm"] = [2.0]
    elif what == "a width of nothing":
        line |= {"sigma_s_cm": [0.0, 1.0], "sigma_at_cm": [0.1, 0.1], "marking_at_cm": [0.0, 2.0]}
    elif what == "an unpainted share above one":
        line["bare_share"] = 7.0
    return plain


@pytest.mark.parametrize(
    "what",
    [
        "a list",
        "other format",
        "no lines",
        "no side",
        "no rank",
        "no sigma_at_cm",
        "unknown side",
        "text for a number",
        "null for a number",
        "odd coefficients",
        "too few coefficients",
        "knots out of order",
        "two left lines",
        "a gap between lines",
        "negative rank",
        "another period",
        "half an uncertainty",
        "widths of another number",
        "a width of nothing",
        "one line",
        "sides swapped",
        "equal knots",
        "knots beyond all measure",
        "support that ends before it begins",
        "a rank beyond all roads",
        "a segment that is no number",
        "an unpainted share above one",
    ],
)
def test_damaged_lane_lines_are_refused(folder, what):
    path = folder / "lanes.json"
    path.write_text(json.dumps(_damage(json.loads(path.read_text()), what)))
    with pytest.raises(MapFormatError, match=r"lanes\.json"):
        read_map(folder)


@pytest.mark.parametrize("content", [b"", b'{"format": "lanenet-lanes/2", "lines": [', b"\xff\xfe\x00"])
def test_a_cut_off_lane_file_is_refused(folder, content):
    (folder / "lanes.json").write_bytes(content)
    with pytest.raises(MapFormatError, match=r"lanes\.json"):
        read_map(folder)


def test_a_segment_without_lines_is_refused(folder):
    path = folder / "lanes.json"
    plain = json.loads(path.read_text())
    plain["lines"] = plain["lines"][:2]
    path.write_text(json.dumps(plain))
    with pytest.raises(MapFormatError, match=r"lanes\.json.*segment 1"):
        read_map(folder)
