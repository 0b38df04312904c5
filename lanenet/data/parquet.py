"""Parquet tables: columns in and out of NumPy, with errors that name file and column; images as PNG bytes.

pyarrow comes with the extra ``data`` and is imported inside the functions: the car does not have it.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from lanenet.data.files import atomic_file, require
from lanenet.errors import LabelFormatError

#: Key of the schema metadata that holds what the table is, as JSON.
META_KEY = b"lanenet"


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
