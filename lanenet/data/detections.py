"""Tables of detections: what a detector saw in each frame, as Parquet or CSV by the file's ending."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lanenet.data.files import check_destination, require
from lanenet.data.tables import VERSION_NAME, float_array, write_csv, write_parquet
from lanenet.errors import LabelFormatError
from lanenet.geometry.lane import POINT_NAMES, SIDES
from lanenet.perception.estimate import LaneEstimate
from lanenet.perception.image_lane import LINE_PX_NAMES

FORMAT_VERSION = 1
FORMAT = f"lanenet-detections/{FORMAT_VERSION}"

SIGMA_NAMES: tuple[str, ...] = tuple(f"{name.removesuffix('_cm')}_sigma_cm" for name in POINT_NAMES)
PARABOLA_NAMES: tuple[str, ...] = tuple(f"{side}_{letter}" for side in SIDES for letter in "abc")
#: Written only by detectors that measure them.
LANE_NAMES: tuple[str, ...] = ("radius_cm", "offset_cm", "own_lane")
#: Why points of a frame, or all, are not answered; written only by detectors that say so.
REASON_NAME = "reason"
#: Written only by detectors that work on lines of the image, then in every row; empty for a missing line.
IMAGE_LINE_NAMES: tuple[str, ...] = tuple(f"{side}_{name}" for side in SIDES for name in LINE_PX_NAMES)
#: Columns with empty cells where a detector does not know the value.
_OPEN_COLUMNS = ("t_s", *POINT_NAMES, *SIGMA_NAMES, *PARABOLA_NAMES, "steering_rad")
#: A straight lane has an infinite radius.
_INFINITE_COLUMNS = ("radius_cm",)


class DetectionTable:
    """Collects estimates frame by frame and writes them as one table."""

    def __init__(self) -> None:
        self._frames: list[int] = []
        self._rows: list[np.ndarray] = []
        self._reasons: list[str] = []
        self._has_image_lines = False

    def __len__(self) -> int:
        return len(self._frames)

    def add(self, frame: int, t_s: float, estimate: LaneEstimate) -> None:
        """Append the estimate of one frame; ``t_s`` is NaN if there is no time."""
        self._frames.append(int(frame))
        self._reasons.append(estimate.reason)
        lines_px = estimate.lines_px
        self._has_image_lines |= lines_px is not None
        self._rows.append(
            np.concatenate(
                [
                    [t_s],
                    estimate.points_cm,
                    estimate.sigma_cm,
                    estimate.parabolas.ravel(),
                    [estimate.steering_rad, estimate.confidence],
                    [estimate.radius_cm, estimate.offset_cm, estimate.own_lane],
                    np.full(len(IMAGE_LINE_NAMES), np.nan) if lines_px is None else lines_px.ravel(),
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
        names = (*_OPEN_COLUMNS, "confidence", *LANE_NAMES, *IMAGE_LINE_NAMES)
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
        unknown = [name for name in LANE_NAMES if np.isnan(columns[name]).all()]
        unknown += [] if self._has_image_lines else IMAGE_LINE_NAMES
        columns = {name: values for name, values in columns.items() if name not in unknown}
        frame = np.array(self._frames, dtype=np.int64)
        reasons = {REASON_NAME: self._reasons} if any(self._reasons) else {}
        if ending == ".csv":
            write_csv(
                path,
                {"frame": frame, **columns, **reasons, VERSION_NAME: np.full(len(frame), FORMAT_VERSION)},
                allow_empty=(*_OPEN_COLUMNS, *LANE_NAMES, *IMAGE_LINE_NAMES),
                allow_infinite=_INFINITE_COLUMNS,
            )
            return
        arrow = require("pyarrow", "data")
        arrays: dict[str, Any] = {"frame": arrow.array(frame)}
        arrays |= {name: float_array(values) for name, values in columns.items()}
        arrays |= {name: arrow.array(texts) for name, texts in reasons.items()}
        units = {
            "_cm": "centimetre",
            "_rad": "radian",
            "_s": "second",
            "a": "1/cm",
            "b": "1",
            "c": "centimetre",
            "_u_px": "pixel",
            "_v_px": "pixel",
            "_a_px": "1/pixel^2",
            "_b_px": "1/pixel",
            "_c_px": "1",
            "_d_px": "pixel",
        }
        write_parquet(path, arrays, {"format": FORMAT, "units": units})


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
