"""Tables as files: CSV, Parquet, and trajectories in the TUM format.

Reading is strict: an error names the file, the line or row, and the column. pyarrow comes with the extra
``data`` and is imported inside the functions: the car does not have it.
"""

from __future__ import annotations

import array
import csv
import hashlib
import io
import json
import math
import os
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from lanenet.data.files import atomic_file, require, write_text
from lanenet.errors import DriveFormatError, LabelFormatError, LanenetError, MapFormatError, did_you_mean
from lanenet.reading import (
    MEBIBYTE,
    first_line,
    is_regular,
    memory_limit,
    open_regular,
    parsing,
)

_INT64_MAX = 2**63 - 1
#: Numbers above this are written in full: nine digits would lose the microseconds of Unix time.
_SHORT_BELOW = 1e6
#: Of a CSV file. Chosen: a million frames with all their columns have 150 MB.
_MAX_CSV = 512 * MEBIBYTE
#: Characters of one row; chosen: a thousand columns of text.
_MAX_RECORD = 2**18
_ARRAYS = {"float": "d", "int": "q"}
#: Of a Parquet file. Chosen: a day of driving, and twenty times the columns of a label set.
_MAX_ROWS, _MAX_COLUMNS = 5_000_000, 1000
#: What a Parquet file may unpack to: so much, and so many times its size. Chosen: label sets unpack to 2 to
#: 20 times their size, small ones of a still car to more.
_MAX_UNPACKED, _MAX_RATIO = 192 * MEBIBYTE, 100
#: Texts and lists in a Parquet file's footer, [B]; chosen: the widest table's footer is far smaller.
_MAX_FOOTER = 16 * MEBIBYTE
#: Largest place [cm] or unwrapped heading [rad] of a table. Chosen: ten kilometres, or as many turns; squares
#: of more would lose the centimetres.
MAX_PLACE = 1e6
#: Column of a detector's answers as CSV, which has no other place for their version; no recording has it.
VERSION_NAME = "format_version"
#: Key of the schema metadata that holds what the table is, as JSON.
META_KEY = b"lanenet"


@dataclass(frozen=True)
class ColumnSpec:
    """What a column may hold.

    Attributes:
        kind: Numbers, whole numbers, or text.
        required: Whether the file must have the column.
        allow_empty: Whether a cell may be empty, read as NaN or an empty text.
        low: Smallest value of a number.
        high: Largest value of a number.
        increasing: Whether each number must be larger than the one before.
    """

    kind: Literal["float", "int", "text"] = "float"
    required: bool = True
    allow_empty: bool = False
    low: float = -math.inf
    high: float = math.inf
    increasing: bool = False


def read_csv(
    path: Path,
    columns: dict[str, ColumnSpec],
    error: type[LanenetError] = DriveFormatError,
    *,
    skip_torn: bool = False,
) -> dict[str, np.ndarray]:
    """Read the named columns of a CSV file with a header.

    Other columns are skipped, unless one looks like a misspelt optional column.

    Args:
        path: The file, UTF-8, separated by commas.
        columns: What to read.
        error: The error to raise.
        skip_torn: Leave out a last line that was cut off; see :func:`is_torn`.

    Returns:
        An array per column that the file has: float64, int64, or texts as objects. Row i is line i + 2
        of a file without quoted line breaks.

    Raises:
        LanenetError: Of the type ``error``, if the file is missing or not text, the header lacks a column or
            names one twice, a line has more or fewer fields, or a cell is empty, not a number, NaN, infinite,
            out of range or out of order; names the file, the line and the column.
    """
    path = Path(path)
    torn = skip_torn and is_torn(path, error)
    with (
        open_regular(path, error, _MAX_CSV) as binary,
        parsing(f"{path}: cannot be read as CSV", error),
        io.TextIOWrapper(binary, encoding="utf-8-sig", newline="") as stream,
    ):
        try:
            return _read_rows(path, _Records(stream, path, error), columns, torn)
        except csv.Error as problem:
            raise error(f"{path}: cannot be read as CSV ({problem})") from None


