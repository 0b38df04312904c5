from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow.csv
import pyarrow.parquet as pq
import pytest
from detections import read_detections

from lanenet.data.detections import IMAGE_LINE_NAMES, DetectionTable
from lanenet.geometry.lane import POINT_NAMES, POINTS_FROM_PARABOLA
from lanenet.perception.estimate import LaneEstimate
from lanenet.perception.image_lane import LINE_PX_NAMES

PARABOLAS = np.array([[0.01, -0.2, -20.0], [-0.02, 0.3, 20.5]])
FULL = LaneEstimate((PARABOLAS @ POINTS_FROM_PARABOLA.T).ravel(), np.arange(1.0, 7.0), 0.25, 0.875)
HALF = LaneEstimate(np.array([-20.0, -19.0, np.nan, 20.0, 21.0, 22.0]), steering_rad=-0.1, confidence=0.5)


def make_table() -> DetectionTable:
    table = DetectionTable()
    table.add(3, 0.15, FULL)
    table.add(4, 0.2, LaneEstimate())
    table.add(7, float("nan"), HALF)
    return table


@pytest.mark.parametrize("name", ["seen.csv", "seen.parquet", "seen.PARQUET"])
def test_round_trip(tmp_path: Path, name: str) -> None:
    table = make_table()
    assert len(table) == 3
    table.write(tmp_path / name)
    back = read_detections(tmp_path / name)
    assert back.frame.tolist() == [3, 4, 7]
    np.testing.assert_allclose(back.t_s, [0.15, 0.2, np.nan])
    np.testing.assert_allclose(
        back.points_cm, [FULL.points_cm, np.full(6, np.nan), HALF.points_cm], rtol=1e-8
    )
    np.testing.assert_allclose(back.sigma_cm, [np.arange(1.0, 7.0), *np.full((2, 6), np.nan)])
    np.testing.assert_allclose(back.parabolas[0], PARABOLAS, rtol=1e-8, atol=1e-9)
    assert np.isnan(back.parabolas[1]).all()
    # Only the line that lacks a point has no parabola.
    assert np.isnan(back.parabolas[2, 0]).all()
    np.testing.assert_allclose(back.parabolas[2, 1], [0.0, 1.0 / 15.0, 20.0], rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(back.steering_rad, [0.25, np.nan, -0.1])
    assert back.confidence.tolist() == [0.875, 0.0, 0.5]
    assert [p.name for p in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("name", ["seen.csv", "seen.parquet"])
def test_why_a_frame_is_not_answered_is_a_column_where_a_detector_says_so(tmp_path: Path, name: str) -> None:
    table = DetectionTable()
    table.add(0, 0.0, FULL)
    table.add(1, 0.1, LaneEstimate(reason="two lanes compete, or none"))
    table.write(tmp_path / name)
    read = pyarrow.csv.read_csv if name.endswith(".csv") else pq.read_table
    assert [text or "" for text in read(tmp_path / name)["reason"].to_pylist()] == [
        "",
        "two lanes compete, or none",
    ]
    assert len(read_detections(tmp_path / name).frame) == 2


def test_columns_are_those_of_the_contract(tmp_path: Path) -> None:
    make_table().write(tmp_path / "seen.csv")
    header = (tmp_path / "seen.csv").read_text().splitlines()[0].split(",")
    assert header.pop() == "format_version"
    assert header == [
        *("frame", "t_s"),
        *POINT_NAMES,
        *("left_0_sigma_cm", "left_15_sigma_cm", "left_30_sigma_cm"),
        *("right_0_sigma_cm", "right_15_sigma_cm", "right_30_sigma_cm"),
        *("left_a", "left_b", "left_c", "right_a", "right_b", "right_c"),
        *("steering_rad", "confidence"),
    ]
    make_table().write(tmp_path / "seen.parquet")
    table = pq.read_table(tmp_path / "seen.parquet")
    assert table.column_names == header
    assert table.column("left_30_cm").null_count == 2
    assert json.loads(table.schema.metadata[b"lanenet"])["format"] == "lanenet-detections/1"


@pytest.mark.parametrize("name", ["seen.csv", "seen.parquet"])
def test_radius_and_offset_where_a_detector_knows_them(tmp_path: Path, name: str) -> None:
    table = make_table()
    table.write(tmp_path / name)
    # Nobody measured them: no columns.
    old = read_detections(tmp_path / name)
    assert np.isnan(old.radius_cm).all() and np.isnan(old.offset_cm).all() and len(old.offset_cm) == 3
    table.add(8, 0.4, LaneEstimate(radius_cm=145.5, offset_cm=-3.25))
    table.add(9, 0.45, LaneEstimate(radius_cm=float("inf"), offset_cm=0.5))
    table.write(tmp_path / name)
    new = read_detections(tmp_path / name)
    np.testing.assert_allclose(new.radius_cm, [np.nan, np.nan, np.nan, 145.5, np.inf])
    np.testing.assert_allclose(new.offset_cm, [np.nan, np.nan, np.nan, -3.25, 0.5])
    np.testing.assert_allclose(new.points_cm[:3], old.points_cm)
    if name.endswith(".csv"):
        lines = (tmp_path / name).read_text().splitlines()
        assert lines[0].endswith(",steering_rad,confidence,radius_cm,offset_cm,format_version")
        assert lines[1].endswith(",0.875,,,1") and lines[5].endswith(",0,inf,0.5,1")


@pytest.mark.parametrize("name", ["seen.csv", "seen.parquet"])
def test_an_empty_table(tmp_path: Path, name: str) -> None:
    DetectionTable().write(tmp_path / name)
    back = read_detections(tmp_path / name)
    assert len(back.frame) == 0
    assert back.points_cm.shape == (0, 6)
    assert back.parabolas.shape == (0, 2, 3)


@pytest.mark.parametrize("name", ["seen.csv", "seen.parquet"])
def test_lines_of_the_image_are_written_in_pixels(tmp_path: Path, name: str) -> None:
    # A detector that works on the image and finds a line on the right only, then none.
    lines_px = np.full((2, len(LINE_PX_NAMES)), np.nan)
    lines_px[1] = [600.0, 479.0, 330.0, 250.0, 1e-6, 1e-4, 1.1, 50.0]
    table = make_table()
    table.add(8, 0.4, LaneEstimate(lines_px=lines_px))
    table.add(9, 0.45, LaneEstimate(lines_px=np.full_like(lines_px, np.nan)))
    table.write(tmp_path / name)
    read = pyarrow.csv.read_csv if name.endswith("csv") else pq.read_table
    columns = read(tmp_path / name).to_pydict()
    found = {key: values for key, values in columns.items() if key.endswith("_px")}
    assert tuple(found) == IMAGE_LINE_NAMES
    # Frames of other detectors, and lines that were not found, are empty cells.
    assert all(value is None for key in found for value in found[key][:3] + found[key][4:])
    assert all(found[f"left_{key}"][3] is None for key in LINE_PX_NAMES)
    assert [found[f"right_{key}"][3] for key in LINE_PX_NAMES] == pytest.approx(lines_px[1].tolist())
    if name.endswith("parquet"):
        metadata = pq.read_schema(tmp_path / name).metadata[b"lanenet"]
        assert json.loads(metadata)["units"]["_u_px"] == "pixel"


def test_a_detector_of_the_image_that_found_nothing_has_the_columns_all_the_same(tmp_path: Path) -> None:
    table = DetectionTable()
    table.add(0, 0.0, LaneEstimate(lines_px=np.full((2, len(LINE_PX_NAMES)), np.nan)))
    table.write(tmp_path / "seen.csv")
    header, row = (tmp_path / "seen.csv").read_text().splitlines()
    cells = dict(zip(header.split(","), row.split(","), strict=True))
    assert [cells[key] for key in IMAGE_LINE_NAMES] == [""] * len(IMAGE_LINE_NAMES)
