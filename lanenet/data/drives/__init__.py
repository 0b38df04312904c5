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
from lanenet.reading import is_folder

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
        old = "; a version 1 tub has to be converted by Donkeycar first"
        hint = old if tub.is_old(path) else _nearby(path)
        raise DriveFormatError(f"{path}: not a drive: expected {formats_text()}{hint}")
    return assemble_drive(path, found.read(path))


def _nearby(path: Path) -> str:
    """Name the drive that a folder belongs to, or those in it; the end of a sentence."""
    try:
        if not is_folder(path):
            return ""
        if find_format(above := path.resolve().parent) is not None:
            return f"; the drive is the folder above it, {above}"
        inside = [each for each in sorted(path.iterdir()) if find_format(each) is not None]
    except OSError:  # a folder that cannot be read has no hint
        return ""
    more = f" and {len(inside) - 1} more" if len(inside) > 1 else ""
    return f"; there is a drive in it, {inside[0]}{more}" if inside else ""


def find_format(path: Path) -> DriveFormat | None:
    """Return the format of the drive at a path; None if there is no drive."""
    return next((known for known in FORMATS if known.recognises(path)), None)


def formats_text() -> str:
    """List the known formats, for error messages."""
    *first, last = (known.described for known in FORMATS)
    return f"{', '.join(first)} or {last}"
