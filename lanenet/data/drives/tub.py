"""Donkeycar tubs (version 2), read in place.

A tub is ``manifest.json`` (one JSON value per line: inputs, types, metadata, manifest metadata, and the list
of catalogs), catalogs of one JSON record per line, and a folder ``images``. Source: donkeycar 5.3,
``parts/tub_v2.py`` and ``parts/datastore_v2.py``.
"""

from __future__ import annotations

import itertools
import json
import math
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from lanenet.data.drives.recording import (
    DRIVE_FILE,
    MAX_TIME_S,
    Commands,
    DriveFormat,
    ImageFiles,
    RecordedFrames,
)
from lanenet.errors import DriveFormatError
from lanenet.reading import MAX_JSON, MEBIBYTE, FolderFiles, is_regular, parsing, read_bytes, read_text

MANIFEST_FILE = "manifest.json"
#: Used where the timestamps cannot be those of the frames: Donkeycar's default rate (DRIVE_LOOP_HZ = 20).
DEFAULT_PERIOD_S = 0.05
#: Timestamps closer than this are not those of the frames, and share of such steps above which none is used.
#: Long steps say nothing against a clock: Donkeycar records only while the throttle is pressed. Measured:
#: ``donkey_circuit``, whose timestamps are useless, has a median step of 3 ms, three sound tubs have 50 to
#: 100 ms, and 0 to 0.6 % of their steps are irregular.
_MIN_STEP_S, _SHORT_SHARE = 0.01, 0.2
#: Share of the steps in which the clock may stand or go back, one in any case: it was set. Chosen.
_SET_SHARE = 0.01

#: Of a catalog. Chosen: Donkeycar starts a new one every 1000 rows, which take 0.3 MB, or more with a lidar.
_MAX_CATALOG = 64 * MEBIBYTE
#: Characters of a row. Chosen: 50 000 numbers; lists in JSON take twenty times their text in memory.
_MAX_ROW = 2**20
#: Rows are counted in 64 bits; chosen: exact as a float, too.
_MAX_INDEX = 2**53
#: A joystick at its stop: Donkeycar divides its 16 bits, -32768 to 32767, by 32767. Taken as 1.
_LARGEST_COMMAND = 32768.0 / 32767.0 + 1e-9
_MAX_FLOAT = sys.float_info.max


@dataclass(frozen=True)
class _Record:
    index: int
    session: str
    time_ms: float
    image: str
    angle: float
    throttle: float


