"""Donkeycar tubs (version 2), read in place.

A tub is ``manifest.json`` (one JSON value per line: inputs, types, metadata, manifest metadata, and the list
of catalogs), catalogs of one JSON record per line, and a folder ``images``. Source: donkeycar 5.3,
``parts/tub_v2.py`` and ``parts/datastore_v2.py``.
"""

from __future__ import annotations

import itertools
import os
from collections import Counter
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from lanenet.data.drives.recording import (
    DEFAULT_PERIOD_S,
    DRIVE_FILE,
    Commands,
    DriveFormat,
    ImageFiles,
    RecordedFrames,
    goes_back_often,
    named_file,
    without_jumps,
)
from lanenet.data.drives.tub_index import CATALOGS, MANIFEST_FILE, read_index
from lanenet.data.drives.tub_rows import Record, ordered, read_catalog
from lanenet.errors import DriveFormatError
from lanenet.reading import FolderFiles, first_line, is_folder, is_regular

#: Timestamps closer than this are not those of the frames, and share of such steps above which none is used.
#: Long steps say nothing against a clock: Donkeycar records only while the throttle is pressed. Measured:
#: ``donkey_circuit``, whose timestamps are useless, has a median step of 3 ms, three sound tubs have 50 to
#: 100 ms, and 0 to 0.6 % of their steps are irregular.
_MIN_STEP_S, _SHORT_SHARE = 0.01, 0.2


def read_tub(path: Path) -> RecordedFrames:
    """Read a tub; nothing is copied or converted.

    What the catalogs hold is read, whether the manifest lists it or not. Rows that cannot be used (not JSON,
    no index, no image) are left out and counted in ``problems``. Rows without an angle stay, with NaN, as do
    those whose angle or throttle lies outside -1 to 1.

    Raises:
        DriveFormatError: If all catalogs cannot be read, there are several cameras, or no row can be used.
    """
    inside = FolderFiles(path)
    index = read_index(path, inside)
    problems = index.problems
    rows: list[Record] = []
    for catalog in index.catalogs:
        found_records, bad_rows = read_catalog(catalog, index.image_key)
        rows += found_records
        if bad_rows:
            problems.append(
                f"{catalog}: {len(bad_rows)} rows are not JSON with '_index' and {index.image_key!r} "
                f"(first: row {bad_rows[0]})"
            )
    sequence = ordered(rows)
    problems += [f"{path}: {problem}" for problem in sequence.problems]
    if sequence.recounted and index.deleted:
        problems.append(
            f"{path}: which {len(index.deleted)} frames were deleted cannot be told by their numbers"
        )
    folder = path / "images"
    names = _image_names(folder, inside)
    files = [_image_file(path, record.image, names, inside) for record in sequence.records]
    missing = [k for k, file in enumerate(files) if file is None]
    if missing:
        problems.append(
            f"{folder}: {len(missing)} of {len(files)} images are missing (first: frame "
            f"{sequence.frames[missing[0]]}, {sequence.records[missing[0]].image})"
        )
    # Rows of one name are one by now.
    named = Counter(files)
    shared = [k for k, file in enumerate(files) if file is not None and named[file] > 1]
    if shared:
        problems.append(
            f"{folder}: {len(shared)} of {len(files)} rows name images in several folders that are one file "
            f"here; left out (first: frame {sequence.frames[shared[0]]}, {sequence.records[shared[0]].image})"
        )
        files = [None if named[file] > 1 else file for file in files]
    kept = [k for k, file in enumerate(files) if file is not None]
    images = [file for file in files if file is not None]
    records = [sequence.records[k] for k in kept]
    if not records:
        detail = f" ({'; '.join(problems)})" if problems else ""
        raise DriveFormatError(f"{path}: the tub holds no usable frames{detail}")
    frames = sequence.frames[kept]
    time_ms = np.array([record.time_ms for record in records])
    distrust = _distrust(frames, time_ms)
    if distrust is not None:
        t_s = (frames - frames[0]) * DEFAULT_PERIOD_S
        problems.append(
            f"{path}: timestamps not used, {distrust}; taking {1.0 / DEFAULT_PERIOD_S:.0f} frames/s, so that "
            "gaps in the recording are seen by missing frame numbers only"
        )
    else:
        t_s, jumps = without_jumps(path, frames, (time_ms - time_ms[0]) / 1000.0)
        problems += jumps
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
        t_s,
        Commands(
            angle=None if np.isnan(angle).all() else angle,
            throttle=None if np.isnan(throttle).all() else throttle,
        ),
        ImageFiles(images),
        tuple(problems),
        times_trusted=distrust is None,
        deleted=np.array(
            [not sequence.recounted and record.index in index.deleted for record in records], dtype=bool
        ),
        sessions=np.array([False, *(before != now for before, now in sessions)]),
    )


FORMAT = DriveFormat(
    kind="tub",
    described=f"a Donkeycar tub ({MANIFEST_FILE})",
    recognises=lambda path: is_regular(path / MANIFEST_FILE) or any(path.glob(CATALOGS)),
    read=read_tub,
    files=(MANIFEST_FILE, DRIVE_FILE, "*.catalog", "*.catalog_manifest"),
)


def is_old(path: Path) -> bool:
    """Tell whether a folder is a tub of version 1, which is not read."""
    return any(path.glob("record_*.json"))


def _image_names(folder: Path, inside: FolderFiles) -> set[str]:
    """Return the names of the files in the folder of the images, without links that lead elsewhere.

    Raises:
        DriveFormatError: If the folder itself, or a link in it, leads out of the tub.
    """
    if not is_folder(folder):
        return set()
    names: set[str] = set()
    try:
        with os.scandir(folder) as entries:
            for entry in entries:
                # The rest lies where the folder does.
                if not names or entry.is_symlink():
                    inside.file(f"{folder.name}/{entry.name}", folder, DriveFormatError)
                if entry.is_file():
                    names.add(entry.name)
    except OSError as error:
        raise DriveFormatError(f"{folder}: cannot be read ({first_line(error)})") from None
    return names


def _image_file(path: Path, name: str, names: set[str], inside: FolderFiles) -> Path | None:
    """Return the file of an image; None if it is not there.

    Args:
        path: The tub.
        name: What a row names; tools write folders before it, also those of another computer.
        names: Names in the tub's folder of images.
        inside: The tub's files.

    Raises:
        DriveFormatError: If a link leads out of the tub.
    """
    # Most are plain names, of any number: no look at the disk for each.
    return path / "images" / name if name in names else named_file(inside, name, path, "images")


def _distrust(frames: Int[np.ndarray, "n"], time_ms: Float[np.ndarray, "n"]) -> str | None:
    """Return why the timestamps cannot be those of the frames; None if they can."""
    if np.isnan(time_ms).any():
        return f"{np.isnan(time_ms).sum()} rows have none"
    steps_s = np.diff(time_ms) / 1000.0
    if (often := goes_back_often(frames, time_ms)) is not None:
        return f"they {often}"
    # Steps across left-out rows, and back, say nothing about the rate.
    steps_s = steps_s[(np.diff(frames) == 1) & (steps_s > 0.0)]
    short = steps_s < _MIN_STEP_S
    if steps_s.size and short.mean() > _SHORT_SHARE:
        return f"{100.0 * short.mean():.0f} % of the steps are shorter than {1000.0 * _MIN_STEP_S:.0f} ms"
    return None
