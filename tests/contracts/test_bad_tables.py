"""Bad tables: CSV files and label sets to read, and detections that cannot be written."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
import pyarrow.parquet
import pytest
from bad_input import Bad, each
from synthetic_labels import make_label_set

from lanenet.data.detections import DetectionTable
from lanenet.data.label_set import read_labels, write_labels
from lanenet.data.tables import META_KEY, ColumnSpec, read_csv
from lanenet.errors import DriveFormatError, LabelFormatError
from lanenet.perception.estimate import LaneEstimate

Act = Callable[[Path], Any]

SPECS = {
    "frame": ColumnSpec("int", low=0.0, increasing=True),
    "file": ColumnSpec("text"),
    "t_s": ColumnSpec(),
    "angle": ColumnSpec(required=False, low=-1.0, high=1.0),
}


def csv(what: str, text: str, *named: str) -> Bad:
    def act(folder: Path) -> Any:
        (folder / "frames.csv").write_text(text, encoding="utf-8")
        return read_csv(folder / "frames.csv", SPECS)

    return Bad(what, act, DriveFormatError, ("frames.csv", *named))


def no_text(folder: Path) -> Any:
    (folder / "a.csv").write_bytes(b"\xff\xfe\x00\x81")
    return read_csv(folder / "a.csv", SPECS, LabelFormatError)


def detections() -> DetectionTable:
    table = DetectionTable()
    table.add(3, 0.15, LaneEstimate(confidence=0.875))
    table.add(8, 0.4, LaneEstimate(confidence=0.5, radius_cm=145.5, offset_cm=-3.25))
    return table


def refused_to_write(name: str, **values: float) -> Act:
    def act(folder: Path) -> None:
        table = detections()
        if values:
            table.add(9, 0.5, LaneEstimate(**{"confidence": 0.5, **values}))  # type: ignore[arg-type]
        try:
            table.write(folder / name)
        finally:
            assert list(folder.iterdir()) == []

    return act


def labels(what: str, act: Act, *named: str) -> Bad:
    return Bad(what, act, LabelFormatError, named)


def parquet(meta: bytes, n: int = 3, text: str = "") -> Act:
    """A table with a text that takes little room in the file, read as a label set."""

    def act(folder: Path) -> Any:
        column = pyarrow.DictionaryArray.from_arrays(np.zeros(n, np.int32), [text])
        table = pyarrow.table({"file": column}).replace_schema_metadata({META_KEY: meta})
        pyarrow.parquet.write_table(table, folder / "a.parquet", compression="zstd", store_schema=False)
        return read_labels(folder / "a.parquet")

    return act


def label_set(old: str, new: str) -> Act:
    """A label set with a text of its metadata replaced."""

    def act(folder: Path) -> Any:
        write_labels(folder / "a.parquet", make_label_set(2, 0))
        table = pyarrow.parquet.read_table(folder / "a.parquet")
        meta = table.schema.metadata[META_KEY].decode()
        assert old in meta
        table = table.replace_schema_metadata({META_KEY: meta.replace(old, new)})
        pyarrow.parquet.write_table(table, folder / "a.parquet")
        return read_labels(folder / "a.parquet")

    return act


INF, NAN = float("inf"), float("nan")

BAD = [
    csv("an empty file", "", "empty"),
    csv("a missing column", "frame,file\n0,a\n", "line 1", "'t_s'", "missing"),
    csv("a column twice", "frame,frame,file,t_s\n", "line 1", "'frame'", "twice"),
    csv("a misspelt column", "frame,file,t_s,angel\n", "line 1", "'angel'", "'angle'"),
    csv("too few fields", "frame,file,t_s\n0,a,0.1\n1,b\n", "line 3", "expected 3", "found 2"),
    csv("too many fields", "frame,file,t_s\n0,a,0.1\n1,b,0.2,9\n", "line 3", "expected 3", "found 4"),
    csv("nan", "frame,file,t_s\n0,a,0.1\n1,b,nan\n", "line 3", "'t_s'", "a number", "'nan'"),
    csv("infinity", "frame,file,t_s\n0,a,inf\n", "line 2", "'t_s'", "a number", "'inf'"),
    csv("an empty number", "frame,file,t_s\n0,a,\n", "line 2", "'t_s'", "empty"),
    csv("an empty text", "frame,file,t_s\n0,,0.1\n", "line 2", "'file'", "empty"),
    csv("an underscore", "frame,file,t_s\n0,a,1_0\n", "line 2", "'t_s'", "a number", "'1_0'"),
    csv("a fraction", "frame,file,t_s\n0.5,a,1\n", "line 2", "'frame'", "a whole number", "'0.5'"),
    csv("too large", "frame,file,t_s\n99999999999999999999,a,1\n", "line 2", "'frame'", "a whole number"),
    csv("too small", "frame,file,t_s\n-1,a,1\n", "line 2", "'frame'", "0 to inf", "-1"),
    csv("no increase", "frame,file,t_s\n1,a,1\n\n1,a,1\n", "line 4", "'frame'", "more than 1"),
    csv("out of range", "frame,file,t_s,angle\n0,a,1,-30\n", "line 2", "'angle'", "-1 to 1", "-30"),
    csv("semicolons", "frame;file;t_s\n0;a;1\n", "line 1", "'frame'", "frame;file;t_s"),
    csv("a row without end", "frame,file,t_s\n0,a," + "1" * 2**20, "line 2"),
    csv("a header without end", "," * 2**20, "line 1"),
    labels("no text", no_text, "a.csv"),
    labels("a folder", lambda folder: read_csv(folder, SPECS, LabelFormatError), "a folder"),
    labels("a device", lambda _: read_csv(Path("/dev/zero"), SPECS, LabelFormatError), "/dev/zero"),
    labels("a label set that is a folder", read_labels, "is no file"),
    labels("labels that unpack without end", parquet(b"{}", n=9000, text="x" * 2**16), "a.parquet", "MB"),
    labels("labels of a window without end", label_set('"rows": 24', '"rows": 2400000'), "'window.rows'"),
    labels("labels of yes for a width", label_set('"lane_width_cm": 40.0', '"lane_width_cm": true'), "True"),
    Bad("no file", lambda f: read_csv(f / "a.csv", SPECS), DriveFormatError, ("a.csv", "no such file")),
    labels("writes another ending", refused_to_write("seen.txt"), ".parquet", ".csv"),
    labels("writes no ending", refused_to_write("seen"), ".parquet", ".csv"),
    *(
        labels(f"writes {column} as {value} to {name}", refused_to_write(name, **{column: value}), *named)
        for name in ("seen.csv", "seen.parquet")
        for column, value, named in (
            ("steering_rad", INF, ("frame 9", "'steering_rad'", "inf")),
            ("confidence", NAN, ("frame 9", "'confidence'", "NaN")),
            ("offset_cm", INF, ("frame 9", "'offset_cm'", "inf")),
        )
    ),
]


@each(BAD)
def test_a_bad_table_is_refused(tmp_path: Path, bad: Bad) -> None:
    bad.check(tmp_path)


def test_no_damaged_number_of_a_label_set_is_read(tmp_path: Path) -> None:
    path, rng = tmp_path / "a.parquet", np.random.default_rng(0)
    write_labels(path, make_label_set(2, 0))
    data, group = path.read_bytes(), pyarrow.parquet.read_metadata(path).row_group(0)
    for name in rng.integers(group.num_columns, size=40).tolist():
        column = group.column(name)
        damaged = bytearray(data)
        # The last bytes of a column: of its values, which would be read as other ones.
        start = column.dictionary_page_offset or column.data_page_offset
        damaged[start + column.total_compressed_size - int(rng.integers(1, 5))] ^= 4
        path.write_bytes(damaged)
        with pytest.raises(LabelFormatError, match=r"a\.parquet"):
            read_labels(path)