def read_tub(path: Path) -> RecordedFrames:
    """Read a tub; nothing is copied or converted.

    Rows that cannot be used (not JSON, no index, no image) are left out and counted in ``problems``. Rows
    without an angle stay, with NaN, as do those whose angle or throttle lies outside -1 to 1.

    Raises:
        DriveFormatError: If the manifest or all catalogs cannot be read, or no row can be used.
    """
    inside = FolderFiles(path)
    catalogs, deleted, image_key = _read_manifest(inside.file(MANIFEST_FILE, path, DriveFormatError))
    key = f"{path / MANIFEST_FILE}: key 'paths'"
    present = [name for name in catalogs if is_regular(inside.file(name, key, DriveFormatError))]
    absent = [name for name in catalogs if name not in present]
    if not present:
        found = f"{', '.join(absent)} are not there" if absent else "the manifest lists no catalog"
        raise DriveFormatError(f"{path / MANIFEST_FILE}: the tub is empty: {found}")
    problems: list[str] = []
    if absent:
        problems.append(f"{path / MANIFEST_FILE}: catalogs listed but not there: {', '.join(absent)}")
    records: list[_Record] = []
    for name in present:
        found_records, bad_rows = _read_catalog(path / name, image_key)
        records += found_records
        if bad_rows:
            problems.append(
                f"{path / name}: {len(bad_rows)} rows are not JSON with '_index' and {image_key!r} "
                f"(first: row {bad_rows[0]})"
            )
    ordered = _in_order(records)
    if len(ordered) < len(records):
        problems.append(f"{path}: {len(records) - len(ordered)} rows repeat an earlier index or go back")
    folder = path / "images"
    there = _image_names(folder, inside)
    missing = [record for record in ordered if record.image not in there]
    if missing:
        problems.append(
            f"{folder}: {len(missing)} of {len(ordered)} images are missing (first: frame "
            f"{missing[0].index}, {missing[0].image})"
        )
    records = [record for record in ordered if record.image in there]
    if not records:
        detail = f" ({'; '.join(problems)})" if problems else ""
        raise DriveFormatError(f"{path}: the tub holds no usable frames{detail}")
    frames = np.array([record.index for record in records], dtype=np.int64)
    time_ms = np.array([record.time_ms for record in records])
    distrust = _distrust(frames, time_ms)
    if distrust is not None:
        problems.append(
            f"{path}: timestamps not used, {distrust}; taking {1.0 / DEFAULT_PERIOD_S:.0f} frames/s, so that "
            "gaps in the recording are seen by missing frame numbers only"
        )
    else:
        time_ms, jumps = _without_jumps(time_ms)
        if jumps.any():
            first = int(np.flatnonzero(jumps)[0])
            problems.append(
                f"{path}: the clock goes back or stands {jumps.sum()} times, first at frame {frames[first]}; "
                "a typical step is taken there"
            )
    angle = np.array([record.angle for record in records])
    throttle = np.array([record.throttle for record in records])
    if np.isnan(angle).any():
        problems.append(
            f"{path}: {np.isnan(angle).sum()} of {len(angle)} rows have no angle (first: frame "
            f"{frames[np.isnan(angle)][0]})"
        )
    for name, values in (("angle", angle), ("throttle", throttle)):
        outside = np.flatnonzero(np.abs(values) > 1.0)
        if len(outside):
            problems.append(
                f"{path}: {len(outside)} of {len(values)} rows have '{name}' outside -1 to 1, left out "
                f"(first: frame {frames[outside[0]]}, {values[outside[0]]:g})"
            )
            values[outside] = np.nan
    sessions = itertools.pairwise(record.session for record in records)
    return RecordedFrames(
        frames,
        (time_ms - time_ms[0]) / 1000.0 if distrust is None else (frames - frames[0]) * DEFAULT_PERIOD_S,
        Commands(
            angle=None if np.isnan(angle).all() else angle,
            throttle=None if np.isnan(throttle).all() else throttle,
        ),
        ImageFiles([folder / record.image for record in records]),
        tuple(problems),
        times_trusted=distrust is None,
        deleted=np.array([record.index in deleted for record in records], dtype=bool),
        sessions=np.array([False, *(before != now for before, now in sessions)]),
    )


FORMAT = DriveFormat(
    kind="tub",
    described=f"a Donkeycar tub ({MANIFEST_FILE})",
    recognises=lambda path: is_regular(path / MANIFEST_FILE),
    read=read_tub,
    files=(MANIFEST_FILE, DRIVE_FILE, "*.catalog", "*.catalog_manifest"),
)


def is_old(path: Path) -> bool:
    """Tell whether a folder is a tub of version 1, which is not read."""
    return any(path.glob("record_*.json"))


def _read_manifest(path: Path) -> tuple[list[str], set[int], str]:
    """Return the names of the catalogs, the deleted indexes, and the key of the images."""
    lines = [line for line in read_text(path, DriveFormatError, MAX_JSON).split("\n") if line.strip()]
    with parsing(f"{path}: not a readable tub manifest", DriveFormatError):
        return _manifest_of(path, [json.loads(line) for line in lines])


def _manifest_of(path: Path, values: list[Any]) -> tuple[list[str], set[int], str]:
    catalogs = [value for value in values if isinstance(value, dict) and "paths" in value]
    if not catalogs or not isinstance(catalogs[-1]["paths"], list):
        raise DriveFormatError(
            f"{path}: expected five lines of JSON, the last with the catalogs' 'paths', found {len(values)}"
        )
    deleted = catalogs[-1].get("deleted_indexes", [])
    if not isinstance(deleted, list) or not all(isinstance(index, int) for index in deleted):
        raise DriveFormatError(f"{path}: expected 'deleted_indexes' to be a list of whole numbers")
    image_key = "cam/image_array"
    if len(values) > 1 and isinstance(values[0], list) and isinstance(values[1], list):
        named = dict(zip(values[1], values[0], strict=False)) if len(values[0]) == len(values[1]) else {}
        image_key = str(named.get("image_array", image_key))
    # macOS adds a "._name" beside each file that it copies.
    names = [str(name) for name in catalogs[-1]["paths"] if not Path(str(name)).name.startswith("._")]
    # Once each: a catalog that is listed a million times is still one.
    return list(dict.fromkeys(names)), set(deleted), image_key


