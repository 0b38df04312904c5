"""The road of a synthetic drive on disk: ``track.json``, the truth that a map is compared with."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from datagen.world.road.track import Marking, Track
from lanenet.data.files import write_json
from lanenet.errors import DriveFormatError

FORMAT = "lanenet-track/2"
_COLUMNS = ("s_cm", "xy_cm", "heading_rad", "curvature_per_cm")


def write_track(path: Path, track: Track) -> None:
    """Write a track; lengths in cm, angles in rad, frame map."""
    data = {
        "format": FORMAT,
        "closed": track.closed,
        "lane_width_cm": track.lane_width_cm,
        "oncoming_cm": track.oncoming_cm,
        **{name: getattr(track, name) for name in _COLUMNS},
        "markings": [vars(marking) for marking in track.markings],
        "boxes": track.boxes,
    }
    write_json(path, data)


def read_track(path: Path) -> Track:
    """Read a track.

    Raises:
        DriveFormatError: If the file is missing, is not a track of this version, or its columns do not fit.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise DriveFormatError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise DriveFormatError(f"{path}: not valid JSON ({error})") from None
    found = data.get("format") if isinstance(data, dict) else type(data).__name__
    if found != FORMAT:
        raise DriveFormatError(f"{path}: expected format {FORMAT!r}, found {found!r}")
    try:
        columns: dict[str, Any] = {name: np.asarray(data[name], dtype=np.float64) for name in _COLUMNS}
        columns["xy_cm"] = columns["xy_cm"].reshape(-1, 2)
        markings = tuple(
            Marking(
                float(m["offset_cm"]),
                float(m["width_cm"]),
                (float(m["colour_bgr"][0]), float(m["colour_bgr"][1]), float(m["colour_bgr"][2])),
                np.asarray(m["painted_cm"], dtype=np.float64).reshape(-1, 2),
            )
            for m in data["markings"]
        )
        boxes = np.asarray(data["boxes"], dtype=np.float64).reshape(-1, 9)
        oncoming_cm = None if data["oncoming_cm"] is None else float(data["oncoming_cm"])
        closed, lane_width_cm = bool(data["closed"]), float(data["lane_width_cm"])
    except KeyError as error:
        raise DriveFormatError(f"{path}: key {error} is missing") from None
    except (TypeError, ValueError, IndexError) as error:
        raise DriveFormatError(f"{path}: not the numbers of a track ({error})") from None
    lengths = [len(column) if column.ndim else 0 for column in columns.values()]
    if min(lengths) < 2 or len(set(lengths)) > 1:
        raise DriveFormatError(
            f"{path}: expected {', '.join(_COLUMNS)} of one length of at least 2, "
            f"found {', '.join(map(str, lengths))}"
        )
    if not all(np.isfinite(column).all() for column in (*columns.values(), boxes)):
        raise DriveFormatError(f"{path}: a number of the centre line or of a box is missing or not finite")
    rest: dict[str, Any] = {"closed": closed, "lane_width_cm": lane_width_cm, "oncoming_cm": oncoming_cm}
    return Track(**columns, markings=markings, boxes=boxes, **rest)
