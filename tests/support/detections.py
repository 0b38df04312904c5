"""Reads tables of detections as any other tool would."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyarrow.csv
import pyarrow.parquet

from lanenet.data.detections import PARABOLA_NAMES, SIGMA_NAMES
from lanenet.geometry.lane import POINT_NAMES


def read_detections(path: Path) -> SimpleNamespace:
    """Columns as arrays; points, sigmas and parabolas together; NaN for empty cells and missing columns."""
    read = pyarrow.csv.read_csv if path.suffix.lower() == ".csv" else pyarrow.parquet.read_table
    table = read(path)

    def column(name: str) -> np.ndarray:
        if name not in table.column_names:
            return np.full(table.num_rows, np.nan)
        return np.array([np.nan if value is None else value for value in table[name].to_pylist()], float)

    def together(names: tuple[str, ...]) -> np.ndarray:
        return np.stack([column(name) for name in names], axis=1)

    names = ("t_s", "steering_rad", "confidence", "radius_cm", "offset_cm")
    return SimpleNamespace(
        frame=column("frame").astype(int),
        points_cm=together(POINT_NAMES),
        sigma_cm=together(SIGMA_NAMES),
        parabolas=together(PARABOLA_NAMES).reshape(-1, 2, 3),
        **{name: column(name) for name in names},
    )
