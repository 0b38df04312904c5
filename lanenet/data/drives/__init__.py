"""Recorded drives in every format: a folder with ``frames.csv``, a Donkeycar tub, a video, or a ROS 2 bag.

A format is a module with a :class:`DriveFormat`, and one entry in :data:`FORMATS`.
"""

from __future__ import annotations

import difflib
import itertools
import shlex
from collections.abc import Iterator
from pathlib import Path

from lanenet.data.drives import bag, folder, tub, video
from lanenet.data.drives.folder import read_truth
from lanenet.data.drives.others import next_step
from lanenet.data.drives.recording import Commands, Drive, DriveFormat, assemble_drive
from lanenet.errors import DriveFormatError, counted
from lanenet.outputs import restore_output
from lanenet.reading import is_folder, natural_key

__all__ = [
    "FORMATS",
    "PHOTO_ENDINGS",
    "Commands",
    "Drive",
    "drive_above",
    "drives_in",
    "find_format",
    "formats_text",
    "is_photo",
    "meant_instead",
    "open_drive",
    "read_truth",
    "refuse_foreign",
]

#: Folders deep in which drives are looked for, and how many are named. Chosen: a Donkeycar's folder holds its
#: tubs as ``data/tub_1``.
_HINT_DEPTH, _HINT_COUNT = 2, 3
#: Endings of photos: what OpenCV reads.
PHOTO_ENDINGS = (".jpg", ".jpeg", ".png", ".bmp", ".webp", ".tif", ".tiff", ".ppm", ".pgm")
#: Tried in this order; a folder that is both a drive folder and a tub is read as the former.
FORMATS: tuple[DriveFormat, ...] = (folder.FORMAT, tub.FORMAT, video.FORMAT, bag.FORMAT)


def open_drive(path: Path) -> Drive:
    """Open a drive of any format.

    Raises:
        DriveFormatError: If it is of no known format, or cannot be read; says what was expected.
        CalibrationError: If the camera file that the drive names cannot be used.
    """
    path = Path(path)
    restore_output(path)
    if not path.exists():
        raise DriveFormatError(f"{path}: no such drive{meant_instead(path)}")
    found = find_format(path)
    if found is None:
        refuse_foreign(path)
        raise DriveFormatError(f"{path}: not a drive: expected {formats_text()}{meant_instead(path)}")
    return assemble_drive(path, found.read(path))


def refuse_foreign(path: Path) -> None:
    """Refuse a file of another kind, if it is known what makes a drive of it.

    Raises:
        DriveFormatError: Says what it is, and the command.
    """
    if not is_folder(path) and (step := next_step(path)) is not None:
        raise DriveFormatError(f"{path}: is {step}")


def meant_instead(path: Path) -> str:
    """Name the drive that a path that is none belongs to, or those in it; the end of a sentence.

    For a path that leads nowhere it is the one beside it with the most similar name, whatever that is.
    """
    if not path.exists():
        return _spelt_instead(path)
    if tub.is_old(path):
        new = shlex.quote(f"{path.name or 'tub'}_v2")
        convert = f"python scripts/convert_to_tub_v2.py --tub={shlex.quote(str(path))} --output={new}"
        return f"; a version 1 tub has to be converted by Donkeycar first, in its folder: {convert}"
    if not is_folder(path) and (step := next_step(path)) is not None:
        return f"; it is {step}"
    if (above := drive_above(path)) is not None:
        return f"; the drive is the folder above it: type {shlex.quote(str(above))}"
    inside = list(itertools.islice(drives_in(path, _HINT_DEPTH), _HINT_COUNT + 1))
    if not inside:
        return _photos_instead(path)
    names = ", ".join(shlex.quote(str(each)) for each in inside[:_HINT_COUNT])
    more = " or another" if len(inside) > _HINT_COUNT else ""
    return f"; {'there is a drive' if len(inside) == 1 else 'there are drives'} in it: type {names}{more}"


def _spelt_instead(path: Path) -> str:
    try:
        beside = [entry.name for entry in path.parent.iterdir()]
    except OSError:  # neither is there a folder
        return ""
    alike = difflib.get_close_matches(path.name, beside, n=1)
    return f"; did you mean {shlex.quote(str(path.with_name(alike[0])))}?" if alike else ""


def _photos_instead(path: Path) -> str:
    """Say of a folder of images that they are no drive."""
    if not is_folder(path):
        return ""
    try:
        files = sorted(path.iterdir(), key=natural_key)
    except OSError:  # a folder that cannot be read shows none
        return ""
    photos = sum(map(is_photo, files))
    if not photos:
        step = next(((file, step) for file in files if (step := next_step(file)) is not None), None)
        return "" if step is None else f"; {step[0].name} in it is {step[1]}"
    return (
        f"; it holds {counted(photos, 'image')} without a frames.csv: single photos cannot be mapped, and "
        "lanenet detect takes each of them"
    )


def is_photo(path: Path) -> bool:
    """Return whether a file is a photo, by its name."""
    # macOS adds a "._name.jpg" beside each file that it copies.
    return path.suffix.lower() in PHOTO_ENDINGS and not path.name.startswith(".")


def drive_above(path: Path) -> Path | None:
    """Return the drive whose folder of images, or of other files, a folder is; None if it is of none."""
    if not is_folder(path):
        return None
    # As it was typed, unless that has no folder above it.
    above = path.parent if path.name not in ("", "..") else path.resolve().parent
    return above if find_format(above) is not None else None


def drives_in(path: Path, depth: int) -> Iterator[Path]:
    """Yield the drives in a folder, and in folders of it that are none.

    Args:
        path: A folder; anything else holds none.
        depth: Folders deep in which drives are looked for.
    """
    try:
        entries = sorted(path.iterdir(), key=natural_key) if is_folder(path) else []
    except OSError:  # a folder that cannot be read has no hint
        return
    yield from (entry for entry in entries if find_format(entry) is not None)
    if depth > 1:
        for entry in entries:
            if find_format(entry) is None:
                yield from drives_in(entry, depth - 1)


def find_format(path: Path) -> DriveFormat | None:
    """Return the format of the drive at a path; None if there is no drive."""
    return next((known for known in FORMATS if known.recognises(path)), None)


def formats_text() -> str:
    """List the known formats, for error messages."""
    *first, last = (known.described for known in FORMATS)
    return f"{', '.join(first)} or {last}"
