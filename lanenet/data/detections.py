"""Tables of detections: what a detector saw in each frame, as Parquet or CSV by the file's ending."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from lanenet.data.files import check_destination, require
from lanenet.data.parquet import ParquetTable, float_array, write_parquet
from lanenet.data.tables import ColumnSpec, read_csv, write_csv
from lanenet.errors import LabelFormatError
from lanenet.geometry.lane import POINT_NAMES, SIDES
from lanenet.perception.estimate import LaneEstimate

FORMAT_VERSION = 1
FORMAT = f"lanenet-detections/{FORMAT_VERSION}"
#: Column of a CSV, which has no other place for it.
VERSION_NAME = "format_version"

SIGMA_NAMES: tuple[str, ...] = tuple(f"{name.removesuffix('_cm')}_sigma_cm" for name in POINT_NAMES)
PARABOLA_NAMES: tuple[str, ...] = tuple(f"{side}_{letter}" for side in SIDES for letter in "abc")
#: Written only by detectors that measure them.
LANE_NAMES: tuple[str, ...] = ("radius_cm", "offset_cm")
#: Columns with empty cells where a detector does not know the value.
_OPEN_COLUMNS = ("t_s", *POINT_NAMES, *SIGMA_NAMES, *PARABOLA_NAMES, "steering_rad")
#: A straight lane has an infinite radius.
_INFINITE_COLUMNS = ("radius_cm",)


@dataclass(frozen=True, eq=False)
class Detections:
    """A table of detections, a row per frame; NaN where the detector did not know.

    Attributes:
        frame: Frame number.
        t_s: Time of the frame; NaN for photos.
        points_cm: Six points in the order of the label contract, frame car.
        sigma_cm: Standard deviation of each point.
        parabolas: (a, b, c) of the left and the right line, x and y in cm.
        steering_rad: Steering target, positive left.
        confidence: 0 to 1.
        radius_cm: Radius of curvature of the lane's middle, infinite where straight; all NaN if the table
            has no such column.
        offset_cm: Distance of the car right of the lane's middle; as above.
    """

    frame: Int[np.ndarray, "n"]
    t_s: Float[np.ndarray, "n"]
    points_cm: Float[np.ndarray, "n 6"]
    sigma_cm: Float[np.ndarray, "n 6"]
    parabolas: Float[np.ndarray, "n 2 3"]
    steering_rad: Float[np.ndarray, "n"]
    confidence: Float[np.ndarray, "n"]
    radius_cm: Float[np.ndarray, "n"]
    offset_cm: Float[np.ndarray, "n"]

    def __len__(self) -> int:
        return len(self.frame)


class DetectionTable:
    """Collects estimates frame by frame and writes them as one table."""

    def __init__(self) -> None:
        self._frames: list[int] = []
        self._rows: list[np.ndarray] = []

    def __len__(self) -> int:
        return len(self._frames)

    def add(self, frame: int, t_s: float, estimate: LaneEstimate) -> None:
        """Append the estimate of one frame; ``t_s`` is NaN if there is no time."""
        self._frames.append(int(frame))
        self._rows.append(
            np.concatenate(
                [
                    [t_s],
                    estimate.points_cm,
                    estimate.sigma_cm,
                    estimate.parabolas.ravel(),
                    [estimate.steering_rad, estimate.confidence, estimate.radius_cm, estimate.offset_cm],
                ]
            )
        )

    def write(self, path: Path) -> None:
        """Write the table, atomically: Parquet for ``.parquet``, CSV for ``.csv``.

        Raises:
            LabelFormatError: If the file has another ending, or a value is infinite.
            MissingExtraError: If pyarrow is not installed and the table is Parquet.
        """
        ending = _ending(path)
        names = (*_OPEN_COLUMNS, "confidence", *LANE_NAMES)
        rows = np.array(self._rows, dtype=np.float64).reshape(-1, len(names))
        columns = {name: rows[:, k] for k, name in enumerate(names)}
        for name, values in columns.items():
            bad = np.isinf(values) & (name not in _INFINITE_COLUMNS)
            bad |= np.isnan(values) & (name == "confidence")
            # Not even a radius is minus infinity.
            bad |= np.isneginf(values)
            if bad.any():
                row = int(np.flatnonzero(bad)[0])
                value = "NaN" if np.isnan(values[row]) else str(values[row])
                raise LabelFormatError(f"{path}: frame {self._frames[row]}, column {name!r}: found {value}")
        if all(np.isnan(columns[name]).all() for name in LANE_NAMES):
            columns = {name: values for name, values in columns.items() if name not in LANE_NAMES}
        frame = np.array(self._frames, dtype=np.int64)
        if ending == ".csv":
            write_csv(
                path,
                {"frame": frame, **columns, VERSION_NAME: np.full(len(frame), FORMAT_VERSION)},
                allow_empty=(*_OPEN_COLUMNS, *LANE_NAMES),
                allow_infinite=_INFINITE_COLUMNS,
            )
            return
        arrow = require("pyarrow", "data")
        arrays: dict[str, Any] = {"frame": arrow.array(frame)}
        arrays |= {name: float_array(values) for name, values in columns.items()}
        units = {
            "_cm": "centimetre",
            "_rad": "radian",
            "_s": "second",
            "a": "1/cm",
            "b": "1",
            "c": "centimetre",
        }
        write_parquet(path, arrays, {"format": FORMAT, "units": units})


def read_detections(path: Path) -> Detections:
    """Read a table of detections, Parquet or CSV by the file's ending.

    Raises:
        LabelFormatError: If the file is missing, of another kind or version, lacks a column, or holds
            something that is not a number; names file and column.
        MissingExtraError: If pyarrow is not installed and the table is Parquet.
    """
    if _ending(path) == ".csv":
        specs = {"frame": ColumnSpec("int"), "confidence": ColumnSpec()}
        specs |= {name: ColumnSpec(allow_empty=True) for name in _OPEN_COLUMNS}
        specs |= {
            name: ColumnSpec(required=False, allow_empty=True, allow_infinite=name in _INFINITE_COLUMNS)
            for name in LANE_NAMES
        }
        specs[VERSION_NAME] = ColumnSpec("int")
        columns = read_csv(path, specs, LabelFormatError)
        others = set(columns.pop(VERSION_NAME).tolist()) - {FORMAT_VERSION}
        if others:
            raise LabelFormatError(
                f"{path}: column {VERSION_NAME!r}: found {min(others)}, expected {FORMAT_VERSION}"
            )
    else:
        table = ParquetTable(path)
        if table.meta.get("format") != FORMAT:
            raise LabelFormatError(f"{path}: expected format {FORMAT!r}, found {table.meta.get('format')!r}")
        columns = {"frame": table.ints("frame"), "confidence": table.floats("confidence")}
        columns |= {name: table.floats(name, allow_null=True) for name in _OPEN_COLUMNS}
        columns |= {
            name: table.floats(name, allow_null=True, allow_infinite=name in _INFINITE_COLUMNS)
            for name in LANE_NAMES
            if name in table.column_names
        }
    unknown = np.full(len(columns["frame"]), np.nan)
    columns |= {name: unknown for name in LANE_NAMES if name not in columns}

    def together(names: tuple[str, ...]) -> np.ndarray:
        return np.stack([columns[name] for name in names], axis=1)

    return Detections(
        frame=columns["frame"],
        t_s=columns["t_s"],
        points_cm=together(POINT_NAMES),
        sigma_cm=together(SIGMA_NAMES),
        parabolas=together(PARABOLA_NAMES).reshape(-1, len(SIDES), 3),
        steering_rad=columns["steering_rad"],
        confidence=columns["confidence"],
        radius_cm=columns["radius_cm"],
        offset_cm=columns["offset_cm"],
    )


def check_table_path(path: Path) -> None:
    """Refuse a table that could not be written at the end of a run.

    Raises:
        LabelFormatError: If the ending is unknown.
        MissingExtraError: If the ending is ``.parquet`` and pyarrow is not installed.
        LanenetError: If there is a folder of that name, or the file's folder cannot be written to.
    """
    if _ending(path) == ".parquet":
        require("pyarrow", "data")
    check_destination(path)


def _ending(path: Path) -> str:
    ending = Path(path).suffix.lower()
    if ending not in (".parquet", ".csv"):
        raise LabelFormatError(
            f"{path}: expected a file ending in .parquet or .csv, found {ending or 'none'!r}"
        )
    return ending
