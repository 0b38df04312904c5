from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lanenet.data.tables import ColumnSpec, read_csv, write_csv
from lanenet.errors import DriveFormatError, LabelFormatError

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


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "empty, expected a header"),
        ("frame,file\n0,a\n", "line 1: column 't_s' is missing"),
        ("frame,frame,file,t_s\n", "line 1: column 'frame' occurs twice"),
        ("frame,file,t_s,angel\n", "line 1: unknown column 'angel', did you mean 'angle'"),
        ("frame,file,t_s\n0,a,0.1\n1,b\n", "line 3: expected 3 fields, found 2"),
        ("frame,file,t_s\n0,a,0.1\n1,b,0.2,9\n", "line 3: expected 3 fields, found 4"),
        ("frame,file,t_s\n0,a,0.1\n1,b,nan\n", "line 3, column 't_s': expected a number, found 'nan'"),
        ("frame,file,t_s\n0,a,inf\n", "line 2, column 't_s': expected a number, found 'inf'"),
        ("frame,file,t_s\n0,a,\n", "line 2, column 't_s': the cell is empty"),
        ("frame,file,t_s\n0,,0.1\n", "line 2, column 'file': the cell is empty"),
        ("frame,file,t_s\n0,a,1_0\n", "line 2, column 't_s': expected a number, found '1_0'"),
        ("frame,file,t_s\n0.5,a,1\n", "line 2, column 'frame': expected a whole number, found '0.5'"),
        ("frame,file,t_s\n99999999999999999999,a,1\n", "line 2, column 'frame': expected a whole number"),
        ("frame,file,t_s\n-1,a,1\n", "line 2, column 'frame': expected 0 to inf, found -1"),
        ("frame,file,t_s\n1,a,1\n\n1,a,1\n", "line 4, column 'frame': expected more than 1"),
        ("frame,file,t_s,angle\n0,a,1,-30\n", "line 2, column 'angle': expected -1 to 1, found -30"),
        ("frame;file;t_s\n0;a;1\n", "line 1: column 'frame' is missing; found frame;file;t_s"),
    ],
)
def test_what_is_wrong_is_named_by_line_and_column(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(DriveFormatError) as caught:
        read_csv(written(tmp_path, text), SPECS)
    assert f"frames.csv: {message}" in str(caught.value)


def test_bytes_that_are_not_text(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(LabelFormatError, match=r"a\.csv: cannot be read as CSV"):
        read_csv(path, SPECS, LabelFormatError)


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(DriveFormatError, match=r"a\.csv: no such file"):
        read_csv(tmp_path / "a.csv", SPECS)


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