class _Records:
    """The records of a CSV file that are not blank, with the number of their last line; bounded in size."""

    def __init__(self, stream: io.TextIOWrapper, path: Path, error: type[LanenetError]) -> None:
        self.path, self.error = path, error
        self._stream = stream
        self._length = 0
        self._reader = csv.reader(self._lines(), strict=True)

    def _lines(self) -> Iterator[str]:
        while line := self._stream.readline(_MAX_RECORD + 1):
            # A record has several lines if line breaks are quoted.
            self._length += len(line)
            if self._length > _MAX_RECORD:
                number = self._reader.line_num + 1
                raise self.error(f"{self.path}: line {number}: longer than {_MAX_RECORD} characters")
            yield line

    def __iter__(self) -> Iterator[tuple[int, list[str]]]:
        for cells in self._reader:
            self._length = 0
            stripped = [cell.strip() for cell in cells]
            if any(stripped):
                yield self._reader.line_num, stripped


def _read_rows(
    path: Path, records: _Records, columns: dict[str, ColumnSpec], torn: bool
) -> dict[str, np.ndarray]:
    error, rows = records.error, iter(records)
    _, header = next(rows, (0, []))
    if not header:
        raise error(f"{path}: empty, expected a header with {', '.join(columns)}")
    _check_header(path, header, columns, error)
    # Numbers as eight bytes each, not as Python's objects: a long drive has millions of cells.
    values: dict[str, Any] = {
        name: [] if columns[name].kind == "text" else array.array(_ARRAYS[columns[name].kind])
        for name in header
        if name in columns
    }
    wanted = [(k, name, columns[name], values[name]) for k, name in enumerate(header) if name in columns]
    following = next(rows, None)
    while following is not None:
        (number, cells), following = following, next(rows, None)
        if torn and following is None:
            break
        if len(cells) != len(header):
            raise error(f"{path}: line {number}: expected {len(header)} fields, found {len(cells)}")
        for k, name, spec, found in wanted:
            try:
                value = _parsed(cells[k], spec)
                if spec.increasing and found and not value > found[-1]:
                    raise ValueError(f"expected more than {found[-1]} of the row before, found {value}")
                found.append(value)
            except ValueError as problem:
                raise error(f"{path}: line {number}, column {name!r}: {problem}") from None
    # Texts as objects: an array of fixed width would give every row the room of the longest.
    dtypes = {"float": np.float64, "int": np.int64, "text": np.object_}
    return {name: np.array(found, dtype=dtypes[columns[name].kind]) for name, found in values.items()}


def is_torn(path: Path, error: type[LanenetError] = DriveFormatError) -> bool:
    """Tell whether the last line of a table was cut off while it was written, as by a power cut.

    Such a line has no line feed, and lacks fields or the text of the last field. A complete last line without
    a line feed, as some editors leave it, is not torn.
    """
    with open_regular(Path(path), error, _MAX_CSV) as stream:
        head = stream.readline(_MAX_RECORD).partition(b"\n")[0]
        size = stream.seek(0, os.SEEK_END)
        stream.seek(max(len(head) + 1, size - _MAX_RECORD))
        last = stream.read().rpartition(b"\n")[2]
    return bool(last.strip()) and (last.count(b",") < head.count(b",") or last.endswith(b","))


def is_answers(path: Path) -> bool:
    """Tell by its header whether a CSV file holds a detector's answers (``lanenet detect``), not a recording.

    Raises:
        DriveFormatError: If it cannot be read.
    """
    with open_regular(path, DriveFormatError, _MAX_CSV) as stream:
        header = stream.readline(_MAX_RECORD)
    return VERSION_NAME.encode() in header.strip().split(b",")


def write_csv(
    path: Path,
    columns: dict[str, np.ndarray] | dict[str, Sequence[Any]] | dict[str, Any],
    allow_empty: Collection[str] = (),
    allow_infinite: Collection[str] = (),
) -> None:
    """Write columns of equal length as CSV, atomically.

    Args:
        path: Destination.
        columns: Numbers (nine significant digits), whole numbers, truth values (1 and 0) or texts.
        allow_empty: Columns in which NaN is written as an empty cell.
        allow_infinite: Columns in which an infinite value is written as ``inf``.

    Raises:
        ValueError: If the lengths differ, a value is infinite or NaN where it may not be.
    """
    arrays = {name: np.asarray(values) for name, values in columns.items()}
    lengths = {name: len(values) for name, values in arrays.items()}
    if len(set(lengths.values())) > 1:
        raise ValueError(f"{path}: columns of different lengths: {lengths}")
    cells = [
        _cells(path, name, values, name in allow_empty, name in allow_infinite)
        for name, values in arrays.items()
    ]
    rows = [",".join(row) for row in zip(*cells, strict=True)]
    write_text(path, "\n".join([",".join(_quoted(name) for name in arrays), *rows]) + "\n")


