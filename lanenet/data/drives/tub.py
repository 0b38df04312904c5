"""Donkeycar tubs (version 2), read where they lie.

A tub is ``manifest.json`` (one JSON value per line: inputs, types, metadata, manifest metadata, and the list
of catalogs), catalogs of one JSON record per line, and a folder ``images``.
"""

from __future__ import annotations

import itertools
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from lanenet.data.drives.folder import drive_of
from lanenet.data.drives.recording import Commands, Drive, ImageFiles
from lanenet.errors import DriveFormatError

MANIFEST_FILE = "manifest.json"
#: Period of Donkeycar's default drive loop, used where the timestamps say nothing.
DEFAULT_PERIOD_S = 0.05
_MIN_MEDIAN_STEP_S = 0.01
#: A step this many times longer or shorter than the median one is irregular ...
_IRREGULAR_RATIO = 4.0
#: ... and with more of them than this, the times are not those of the frames.
_IRREGULAR_SHARE = 0.2


@dataclass(frozen=True)
class _Record:
    index: int
    session: str
    time_ms: float
    image: str
    angle: float
    throttle: float


@dataclass(frozen=True)
class _Manifest:
    catalogs: list[str]
    deleted: set[int]
    image_key: str


def open_tub(path: Path) -> Drive:
    """Open a tub; nothing is copied or converted.

    Rows that cannot be used (not JSON, no index, no image) are left out and counted in ``problems``. Rows
    without an angle stay, with NaN. A ``drive.yaml`` in the tub's folder may name camera and lane width.

    Raises:
        DriveFormatError: If the manifest or all catalogs cannot be read, or no row can be used.
    """
    manifest = _read_manifest(path / MANIFEST_FILE)
    problems: list[str] = []
    records: list[_Record] = []
    for name in _present_catalogs(path, manifest, problems):
        records += _read_catalog(path / name, manifest.image_key, problems)
    records = _in_order(path, records, problems)
    records = _with_images(path, records, problems)
    if not records:
        detail = f" ({'; '.join(problems)})" if problems else ""
        raise DriveFormatError(f"{path}: the tub holds no usable frames{detail}")
    frames = np.array([record.index for record in records], dtype=np.int64)
    time_ms = np.array([record.time_ms for record in records])
    t_s, trusted = _times(path, frames, time_ms, problems)
    names = [record.session for record in records]
    sessions = np.array([False, *(a != b for a, b in itertools.pairwise(names))])
    angle = np.array([record.angle for record in records])
    throttle = np.array([record.throttle for record in records])
    if np.isnan(angle).any():
        problems.append(
            f"{path}: {np.isnan(angle).sum()} of {len(angle)} rows have no angle (first: frame "
            f"{frames[np.isnan(angle)][0]})"
        )
    images = ImageFiles([path / "images" / record.image for record in records])
    return drive_of(
        path,
        frames,
        t_s,
        Commands(
            angle=None if np.isnan(angle).all() else angle,
            throttle=None if np.isnan(throttle).all() else throttle,
        ),
        images,
        problems,
        times_trusted=trusted,
        deleted=np.array([index in manifest.deleted for index in frames.tolist()], dtype=bool),
        sessions=sessions,
    )


def _read_manifest(path: Path) -> _Manifest:
    try:
        lines = [line for line in path.read_text(encoding="utf-8").split("\n") if line.strip()]
        values = [json.loads(line) for line in lines]
    except (OSError, ValueError) as error:
        raise DriveFormatError(f"{path}: not a readable tub manifest ({error})") from None
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
    # Copies made on a Mac carry a shadow file beside each file.
    names = [str(name) for name in catalogs[-1]["paths"] if not Path(str(name)).name.startswith("._")]
    return _Manifest(names, set(deleted), image_key)


def _present_catalogs(path: Path, manifest: _Manifest, problems: list[str]) -> list[str]:
    present = [name for name in manifest.catalogs if (path / name).is_file()]
    absent = [name for name in manifest.catalogs if name not in present]
    if not present:
        found = f"{', '.join(absent)} are not there" if absent else "the manifest lists no catalog"
        raise DriveFormatError(f"{path / MANIFEST_FILE}: the tub is empty: {found}")
    if absent:
        problems.append(f"{path / MANIFEST_FILE}: catalogs listed but not there: {', '.join(absent)}")
    return present


