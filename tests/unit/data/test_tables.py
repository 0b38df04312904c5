from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tum import read_tum

from lanenet.data.tables import (
    ColumnSpec,
    ParquetTable,
    read_csv,
    tum_from_poses,
    write_csv,
    write_parquet,
    write_tum,
)
from lanenet.errors import LabelFormatError, MapFormatError

SPECS = {
    "frame": ColumnSpec("int", low=0.0, increasing=True),
    "file": ColumnSpec("text"),
    "t_s": ColumnSpec(),
    "angle": ColumnSpec(required=False, low=-1.0, high=1.0),
    "left_0_cm": ColumnSpec(required=False, allow_empty=True),
}


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "frames.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_columns_are_read_by_name_and_kind(tmp_path: Path) -> None:
    text = '\ufeffnotes,t_s, frame,file,left_0_cm\n"a, b",0.5,3,one.jpg,\n\nx,1e3,7, two.jpg,-2.25\n'
    table = read_csv(written(tmp_path, text), SPECS)
    assert table["frame"].dtype == np.int64
    assert table["frame"].tolist() == [3, 7]
    assert table["t_s"].tolist() == [0.5, 1000.0]
    assert table["file"].tolist() == ["one.jpg", "two.jpg"]
    np.testing.assert_array_equal(table["left_0_cm"], [np.nan, -2.25])
    assert "angle" not in table
    assert "notes" not in table


@given(
    values=st.lists(st.floats(-1e5, 1e5) | st.just(float("nan")), min_size=1, max_size=8),
    texts=st.text(alphabet="ab,\"' ", min_size=1, max_size=4).filter(lambda s: s == s.strip() != ""),
)
def test_round_trip(tmp_path_factory: pytest.TempPathFactory, values: list[float], texts: str) -> None:
    path = tmp_path_factory.mktemp("csv") / "a.csv"
    frame = np.arange(len(values))
    write_csv(
        path,
        {"frame": frame, "file": [texts] * len(values), "t_s": frame * 0.05, "left_0_cm": np.array(values)},
        allow_empty=["left_0_cm"],
    )
    table = read_csv(path, SPECS)
    np.testing.assert_array_equal(table["frame"], frame)
    assert table["file"].tolist() == [texts] * len(values)
    np.testing.assert_allclose(table["left_0_cm"], values, rtol=1e-8)


def test_numbers_are_short_and_clocks_keep_their_microseconds(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    columns = {"a": np.array([0.1, 1.0 / 3.0]), "t_s": np.array([1602421393.803125, 0.05])}
    write_csv(path, {**columns, "ok": np.array([True, False])})
    assert path.read_text() == "a,t_s,ok\n0.1,1602421393.803125,1\n0.333333333,0.05,0\n"


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_writing_refuses_what_reading_would(tmp_path: Path, value: float) -> None:
    with pytest.raises(ValueError, match="column 'a', row 1"):
        write_csv(tmp_path / "a.csv", {"a": np.array([0.0, value])})
    with pytest.raises(ValueError, match="column 'a', row 0"):
        write_csv(tmp_path / "a.csv", {"a": np.array([-np.inf])}, allow_empty=["a"])
    assert list(tmp_path.iterdir()) == []


def test_writing_refuses_columns_of_different_length(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="different lengths"):
        write_csv(tmp_path / "a.csv", {"a": np.zeros(2), "b": np.zeros(3)})


poses_lists = st.lists(
    st.tuples(st.floats(-1e4, 1e4), st.floats(-1e4, 1e4), st.floats(-3.0, 3.0)), min_size=1, max_size=12
)


def accumulated(rows: list[tuple[float, float, float]]) -> np.ndarray:
    """Poses whose heading changes by less than half a circle per row, and may wind up."""
    poses = np.array(rows)
    poses[:, 2] = np.cumsum(poses[:, 2])
    return poses


def test_known_rows() -> None:
    poses = np.array([[100.0, -50.0, 0.0], [0.0, 0.0, np.pi / 2]])
    rows = tum_from_poses(np.array([0.5, 1.0]), poses)
    half = np.sqrt(0.5)
    expected = [[0.5, 1.0, -0.5, 0.0, 0.0, 0.0, 0.0, 1.0], [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, half, half]]
    np.testing.assert_allclose(rows, expected, atol=1e-12)


@given(poses_lists)
def test_file_round_trip(
    tmp_path_factory: pytest.TempPathFactory, rows: list[tuple[float, float, float]]
) -> None:
    path = tmp_path_factory.mktemp("tum") / "trajectory.tum"
    poses = accumulated(rows)
    t_s = 1.6e9 + 0.05 * np.arange(len(poses))
    write_tum(path, t_s, poses)
    t_back, poses_back = read_tum(path)
    np.testing.assert_allclose(t_back, t_s, rtol=0, atol=1e-6)
    np.testing.assert_allclose(poses_back, poses, rtol=0, atol=1e-6)


def test_an_unknown_pose_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(MapFormatError, match="row 1 is not finite"):
        write_tum(tmp_path / "a.tum", np.arange(2.0), np.array([[0.0, 0.0, 0.0], [np.nan, 0.0, 0.0]]))
    assert list(tmp_path.iterdir()) == []


def test_texts_by_number_are_read_as_far_as_they_may_be_unpacked(tmp_path: Path) -> None:
    """Of pandas' categories each text stands once in the file."""
    path = tmp_path / "a.parquet"
    for texts, rows in ((["x", "y"], 3), ([2000 * "x"], 200_000)):
        numbers = pa.array(np.arange(rows, dtype=np.int32) % len(texts))
        write_parquet(path, {"file": pa.DictionaryArray.from_arrays(numbers, pa.array(texts))}, {})
        if rows == 3:
            assert ParquetTable(path).texts("file") == ["x", "y", "x"]
    with pytest.raises(LabelFormatError, match=r"0\.\d MB stand for .*MB"):
        ParquetTable(path)