def _check_header(
    path: Path, header: list[str], columns: dict[str, ColumnSpec], error: type[LanenetError]
) -> None:
    twice = sorted({name for name in header if name and header.count(name) > 1})
    if twice:
        raise error(f"{path}: line 1: column {twice[0]!r} occurs twice")
    missing = [name for name, spec in columns.items() if spec.required and name not in header]
    if missing:
        raise error(f"{path}: line 1: column {missing[0]!r} is missing; found {', '.join(header)[:200]}")
    absent = [name for name in columns if name not in header]
    for name in header:
        hint = did_you_mean(name, absent, least=0.75) if name not in columns else ""
        if hint:
            raise error(f"{path}: line 1: unknown column {name!r}{hint}")


def _parsed(cell: str, spec: ColumnSpec) -> float | int | str:
    if not cell:
        if not spec.allow_empty or spec.kind == "int":
            raise ValueError("the cell is empty")
        return "" if spec.kind == "text" else math.nan
    if spec.kind == "text":
        return cell
    expected = "a whole number" if spec.kind == "int" else "a number"
    # Python takes "1_000" for a number, which no other tool writes.
    if "_" in cell:
        raise ValueError(f"expected {expected}, found {cell[:40]!r}")
    try:
        value = int(cell) if spec.kind == "int" else float(cell)
    except ValueError:
        raise ValueError(f"expected {expected}, found {cell[:40]!r}") from None
    if not math.isfinite(value) or (spec.kind == "int" and abs(value) > _INT64_MAX):
        raise ValueError(f"expected {expected}, found {cell[:40]!r}")
    if not spec.low <= value <= spec.high:
        raise ValueError(f"expected {spec.low:g} to {spec.high:g}, found {cell[:40]}")
    return value


def _cells(path: Path, name: str, values: np.ndarray, allow_empty: bool, allow_infinite: bool) -> list[str]:
    if values.dtype.kind == "b":
        return ["1" if value else "0" for value in values.tolist()]
    if values.dtype.kind in "iu":
        return [str(value) for value in values.tolist()]
    if values.dtype.kind != "f":
        return [_quoted(str(value)) for value in values.tolist()]
    bad = (np.isnan(values) & (not allow_empty)) | (np.isinf(values) & (not allow_infinite))
    if bad.any():
        row = int(np.flatnonzero(bad)[0])
        raise ValueError(f"{path}: column {name!r}, row {row}: found {values[row]}")
    return [_number(value) for value in values.tolist()]


def _number(value: float) -> str:
    if math.isnan(value):
        return ""
    return f"{value:.9g}" if abs(value) < _SHORT_BELOW else repr(value)


def _quoted(text: str) -> str:
    if any(character in text for character in ',"\r\n'):
        return '"' + text.replace('"', '""') + '"'
    return text