def _read_catalog(path: Path, image_key: str, problems: list[str]) -> list[_Record]:
    # A power cut leaves zero bytes and half a line behind; they are counted like any other broken row.
    lines = path.read_bytes().decode("utf-8", errors="replace").split("\n")
    records = []
    bad = []
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        record = _record(line, image_key)
        if record is None:
            bad.append(number)
        else:
            records.append(record)
    if bad:
        problems.append(
            f"{path}: {len(bad)} rows are not JSON with '_index' and {image_key!r} (first: row {bad[0]})"
        )
    return records


def _record(line: str, image_key: str) -> _Record | None:
    try:
        data = json.loads(line)
    except ValueError:
        return None
    if not isinstance(data, dict):
        return None
    index, image = data.get("_index"), data.get(image_key)
    if not isinstance(index, int) or isinstance(index, bool) or not isinstance(image, str):
        return None
    if not image or Path(image).name != image:
        return None
    # When the pilot drove, what moved the car are the pilot's commands (Donkeycar's drive modes).
    mode = data.get("user/mode")
    steers, drives = mode in ("local", "local_angle"), mode == "local"
    return _Record(
        index=index,
        session=str(data.get("_session_id")),
        time_ms=_number(data.get("_timestamp_ms")),
        image=image,
        angle=_command(data, "angle", steers),
        throttle=_command(data, "throttle", drives),
    )


def _command(data: dict[str, Any], name: str, by_pilot: bool) -> float:
    pilot = _number(data.get(f"pilot/{name}"))
    return pilot if by_pilot and math.isfinite(pilot) else _number(data.get(f"user/{name}"))


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return math.nan
    return float(value)


def _in_order(path: Path, records: list[_Record], problems: list[str]) -> list[_Record]:
    """Leave out rows whose index repeats or goes back."""
    kept: list[_Record] = []
    for record in records:
        if not kept or record.index > kept[-1].index:
            kept.append(record)
    if len(kept) < len(records):
        problems.append(f"{path}: {len(records) - len(kept)} rows repeat an earlier index or go back")
    return kept


def _with_images(path: Path, records: list[_Record], problems: list[str]) -> list[_Record]:
    folder = path / "images"
    there = {entry.name for entry in folder.iterdir()} if folder.is_dir() else set()
    kept = [record for record in records if record.image in there]
    if len(kept) < len(records):
        first = next(record for record in records if record.image not in there)
        problems.append(
            f"{folder}: {len(records) - len(kept)} of {len(records)} images are missing (first: frame "
            f"{first.index}, {first.image})"
        )
    return kept


def _times(
    path: Path, frames: Int[np.ndarray, "n"], time_ms: Float[np.ndarray, "n"], problems: list[str]
) -> tuple[Float[np.ndarray, "n"], bool]:
    """Times relative to the first frame, or 20 Hz where the timestamps cannot be those of the frames."""
    reason = _distrust(frames, time_ms)
    if reason is None:
        return (time_ms - time_ms[0]) / 1000.0, True
    problems.append(f"{path}: timestamps not used, {reason}; taking {1.0 / DEFAULT_PERIOD_S:.0f} frames/s")
    return (frames - frames[0]) * DEFAULT_PERIOD_S, False


def _distrust(frames: Int[np.ndarray, "n"], time_ms: Float[np.ndarray, "n"]) -> str | None:
    if np.isnan(time_ms).any():
        return f"{np.isnan(time_ms).sum()} rows have none"
    steps_s = np.diff(time_ms) / 1000.0
    if (steps_s <= 0.0).any():
        return f"they do not increase at frame {frames[1:][steps_s <= 0.0][0]}"
    # Steps over left-out rows say nothing about the rate.
    steps_s = steps_s[np.diff(frames) == 1]
    if steps_s.size == 0:
        return None
    median_s = float(np.median(steps_s))
    if median_s < _MIN_MEDIAN_STEP_S:
        return f"the median step is {1000.0 * median_s:.0f} ms"
    irregular = (steps_s > _IRREGULAR_RATIO * median_s) | (steps_s < median_s / _IRREGULAR_RATIO)
    if irregular.mean() > _IRREGULAR_SHARE:
        return f"{100.0 * irregular.mean():.0f} % of the steps are far from the median of {median_s:.3f} s"
    return None
