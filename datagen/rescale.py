"""Another lane width for a finished map: images show a map up to its scale, so nothing is solved again.

Poses, lines, edge points and the camera's place scale with the lane. What is judged in centimetres (which
points are in the window, the verdict, the camera's height) is judged anew by :mod:`datagen.check`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from datagen.assemble import AssembledMap
from datagen.lanes.scale import LaneWidth
from datagen.prepare import PreparedDrive
from lanenet.config import read_yaml
from lanenet.data.maps.folder import read_map
from lanenet.data.tables import ParquetTable
from lanenet.errors import LanenetError, MapFormatError
from lanenet.reading import parsing, read_json

#: What the figures have that were found on the way to the map, and are not found again.
_KEPT_FIGURES = ("segments", "calibration")
_EDGE_FLOATS = ("x_cm", "y_cm", "normal_x", "normal_y")


@dataclass(frozen=True)
class Solved:
    """A map before it is checked.

    Attributes:
        assembled: The map.
        figures: For the report, found on the way to it.
        how_calibrated: How the camera was found.
        notes: What was found on the way, a sentence each.
        said: How the map was made, if not from the drive; empty otherwise.
    """

    assembled: AssembledMap
    figures: dict[str, Any]
    how_calibrated: str
    notes: tuple[str, ...]
    said: str = ""


def rescaled(folder: Path, prepared: PreparedDrive) -> Solved | None:
    """Return a finished map in the scale that another lane width gives.

    Args:
        folder: A map of the same drive with the same settings, whose scale comes from its lane width.
        prepared: The drive, with the new lane width.

    Returns:
        None if a file of the map cannot be read, it is not of these frames, or half of its lane may be one,
        which the earlier width made too small for a camera or for tape.
    """
    try:
        earlier, report = _read(folder, prepared)
    except LanenetError:  # it is made anew
        return None
    if earlier is None:
        return None
    width_cm = earlier.drive_map.meta.lane_width_cm
    factor, sizes = prepared.request.lane_width_cm / width_cm, prepared.settings.verdict
    height_cm, tape_cm = earlier.drive_map.camera.mounting.height_cm, earlier.drive_map.meta.tape_cm
    # As find_lane_width has it: of half the lane, camera and tape would be twice as large.
    was, now = (
        2.0 * share * height_cm > sizes.height_cm[1] or 2.0 * share * tape_cm > sizes.tape_cm[1]
        for share in (1.0, factor)
    )
    if was and not now:
        return None
    figures = {name: report[name] for name in _KEPT_FIGURES if name in report}
    sigma = figures.get("calibration", {}).get("sigma", {})
    said = (
        f"the finished map of a lane of {width_cm:g} cm was rescaled to "
        f"{prepared.request.lane_width_cm:g} cm (all lengths x {factor:.4g}) and judged anew; nothing was "
        "mapped again"
    )
    how = str(read_yaml(folder / "camera.yaml").get("method", ""))
    return Solved(earlier.scaled(factor, sigma), figures, how, tuple(report["found_notes"]), said)


def _read(folder: Path, prepared: PreparedDrive) -> tuple[AssembledMap | None, dict[str, Any]]:
    """Read what was assembled, and the report; None for the map if it is not of these frames."""
    drive_map, path = read_map(folder), folder / "report.json"
    report = read_json(path, MapFormatError)
    frames = prepared.drive.frames
    rows = np.minimum(np.searchsorted(frames, drive_map.frames), len(frames) - 1)
    if not np.array_equal(frames[rows], drive_map.frames):
        return None, report
    # Lines that were withheld are looked at again, and so is each frame.
    unmarked = replace(
        drive_map.without_doubts(),
        meta=drive_map.meta.model_copy(update={"verdict": None, "state": None}),
        held_out=prepared.held_out[rows],
        marks=tuple(prepared.marks[row] for row in rows.tolist()),
    )
    table = ParquetTable(folder / "edges.parquet")
    edges = {name: table.ints(name) for name in ("frame", "segment")}
    edges |= {name: table.floats(name).astype(np.float32) for name in _EDGE_FLOATS}
    with parsing(str(path), MapFormatError):
        width = report["lane_width"]
        opened = None if width["open_cm"] is None else (width["open_cm"][0], width["open_cm"][1])
        lane = LaneWidth(width["width_cm"], width["bend_cm"], opened)
        segments, report["found_notes"] = report["segments_mapped"], list(report["found_notes"])
    return AssembledMap(unmarked, rows, lane, edges, _open_poses(folder / "open_loop.tum"), segments), report


def _open_poses(file: Path) -> Float[np.ndarray, "n 3"]:
    """Read the poses that were written before loops were closed; they are only drawn."""
    with parsing(str(file), MapFormatError):
        rows = np.loadtxt(file, ndmin=2)
        heading = np.unwrap(2.0 * np.arctan2(rows[:, 6], rows[:, 7]))
    return np.column_stack([100.0 * rows[:, 1:3], heading])