class ParquetTable:
    """A Parquet file in memory, read column by column.

    Attributes:
        path: The file.
        meta: The JSON under :data:`META_KEY`.
    """

    def __init__(
        self, path: Path, group: int | None = None, columns: Callable[[str], bool] | None = None
    ) -> None:
        """Read a file.

        Args:
            path: The file.
            group: One of its row groups; None reads all.
            columns: Tells by its name whether a column is read; None reads all.

        Raises:
            LabelFormatError: If there is no such file, it is not Parquet, or lanenet did not write it.
        """
        self.path = Path(path)
        with _readable(self.path):
            self._table = _bounded_table(self.path, group, columns)
        self.meta = _own_meta(self.path, self._table.schema)

    def __len__(self) -> int:
        return int(self._table.num_rows)

    def floats(self, name: str, allow_null: bool = False) -> Float[np.ndarray, "n"]:
        """Return a column of numbers, float64; null is NaN.

        Raises:
            LabelFormatError: If the column is missing, holds something else, or an infinite value or a null
                where none is allowed; names the file and the column.
        """
        values = self._numpy(name, np.float64)
        bad = (np.isnan(values) & (not allow_null)) | np.isinf(values)
        if bad.any():
            row = int(np.flatnonzero(bad)[0])
            raise LabelFormatError(f"{self.path}: column {name!r}, row {row}: found {values[row]}")
        return values

    def ints(self, name: str) -> Int[np.ndarray, "n"]:
        """Return a column of whole numbers, int64.

        Raises:
            LabelFormatError: If the column is missing, holds something else, or a null.
        """
        if self._column(name).null_count:
            raise LabelFormatError(f"{self.path}: column {name!r} holds empty values")
        return self._numpy(name, np.int64)

    def flags(self, name: str) -> Bool[np.ndarray, "n"]:
        """Return a column of booleans.

        Raises:
            LabelFormatError: If the column is missing, holds something else, or a null.
        """
        values = self._column(name).to_pylist()
        if any(not isinstance(value, bool) for value in values):
            raise LabelFormatError(f"{self.path}: column {name!r}: expected true or false in every row")
        return np.array(values, dtype=bool)

    def texts(self, name: str) -> list[str]:
        """Return a column of texts; null is an empty text.

        Raises:
            LabelFormatError: If the column is missing or holds something else.
        """
        values = self._column(name).to_pylist()
        if any(value is not None and not isinstance(value, str) for value in values):
            raise LabelFormatError(f"{self.path}: column {name!r}: expected texts")
        return [value or "" for value in values]

    def lists(self, name: str, allow_nan: bool = False) -> list[np.ndarray]:
        """Return a column of lists of numbers, one float32 array per row; an empty or null list is empty.

        Raises:
            LabelFormatError: If the column is missing, holds something else, an infinite value, or NaN where
                none is allowed.
        """
        arrow = require("pyarrow", "data")
        result: list[np.ndarray] = []
        for chunk in self._column(name).chunks:
            if not arrow.types.is_list(chunk.type) or not arrow.types.is_floating(chunk.type.value_type):
                raise LabelFormatError(f"{self.path}: column {name!r}: expected lists of numbers")
            values = chunk.flatten().to_numpy(zero_copy_only=False).astype(np.float32, copy=False)
            lengths = chunk.value_lengths().fill_null(0).to_numpy(zero_copy_only=False)
            bad = np.isinf(values) if allow_nan else ~np.isfinite(values)
            if bad.any():
                row = len(result) + int(np.searchsorted(np.cumsum(lengths), np.flatnonzero(bad)[0], "right"))
                raise LabelFormatError(
                    f"{self.path}: column {name!r}, row {row}: found {values[np.flatnonzero(bad)[0]]}"
                )
            result += np.split(values, np.cumsum(lengths)[:-1])[: len(lengths)]
        return result

    def raw(self, name: str) -> Iterator[Any]:
        """Yield a column as plain Python values, one at a time.

        Raises:
            LabelFormatError: If the column is missing.
        """
        for value in self._column(name):
            yield value.as_py()

    def _column(self, name: str) -> Any:
        if name not in self._table.column_names:
            raise LabelFormatError(f"{self.path}: column {name!r} is missing")
        return self._table.column(name)

    def _numpy(self, name: str, dtype: type[np.generic]) -> np.ndarray:
        values = np.asarray(self._column(name).to_numpy())
        if values.dtype.kind not in ("f", "i", "u") or (dtype is np.int64 and values.dtype.kind == "f"):
            # A column without values has no type.
            if values.dtype == object and all(value is None for value in values):
                return np.full(len(values), np.nan).astype(dtype)
            raise LabelFormatError(f"{self.path}: column {name!r}: expected numbers, found {values.dtype}")
        return values.astype(dtype)


@dataclass(frozen=True)
class ParquetFooter:
    """What a Parquet file says about itself; none of its columns is read.

    Attributes:
        meta: The JSON under :data:`META_KEY`.
        group_rows: Rows of each row group.
        group_bytes: What each row group unpacks to, as it is encoded.
        hash: Of the footer and the file's size. The footer holds places, sizes and ranges of all columns of
            all row groups, so that other contents practically always have another hash.
    """

    meta: dict[str, Any]
    group_rows: tuple[int, ...]
    group_bytes: tuple[int, ...]
    hash: str


