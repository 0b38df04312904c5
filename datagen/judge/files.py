"""Finished runs on disk: a JSON file with the result, and a CSV file with the trajectory."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from datagen.judge.run import RunResult, Trajectory
from lanenet.data.files import write_json
from lanenet.data.tables import ColumnSpec, read_csv, write_csv

_NUMBERS = ("t_s", "x_cm", "y_cm", "s_cm", "offset_cm", "steering_rad")
_FLAGS = ("answered", "over", "put_back")


def write_run(path: Path, key: str, result: RunResult, trajectory: Trajectory) -> None:
    """Write a finished run.

    Args:
        path: The JSON file; the trajectory lies beside it.
        key: Stands for all that the run depends on.
        result: The run.
        trajectory: The run frame by frame.
    """
    columns: dict[str, Any] = {"t_s": trajectory.t_s}
    columns |= {"x_cm": trajectory.xy_cm[:, 0], "y_cm": trajectory.xy_cm[:, 1]}
    columns |= {name: getattr(trajectory, name) for name in (*_NUMBERS[3:], *_FLAGS)}
    write_csv(path.with_suffix(".csv"), columns)
    # Last: a run without it is driven again.
    write_json(path, {"key": key, **asdict(result)})


def read_run(path: Path, key: str) -> RunResult | None:
    """Read a finished run; None if there is none, or it was driven under other settings."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        if data.pop("key") != key or not path.with_suffix(".csv").is_file():
            return None
        return RunResult(**data)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):  # not there, or not what was written
        return None


def read_trajectory(path: Path) -> Trajectory:
    """Read the trajectory beside a run's JSON file.

    Raises:
        DriveFormatError: If it cannot be read.
    """
    specs = {name: ColumnSpec() for name in _NUMBERS} | {name: ColumnSpec("int") for name in _FLAGS}
    columns = read_csv(path.with_suffix(".csv"), specs)
    return Trajectory(
        xy_cm=np.stack([columns["x_cm"], columns["y_cm"]], axis=1),
        **{name: columns[name] for name in ("t_s", "s_cm", "offset_cm", "steering_rad")},
        **{name: columns[name] == 1 for name in _FLAGS},
    )