def _image_names(folder: Path, inside: FolderFiles) -> set[str]:
    """Return the names of the files in the folder of the images, without links that lead elsewhere.

    Raises:
        DriveFormatError: If the folder itself, or a link in it, leads out of the tub.
    """
    if not folder.is_dir():
        return set()
    names: set[str] = set()
    with os.scandir(folder) as entries:
        for entry in entries:
            # The rest lies where the folder does.
            if not names or entry.is_symlink():
                inside.file(f"{folder.name}/{entry.name}", folder, DriveFormatError)
            if entry.is_file():
                names.add(entry.name)
    return names


def _read_catalog(path: Path, image_key: str) -> tuple[list[_Record], list[int]]:
    """Return the records of a catalog and the numbers of the rows that are none.

    A power cut leaves zero bytes and half a row behind; they count as bad rows.
    """
    data = read_bytes(path, DriveFormatError, _MAX_CATALOG)
    records: list[_Record] = []
    bad_rows: list[int] = []
    for number, line in enumerate(data.decode("utf-8", errors="replace").split("\n"), start=1):
        record = _record(line, image_key) if len(line) <= _MAX_ROW else None
        if record is not None:
            records.append(record)
        elif line and not line.isspace():
            bad_rows.append(number)
    return records, bad_rows


def _record(line: str, image_key: str) -> _Record | None:
    if not line.lstrip().startswith("{"):
        return None
    try:
        data = json.loads(line)
    except (ValueError, RecursionError):
        return None
    if not isinstance(data, dict):
        return None
    index, image = data.get("_index"), data.get(image_key)
    if not isinstance(index, int) or isinstance(index, bool) or not isinstance(image, str):
        return None
    if not image or Path(image).name != image or not 0 <= index <= _MAX_INDEX:
        return None
    # In the pilot's drive modes the pilot's commands moved the car, not the user's.
    mode = data.get("user/mode")
    return _Record(
        index=index,
        session=str(data.get("_session_id")),
        time_ms=_number(data.get("_timestamp_ms"), 1000.0 * MAX_TIME_S),
        image=image,
        angle=_command(data, "angle", mode in ("local", "local_angle")),
        throttle=_command(data, "throttle", mode == "local"),
    )


def _command(data: dict[str, Any], name: str, by_pilot: bool) -> float:
    pilot = _number(data.get(f"pilot/{name}"))
    value = pilot if by_pilot and math.isfinite(pilot) else _number(data.get(f"user/{name}"))
    return math.copysign(1.0, value) if 1.0 < abs(value) <= _LARGEST_COMMAND else value


def _number(value: Any, most: float = math.inf) -> float:
    # Whole numbers of any length are JSON.
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= most:
        return math.nan
    return float(value) if abs(value) <= _MAX_FLOAT else math.nan


def _in_order(records: list[_Record]) -> list[_Record]:
    """Leave out records whose index repeats or goes back."""
    kept: list[_Record] = []
    for record in records:
        if not kept or record.index > kept[-1].index:
            kept.append(record)
    return kept


def _distrust(frames: Int[np.ndarray, "n"], time_ms: Float[np.ndarray, "n"]) -> str | None:
    """Return why the timestamps cannot be those of the frames; None if they can."""
    if np.isnan(time_ms).any():
        return f"{np.isnan(time_ms).sum()} rows have none"
    steps_s = np.diff(time_ms) / 1000.0
    back = steps_s <= 0.0
    if back.sum() > max(1.0, _SET_SHARE * len(steps_s)):
        return f"they do not increase {back.sum()} times, first at frame {frames[1:][back][0]}"
    # Steps across left-out rows say nothing about the rate.
    steps_s = steps_s[(np.diff(frames) == 1) & ~back]
    short = steps_s < _MIN_STEP_S
    if steps_s.size and short.mean() > _SHORT_SHARE:
        return f"{100.0 * short.mean():.0f} % of the steps are shorter than {1000.0 * _MIN_STEP_S:.0f} ms"
    return None


def _without_jumps(time_ms: Float[np.ndarray, "n"]) -> tuple[Float[np.ndarray, "n"], Bool[np.ndarray, "n"]]:
    """Put a typical step where the clock stands or goes back; returns the times, and where that is."""
    steps = np.diff(time_ms)
    back = steps <= 0.0
    if not back.any():
        return time_ms, np.zeros(len(time_ms), dtype=bool)
    typical = float(np.median(steps[~back])) if (~back).any() else 1000.0 * DEFAULT_PERIOD_S
    mended = time_ms[0] + np.concatenate([[0.0], np.cumsum(np.where(back, typical, steps))])
    return mended, np.concatenate([[False], back])