def read_footer(path: Path) -> ParquetFooter:
    """Read the footer of a Parquet file.

    Raises:
        LabelFormatError: As :class:`ParquetTable`.
    """
    with _readable(path), _open_parquet(path) as file:
        about, schema = file.metadata, file.schema_arrow
        groups = [about.row_group(k) for k in range(about.num_row_groups)]
        rows, sizes = ([getattr(g, name) for g in groups] for name in ("num_rows", "total_byte_size"))
    meta = _own_meta(path, schema)
    with path.open("rb") as raw:
        # The last eight bytes: the footer's length, and the format's name.
        size = raw.seek(-8, os.SEEK_END) + 8
        length = int.from_bytes(raw.read(4), "little")
        raw.seek(max(0, size - 8 - length))
        digest = hashlib.sha256(f"{size} ".encode() + raw.read(length)).hexdigest()[:16]
    return ParquetFooter(meta, tuple(rows), tuple(sizes), digest)


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Refuse what is no file, and raise what pyarrow says about others as an error of their format."""
    arrow = require("pyarrow", "data")
    if not is_regular(path):
        found = "is no file" if path.exists() else "no such file"
        raise LabelFormatError(f"{path}: {found}")
    try:
        yield
    except (arrow.ArrowException, OSError, ValueError, MemoryError) as error:
        raise LabelFormatError(f"{path}: not a readable Parquet file ({first_line(error)})") from error


def _own_meta(path: Path, schema: Any) -> dict[str, Any]:
    """Return what lanenet wrote into a schema."""
    text = (schema.metadata or {}).get(META_KEY)
    if text is None:
        raise LabelFormatError(f"{path}: a Parquet file, but without lanenet's metadata")
    with parsing(f"{path}: lanenet's metadata is not JSON", LabelFormatError):
        meta = json.loads(text)
    if not isinstance(meta, dict):
        raise LabelFormatError(f"{path}: lanenet's metadata is not a JSON object")
    return meta


def _open_parquet(path: Path) -> Any:
    """Open a Parquet file; refuse more rows and columns than a table may have."""
    parquet = require("pyarrow.parquet", "data")
    limits = {"thrift_string_size_limit": _MAX_FOOTER, "thrift_container_size_limit": _MAX_FOOTER}
    file = parquet.ParquetFile(path, page_checksum_verification=True, pre_buffer=False, **limits)
    about = file.metadata
    if about.num_columns > _MAX_COLUMNS or about.num_rows > _MAX_ROWS:
        file.close()
        raise ValueError(
            f"{about.num_rows} rows of {about.num_columns} columns, expected at most {_MAX_ROWS} of "
            f"{_MAX_COLUMNS}"
        )
    return file


def _bounded_table(path: Path, group: int | None, columns: Callable[[str], bool] | None) -> Any:
    """Read a Parquet file, as far as it may be unpacked; a few bytes can stand for any number of rows."""
    arrow = require("pyarrow", "data")
    size = path.stat().st_size
    most = _MAX_UNPACKED + _MAX_RATIO * size
    pool = arrow.default_memory_pool()
    # The memory that a run of one value stands for is asked for at once, whatever the footer says. Arrow's
    # own pool takes a gigabyte of addresses in advance.
    arrow.set_memory_pool(arrow.system_memory_pool())
    try:
        with memory_limit(most), _open_parquet(path) as file:
            table = _whole_table(file, group, columns, size, most)
    except MemoryError:
        raise ValueError(f"{size / MEBIBYTE:.1f} MB stand for more than {most / MEBIBYTE:.0f} MB") from None
    finally:
        arrow.set_memory_pool(pool)
    return table


def _whole_table(
    file: Any, group: int | None, columns: Callable[[str], bool] | None, size: int, most: int
) -> Any:
    """Read row groups of an open file, unless it says itself that they are too large."""
    arrow = require("pyarrow", "data")
    about = file.metadata
    groups = list(range(about.num_row_groups)) if group is None else [group]
    names = None if columns is None else [name for name in file.schema_arrow.names if columns(name)]
    # Not by the columns: pyarrow 26 ends the process when a column's statistics are damaged.
    unpacked = sum(about.row_group(number).total_byte_size for number in groups)
    if unpacked <= most:
        table = file.read_row_groups(groups, columns=names, use_threads=False)
        table.validate(full=True)
        for k, field in enumerate(table.schema):
            if arrow.types.is_dictionary(field.type):
                # Holds each text once, however many rows have it.
                table = table.set_column(k, field.name, table.column(k).cast(field.type.value_type))
        unpacked = table.nbytes
    if unpacked > most:
        raise ValueError(
            f"{size / MEBIBYTE:.1f} MB stand for {unpacked / MEBIBYTE:.0f} MB, expected at most "
            f"{most / MEBIBYTE:.0f} MB"
        )
    return table


def write_parquet(
    path: Path,
    arrays: dict[str, Any],
    meta: dict[str, Any],
    more_meta: dict[bytes, bytes] | None = None,
    group_rows: int | None = None,
) -> None:
    """Write columns as Parquet, atomically.

    Args:
        path: Destination.
        arrays: pyarrow arrays of equal length by column name.
        meta: What the table is, stored as JSON under :data:`META_KEY`.
        more_meta: Further schema metadata, for other tools.
        group_rows: Rows that can be read without the others; None takes pyarrow's million.
    """
    arrow = require("pyarrow", "data")
    parquet = require("pyarrow.parquet", "data")
    table = arrow.table(arrays)
    table = table.replace_schema_metadata({META_KEY: json.dumps(meta).encode(), **(more_meta or {})})
    with atomic_file(path) as temporary:
        parquet.write_table(
            table, temporary, compression="zstd", write_page_checksum=True, row_group_size=group_rows
        )


def write_columns(path: Path, columns: dict[str, np.ndarray], meta: dict[str, Any]) -> None:
    """Write arrays of equal length as Parquet, atomically, each in its own type."""
    arrow = require("pyarrow", "data")
    write_parquet(path, {name: arrow.array(values) for name, values in columns.items()}, meta)


def float_array(values: Float[np.ndarray, "n"]) -> Any:
    """Return a pyarrow column of float64 in which NaN is null."""
    arrow = require("pyarrow", "data")
    numbers = np.ascontiguousarray(values, dtype=np.float64)
    return arrow.array(numbers, type=arrow.float64(), mask=np.isnan(numbers))


def list_array(values: list[np.ndarray]) -> Any:
    """Return a pyarrow column of lists of float32; NaN inside a list stays NaN."""
    arrow = require("pyarrow", "data")
    offsets = np.concatenate([[0], np.cumsum([len(value) for value in values])]).astype(np.int32)
    flat = np.concatenate([np.empty(0), *values]).astype(np.float32)
    return arrow.ListArray.from_arrays(arrow.array(offsets), arrow.array(flat, from_pandas=False))


def png_bytes(image: UInt8[np.ndarray, "h w *c"]) -> bytes:
    """Encode an image as PNG; the same image always gives the same bytes."""
    _, data = cv2.imencode(".png", image)
    return bytes(data.tobytes())


TUM_HEADER = "# t_s x_m y_m z_m qx qy qz qw\n"
_CM_PER_M = 100.0


def tum_from_poses(
    t_s: Float[np.ndarray, "n"], poses_cm: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 8"]:
    """Convert poses to rows of a TUM file.

    Args:
        t_s: Times.
        poses_cm: x, y and heading, [cm], [cm], [rad], frame map.

    Returns:
        t, x, y, z, qx, qy, qz, qw; [s], [m].
    """
    zeros = np.zeros(len(t_s))
    half = 0.5 * poses_cm[:, 2]
    x_m, y_m = poses_cm[:, 0] / _CM_PER_M, poses_cm[:, 1] / _CM_PER_M
    return np.stack([t_s, x_m, y_m, zeros, zeros, zeros, np.sin(half), np.cos(half)], axis=1)


def write_tum(path: Path, t_s: Float[np.ndarray, "n"], poses_cm: Float[np.ndarray, "n 3"]) -> None:
    """Write a trajectory, atomically; poses as for :func:`tum_from_poses`.

    Raises:
        MapFormatError: If a value is not finite.
    """
    rows = tum_from_poses(t_s, poses_cm)
    bad = ~np.isfinite(rows).all(axis=1)
    if bad.any():
        raise MapFormatError(f"{path}: the pose of row {int(np.flatnonzero(bad)[0])} is not finite")
    write_text(path, "".join([TUM_HEADER, *tum_lines(t_s, poses_cm)]))


def tum_lines(t_s: Float[np.ndarray, "n"], poses_cm: Float[np.ndarray, "n 3"]) -> list[str]:
    """Return the lines of a TUM file below :data:`TUM_HEADER`; finite poses as for :func:`tum_from_poses`."""
    rows = tum_from_poses(t_s, poses_cm).tolist()
    return [f"{row[0]:.6f} " + " ".join(f"{value:.9f}" for value in row[1:]) + "\n" for row in rows]
