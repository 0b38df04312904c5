"""The road of a synthetic drive on disk: ``track.json``, the truth that a map is compared with."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from datagen.world.road.track import Marking, Track
from lanenet.data.files import write_json
from lanenet.errors import DriveFormatError

FORMAT = "lanenet-track/2"
_OLDER = "lanenet-track/1"  # without boxes and oncoming lane


def write_track(path: Path, track: Track) -> None:
    """Write a track; lengths in cm, angles in rad, frame map."""
    data = {
        "format": FORMAT,
        "closed": track.closed,
        "lane_width_cm": track.lane_width_cm,
        "oncoming_cm": track.oncoming_cm,
        "s_cm": track.s_cm,
        "xy_cm": track.xy_cm,
        "heading_rad": track.heading_rad,
        "curvature_per_cm": track.curvature_per_cm,
        "markings": [
            {
                "offset_cm": marking.offset_cm,
                "width_cm": marking.width_cm,
                "colour_bgr": marking.colour_bgr,
                "painted_cm": marking.painted_cm,
            }
            for marking in track.markings
        ],
        "boxes": track.boxes,
    }
    write_json(path, data)


def read_track(path: Path) -> Track:
    """Read a track, of this version of the format or the one before.

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
    if found not in (FORMAT, _OLDER):
        raise DriveFormatError(f"{path}: expected format {FORMAT!r} or {_OLDER!r}, found {found!r}")
    if found == _OLDER:
        data = {**data, "boxes": [], "oncoming_cm": None}
    try:
        s_cm, heading_rad, curvature_per_cm = (
            np.asarray(data[name], dtype=np.float64) for name in ("s_cm", "heading_rad", "curvature_per_cm")
        )
        xy_cm = np.asarray(data["xy_cm"], dtype=np.float64).reshape(-1, 2)
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
    columns = (s_cm, xy_cm, heading_rad, curvature_per_cm)
    lengths = [len(column) if column.ndim else 0 for column in columns]
    if min(lengths) < 2 or len(set(lengths)) > 1:
        raise DriveFormatError(
            f"{path}: expected s_cm, xy_cm, heading_rad and curvature_per_cm of one length of at least 2, "
            f"found {', '.join(map(str, lengths))}"
        )
    if not all(np.isfinite(column).all() for column in (*columns, boxes)):
        raise DriveFormatError(f"{path}: a number of the centre line or of a box is missing or not finite")
    return Track(
        s_cm, xy_cm, heading_rad, curvature_per_cm, closed, lane_width_cm, markings, boxes, oncoming_cm
    )
