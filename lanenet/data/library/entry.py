"""What a library holds about a drive, and how that is checked."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path

from lanenet.data.drives.recording import Kind
from lanenet.errors import LibraryError

#: What people say about a drive; the rest of an entry is found.
TOLD = ("car", "camera", "track", "licence", "notes", "lane_width_cm")
#: A name is also that of files and folders. Chosen: what any file system and shell takes as it is.
_NAME = re.compile(r"[^\W_][\w.+-]{0,99}")
#: Characters of a text that people give; chosen.
_LONGEST_TEXT = 10_000


@dataclass(frozen=True)
class Entry:
    """A drive of a library.

    Attributes:
        name: Unique in the library; letters, digits and ``_ . + -``.
        source: Where it is: absolute, or relative to the folder of the library's file.
        copied: Whether ``source`` is a copy that belongs to the library.
        kind: What it is on disk.
        car: Which car; empty if unknown, like the next four.
        camera: Which camera, or the path of its file.
        track: Which track.
        licence: Under what the recording may be used.
        notes: Free text.
        lane_width_cm: Between the middles of the lane's lines, [cm]; None if unknown.
        frames: Number of frames.
        duration_s: Time driven, without breaks, [s].
        checksum: SHA-256 of the images as stored and of the commands, in order: that of the same recording is
            the same under any name and at any path.
        added_at: When it was added: ISO 8601, UTC.
    """

    name: str
    source: Path
    copied: bool
    kind: Kind
    car: str
    camera: str
    track: str
    licence: str
    notes: str
    lane_width_cm: float | None
    frames: int
    duration_s: float
    checksum: str
    added_at: str


FIELDS = tuple(field.name for field in fields(Entry))


def check_name(name: str) -> None:
    """Refuse a name that could not be that of a file.

    Raises:
        LibraryError: Says what a name is made of.
    """
    if not _NAME.fullmatch(name):
        raise LibraryError(
            f"name {name!r}: expected up to 100 letters, digits and any of '._+-', a letter or digit first"
        )


def name_of(path: Path) -> str:
    """Return a name for the drive at a path, made of its own."""
    text = path.name if path.is_dir() else path.stem
    return re.sub(r"^[\W_]+", "", re.sub(r"[^\w.+-]+", "-", text))[:90] or "drive"


def check_told(told: Mapping[str, object]) -> None:
    """Refuse what people may not say about a drive, or not so.

    Raises:
        LibraryError: Names the field.
    """
    for key, value in told.items():
        if key not in TOLD:
            raise LibraryError(f"{key}: not to be given, expected one of {', '.join(TOLD)}")
        if key == "lane_width_cm":
            number = isinstance(value, int | float) and not isinstance(value, bool)
            if value is not None and not (number and 0.0 < float(str(value)) < math.inf):
                raise LibraryError(f"{key}: found {value!r}, expected a number of cm above 0")
        elif not isinstance(value, str) or len(value) > _LONGEST_TEXT or "\0" in value:
            raise LibraryError(f"{key}: expected a text of up to {_LONGEST_TEXT} characters")
