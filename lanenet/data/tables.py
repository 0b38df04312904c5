"""Tables as files: CSV, Parquet, and trajectories in the TUM format.

Reading is strict: an error names the file, the line or row, and the column. pyarrow comes with the extra
``data`` and is imported inside the functions: the car does not have it.
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from lanenet.data.files import atomic_file, require, write_text
from lanenet.errors import DriveFormatError, LabelFormatError, LanenetError, MapFormatError, did_you_mean

_INT64_MAX = 2**63 - 1
#: Numbers above this are written in full: nine digits would lose the microseconds of Unix time.
_SHORT_BELOW = 1e6
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
        An array per column that the file has: float64, int64 or text. Row i is line i + 2 of a file without
        quoted line breaks.

    Raises:
        LanenetError: Of the type ``error``, if the file is missing or not text, the header lacks a column or
            names one twice, a line has more or fewer fields, or a cell is empty, not a number, NaN, infinite,
            out of range or out of order; names the file, the line and the column.
    """
    try:
        with Path(path).open(encoding="utf-8-sig", newline="") as stream:
            lines = list(_lines(csv.reader(stream, strict=True)))
    except FileNotFoundError:
        raise error(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError, csv.Error) as problem:
        raise error(f"{path}: cannot be read as CSV ({problem})") from None
    if not lines:
        raise error(f"{path}: empty, expected a header with {', '.join(columns)}")
    if skip_torn and is_torn(path):
        lines.pop()
    header = lines[0][1]
    _check_header(path, header, columns, error)
    for number, cells in lines[1:]:
        if len(cells) != len(header):
            raise error(f"{path}: line {number}: expected {len(header)} fields, found {len(cells)}")
    result: dict[str, np.ndarray] = {}
    for k, name in enumerate(header):
        if name not in columns:
            continue
        spec = columns[name]
        values: list[Any] = []
        for number, cells in lines[1:]:
            try:
                value = _parsed(cells[k], spec)
                if spec.increasing and values and not value > values[-1]:
                    raise ValueError(f"expected more than {values[-1]} of the row before, found {value}")
                values.append(value)
            except ValueError as problem:
                raise error(f"{path}: line {number}, column {name!r}: {problem}") from None
        result[name] = np.array(
            values, dtype={"float": np.float64, "int": np.int64, "text": np.str_}[spec.kind]
        )
    return result


def is_torn(path: Path) -> bool:
    """Tell whether the last line of a table was cut off while it was written, as by a power cut.

    Such a line has no line feed, and lacks fields or the text of the last field. A complete last line without
    a line feed, as some editors leave it, is not torn.
    """
    head, _, rest = Path(path).read_bytes().partition(b"\n")
    last = rest.rpartition(b"\n")[2]
    return bool(last.strip()) and (last.count(b",") < head.count(b",") or last.endswith(b","))


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


def _lines(reader: Any) -> Iterator[tuple[int, list[str]]]:
    """Yield line number and stripped cells of every line that is not blank."""
    for cells in reader:
        stripped = [cell.strip() for cell in cells]
        if any(stripped):
            yield reader.line_num, stripped


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

    def __init__(self, path: Path) -> None:
        """Read a file.

        Raises:
            LabelFormatError: If there is no such file, it is not Parquet, or lanenet did not write it.
        """
        parquet = require("pyarrow.parquet", "data")
        arrow = require("pyarrow", "data")
        self.path = Path(path)
        if not self.path.is_file():
            raise LabelFormatError(f"{path}: no such file")
        try:
            self._table = parquet.read_table(self.path, partitioning=None)
        except (arrow.ArrowException, OSError, ValueError) as error:
            raise LabelFormatError(f"{path}: not a readable Parquet file ({_first_line(error)})") from None
        text = (self._table.schema.metadata or {}).get(META_KEY)
        if text is None:
            raise LabelFormatError(f"{path}: a Parquet file, but without lanenet's metadata")
        try:
            meta = json.loads(text)
        except ValueError:
            meta = None
        if not isinstance(meta, dict):
            raise LabelFormatError(f"{path}: lanenet's metadata is not a JSON object")
        self.meta: dict[str, Any] = meta

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
            values = chunk.flatten().to_numpy(zero_copy_only=False).astype(np.float32)
            lengths = chunk.value_lengths().fill_null(0).to_numpy(zero_copy_only=False)
            bad = np.isinf(values) if allow_nan else ~np.isfinite(values)
            if bad.any():
                row = len(result) + int(np.searchsorted(np.cumsum(lengths), np.flatnonzero(bad)[0], "right"))
                raise LabelFormatError(
                    f"{self.path}: column {name!r}, row {row}: found {values[np.flatnonzero(bad)[0]]}"
                )
            result += np.split(values, np.cumsum(lengths)[:-1])[: len(lengths)]
        return result

    def raw(self, name: str) -> list[Any]:
        """Return a column as plain Python values.

        Raises:
            LabelFormatError: If the column is missing.
        """
        values: list[Any] = self._column(name).to_pylist()
        return values

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


def write_parquet(
    path: Path, arrays: dict[str, Any], meta: dict[str, Any], more_meta: dict[bytes, bytes] | None = None
) -> None:
    """Write columns as Parquet, atomically.

    Args:
        path: Destination.
        arrays: pyarrow arrays of equal length by column name.
        meta: What the table is, stored as JSON under :data:`META_KEY`.
        more_meta: Further schema metadata, for other tools.
    """
    arrow = require("pyarrow", "data")
    parquet = require("pyarrow.parquet", "data")
    table = arrow.table(arrays)
    table = table.replace_schema_metadata({META_KEY: json.dumps(meta).encode(), **(more_meta or {})})
    with atomic_file(path) as temporary:
        parquet.write_table(table, temporary, compression="zstd")


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


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:200]


def png_bytes(image: UInt8[np.ndarray, "h w *c"]) -> bytes:
    """Encode an image as PNG; the same image always gives the same bytes."""
    _, data = cv2.imencode(".png", image)
    return bytes(data.tobytes())


def png_size(data: bytes) -> tuple[int, int] | None:
    """Read width and height from the header of a PNG; None if it is not one."""
    if len(data) < 24 or data[:8] != b"\x89PNG\r\n\x1a\n":
        return None
    return int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")


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
