"""Recorded drives in every format: a folder with ``frames.csv``, a Donkeycar tub, or a video.

A format is a module with a :class:`DriveFormat`, and one entry in :data:`FORMATS`.
"""

from __future__ import annotations

from pathlib import Path

from lanenet.data.drives import folder, tub, video
from lanenet.data.drives.folder import read_truth
from lanenet.data.drives.recording import Commands, Drive, DriveFormat, assemble_drive
from lanenet.errors import DriveFormatError
from lanenet.outputs import restore_output

__all__ = ["FORMATS", "Commands", "Drive", "find_format", "formats_text", "open_drive", "read_truth"]

#: Tried in this order; a folder that is both a drive folder and a tub is read as the former.
FORMATS: tuple[DriveFormat, ...] = (folder.FORMAT, tub.FORMAT, video.FORMAT)


def open_drive(path: Path) -> Drive:
    """Open a drive of any format.

    Raises:
        DriveFormatError: If it is of no known format, or cannot be read; says what was expected.
        CalibrationError: If the camera file that the drive names cannot be used.
    """
    path = Path(path)
    restore_output(path)
    if not path.exists():
        raise DriveFormatError(f"{path}: no such drive")
    found = find_format(path)
    if found is None:
        hint = "; a version 1 tub has to be converted by Donkeycar first" if tub.is_old(path) else ""
        raise DriveFormatError(f"{path}: not a drive: expected {formats_text()}{hint}")
    return assemble_drive(path, found.read(path))


def find_format(path: Path) -> DriveFormat | None:
    """Return the format of the drive at a path; None if there is no drive."""
    return next((known for known in FORMATS if known.recognises(path)), None)


def formats_text() -> str:
    """List the known formats, for error messages."""
    *first, last = (known.described for known in FORMATS)
    return f"{', '.join(first)} or {last}"
