"""CSV tables, read strictly: an error names the file, the line and the column."""

from __future__ import annotations

import csv
import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from lanenet.data.files import write_text
from lanenet.errors import DriveFormatError, LanenetError, did_you_mean

_INT64_MAX = 2**63 - 1
#: Numbers above this are written in full: nine digits would lose the microseconds of Unix time.
_SHORT_BELOW = 1e6


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
